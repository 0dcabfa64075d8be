# Sourced once the window is ready: clicks as a user does, and looks at the data after each click.
# expect CONDITION SECONDS: wait until the Python expression CONDITION of the state is true.
expect() {
  local condition=$1 seconds=$2 start=$SECONDS
  while ! python3 - "$PALETTE_STATE" "$condition" <<'PY'
import json, sys
from types import SimpleNamespace
try:
    state = json.load(open(sys.argv[1]))
except OSError:
    sys.exit(1)
sys.exit(not eval(sys.argv[2], {}, state))
PY
  do
    if ! alive || ((SECONDS - start > seconds)); then
      echo "not within $seconds s: $condition" >&2
      cat "$PALETTE_STATE" >&2
      return 1
    fi
    sleep 0.3
  done
  echo "$((SECONDS - start)) s: $condition"
}

expect "len(regions) >= 3 and not running and not palette" 20
shot "${PALETTE_SHOT%.png}-start.png"

# Esc ends a run and leaves nothing
click_text "Extract Palette" IMAGE_EDITOR UI
expect "running and progress > 0" 30
shot "${PALETTE_SHOT%.png}-running.png"
key Escape
expect "not running and not palette and not temporary and not error" 3

# the button makes the palette
click_text "Extract Palette" IMAGE_EDITOR UI
expect "running" 5
expect "not running and not error and len(palette) == len(regions) and previews and not temporary" 300
shot "${PALETTE_SHOT%.png}-palette.png"

# one undo step takes it away, redo brings it back
read -r x y w h <<<"$(region IMAGE_EDITOR WINDOW)"
xdo mousemove $((x + w / 2)) $((y + h / 2)) sleep 0.3
key ctrl+z
expect "not palette and len(regions) >= 3" 10
key ctrl+shift+z
expect "len(palette) == len(regions)" 10

click_text "Assign" IMAGE_EDITOR UI
expect "cube == palette[0]" 10

# painting: the photo shows through the mask; a stroke over the door widens it, where Blender has its brushes
# (some distributions leave them out)
touch "$PALETTE_STATE.paint"
expect "mode == 'PAINT'" 10
sleep 1
read_state() { python3 -c 'import json, sys; print(json.load(open(sys.argv[1]))[sys.argv[2]])' "$PALETTE_STATE" "$1"; }
if [ "$(read_state brush)" = True ]; then
  before=$(read_state painted)
  xdo mousemove $((x + w / 4)) $((y + h * 3 / 4)) sleep 0.3 mousedown 1 sleep 0.1
  for step in 1 2 3 4 5 6; do xdo mousemove $((x + w / 4 + step * 25)) $((y + h * 3 / 4)) sleep 0.05; done
  xdo mouseup 1
  expect "painted > $before" 10
fi
