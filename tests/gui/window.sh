# What the stories share: how they wait for the data, find a button, and use the mouse over the photo.

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
# the recognition of text now and then joins two words
press_text() { click_text "$1" IMAGE_EDITOR UI 2>/dev/null || click_text "${1// /}" IMAGE_EDITOR UI; }
# press TEXT CONDITION SECONDS: click on a button of the sidebar; a second time where a busy machine has lost the click
press() {
  local tries
  for tries in 1 2; do
    sleep 1
    press_text "$1"
    if expect "$2" "$((tries == 1 ? 8 : $3))" quietly; then return 0; fi
  done
  expect "$2" 1
}
# popped COMMAND...: run it and wait until the screen beside the sidebar has changed
popped() {
  local before i
  before=$(beside)
  "$@"
  for ((i = 0; i < 20 * ${PALETTE_PATIENCE:-1}; i++)); do
    sleep 0.5
    if [ "$(beside)" != "$before" ]; then sleep 1; return 0; fi
  done
  echo "nothing popped up after $*" >&2
  return 1
}
beside() {
  xc bash -c 'for part in 700x700+300+150 250x350+1340+500; do import -window root -crop $part rgb:-; done | md5sum'
}
# at X Y: pixel of the screen for a place in the photo, in thousandths of its width and height
at() { python3 - "$PALETTE_STATE" "$1" "$2" <<'PY'
import json, sys
left, top, right, bottom = json.load(open(sys.argv[1]))["rectangle"]
x, y = (int(v) / 1000 for v in sys.argv[2:])
print(round(left + x * (right - left)), round(top + y * (bottom - top)))
PY
}
# drag X Y X Y ...: the left button held from place to place of the photo. A busy Blender takes a press for one at the
# place where the mouse is by then.
drag() {
  local held=0
  while [ $# -ge 2 ]; do
    xdo mousemove $(at "$1" "$2"); sleep 0.15
    ((held)) || { xdo mousedown 1; sleep ${PALETTE_PATIENCE:-1}; held=1; }
    shift 2
  done
  xdo mouseup 1
  sleep 0.3
}
# spot NAME X Y: pixel of the screen at thousandths of the rectangle NAME of the state
spot() { state "'%d %d' % (${1}[0] + ${1}[2] * $2 / 1000, ${1}[1] + ${1}[3] * $3 / 1000)"; }
# carry X Y TO_X TO_Y: drag and drop on the screen
carry() {
  local wait=${PALETTE_PATIENCE:-1}
  xdo mousemove "$1" "$2" sleep 0.5 mousedown 1 sleep "$wait" mousemove_relative 12 12 sleep 0.5
  xdo mousemove $((($1 + $3) / 2)) $((($2 + $4) / 2)) sleep 0.5 mousemove "$3" "$4" sleep "$wait" mouseup 1
}
# the sidebar to its end
scroll() {
  xdo mousemove $(spot sidebar 300 400) sleep 0.5 click --repeat 40 --delay 40 5
  sleep 2
}
# type TEXT into the field right of the label LABEL of the sidebar
fill() {
  local x y w h left
  read -r left y <<<"$(find_text "$1" IMAGE_EDITOR UI)"
  read -r x _ w h <<<"$(state "' '.join(map(str, sidebar))")"
  xdo mousemove $((x + w * 2 / 3)) "$y" sleep 0.3 click --repeat 2 --delay 60 1 sleep 0.5
  key ctrl+a
  xdo type --delay 80 "$2"
  key Return
}

# again_until CONDITION COMMAND...: what a busy machine has lost is done again
again_until() {
  local tries condition=$1
  shift
  for tries in 1 2; do
    "$@"
    if expect "$condition" 8 quietly; then return 0; fi
  done
  "$@"
  expect "$condition" 15
}
