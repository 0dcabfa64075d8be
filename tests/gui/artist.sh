# Sourced once the window is ready: works as an artist does, and looks at the data and takes a picture after each step.
# expect CONDITION SECONDS [quietly]: wait until the Python expression CONDITION of the state is true.
expect() {
  local condition=$1 seconds=$(($2 * ${PALETTE_PATIENCE:-1})) quietly=${3:-} start=$SECONDS
  while ! python3 - "$PALETTE_STATE" "$condition" <<'PY'
import json, sys
try:
    state = json.load(open(sys.argv[1]))
except OSError:
    sys.exit(1)
sys.exit(not eval(sys.argv[2], state))
PY
  do
    if ! alive || ((SECONDS - start > seconds)); then
      [ -z "$quietly" ] || return 1
      echo "not within $seconds s: $condition" >&2
      cat "$PALETTE_STATE" >&2
      picture failed
      return 1
    fi
    sleep 0.3
  done
  echo "$((SECONDS - start)) s: $condition"
}
state() { python3 -c 'import json, sys; print(eval(sys.argv[2], json.load(open(sys.argv[1]))))' "$PALETTE_STATE" "$1"; }
picture() { sleep 2; shot "${PALETTE_SHOT%.png}-$1.png"; }
tell() { echo "$1" >"$PALETTE_STATE.do"; expect "done and done[-1] == '$1'" 30; sleep 1; }
# press TEXT CONDITION SECONDS: click on a button of the sidebar; a second time where a busy machine has lost the click
press() {
  local tries
  for tries in 1 2; do
    sleep 1
    # the recognition of text now and then joins two words
    click_text "$1" IMAGE_EDITOR UI 2>/dev/null || click_text "${1// /}" IMAGE_EDITOR UI
    if expect "$2" "$((tries == 1 ? 8 : $3))" quietly; then return 0; fi
  done
  expect "$2" 1
}
# at X Y: pixel of the screen for a place in the photo, in thousandths of its width and height
at() { python3 - "$PALETTE_STATE" "$1" "$2" <<'PY'
import json, sys
left, top, right, bottom = json.load(open(sys.argv[1]))["rectangle"]
x, y = (int(v) / 1000 for v in sys.argv[2:])
print(round(left + x * (right - left)), round(top + y * (bottom - top)))
PY
}
# drag X Y X Y ...: the left button held from place to place of the photo
drag() {
  local held=0
  while [ $# -ge 2 ]; do
    xdo mousemove $(at "$1" "$2"); sleep 0.15
    ((held)) || { xdo mousedown 1; sleep 0.15; held=1; }
    shift 2
  done
  xdo mouseup 1
  sleep 0.3
}

expect "photo and not regions" 30
picture 1-photo

# paint the door with the brush, where Blender has brushes (some distributions leave them out); undo takes a stroke back
press Paint "mode == 'PAINT' and len(regions) == 1" 15
sleep 2
if [ "$(state brush)" = True ]; then
  drag 310 600 310 700 340 700 340 600 370 600 370 850
  expect "shares[0] > 0.001" 15
  picture 2-painted
  before=$(state 'shares[0]')
  drag 310 850 350 850
  expect "shares[0] > $before" 15
  key ctrl+z
  expect "shares[0] <= $before" 15
fi
press Done "mode == 'VIEW'" 15

# lasso: the whole door; with Ctrl a corner leaves again
press Lasso "mode == 'VIEW'" 15
sleep 1
drag 300 530 395 530 395 860 300 860
expect "len(regions) == 1 and shares[0] > 0.02" 15
before=$(state 'shares[0]')
xdo keydown ctrl sleep 0.5
drag 290 800 345 800 345 870 290 870
xdo keyup ctrl
expect "shares[0] < $before" 15
picture 3-lasso
key Escape

# pick the wall with one click
press "Pick Material" "mode == 'VIEW'" 15
sleep 1
xdo mousemove $(at 450 400); sleep 0.3
drag 450 400 452 400
expect "len(regions) == 2 and shares[1] > 0.1" 30
picture 4-picked
key Escape
sleep 0.5

# the rest by itself; what was painted and picked stays
press "Auto Segment" "running or automatic" 20
expect "not running and automatic and len(regions) > len(automatic)" 120
picture 5-segmented

# extract two; the first appears while the second is made, Esc keeps it
tell keep_two
press "Extract Palette" running 20
expect "running and len(palette) == 1" 300
shot "${PALETTE_SHOT%.png}-6-running.png"
key Escape
expect "not running and len(palette) == 1 and not temporary and not error" 20

tell hurry
press "Extract Palette" running 20
expect "not running and len(palette) == 2 and previews and not error and not temporary" 300
picture 7-palette

# one undo step takes the second run back, redo brings it again
read -r x y w h <<<"$(region IMAGE_EDITOR WINDOW)"
xdo mousemove $((x + w / 3)) $((y + h / 2)) sleep 0.3
key ctrl+z
expect "len(palette) == 1" 20
key ctrl+shift+z
expect "len(palette) == 2" 20

# another one of the same region, compared with the one before
tell fold
press Variation running 20
expect "not running and seeds[0] == 1 and before[0]" 200
picture 8-variation
new=$(state 'images[0]')
press Compare "images[0] != '$new'" 10

# assign to the cube, which has no UV map
press "Assign and Map" "cube == palette[0] and uv == ['Palette Metres']" 10
xdo mousemove $((x + w / 3)) $((y + h / 2)) sleep 0.3
key ctrl+z
expect "cube != palette[0] and not uv" 10
key ctrl+shift+z
expect "cube == palette[0]" 10
picture 9-assigned

# what is saved is there again
before=$(state '(regions, palette, seeds, cube)')
tell save
tell reopen
expect "(regions, palette, seeds, cube) == $before" 20
