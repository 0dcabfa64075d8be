# Sourced once the window is ready: waits for the end of interrupt.py's story and fails with its error.
# The mouse moves as a user's does: Blender 4.3 drops the handler of an unregistered operator only with the next event,
# and crashes when another one starts before.
read -r x y w h <<<"$(region VIEW_3D WINDOW)"
for ((i = 0; i < 900 * ${PALETTE_PATIENCE:-1}; i++)); do
  [ ! -e "$PALETTE_STATE" ] || break
  alive || { echo "Blender ended early" >&2; return 1; }
  xdo mousemove $((x + w / 4 + i % 2 * 20)) $((y + h / 2))
  [ ! -e "$PALETTE_STATE.esc" ] || key Escape
  sleep 0.5
done
python3 - "$PALETTE_STATE" <<'PY'
import json, sys
sys.exit(json.load(open(sys.argv[1]))["error"])
PY
# the story ends by quitting during a run
for ((i = 0; i < 120; i++)); do alive || break; xdo mousemove $((x + w / 4 + i % 2 * 20)) $((y + h / 2)); sleep 0.5; done
! alive
