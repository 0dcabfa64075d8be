# Sourced once the window is ready: waits for redraws.py's result and shows it.
for ((i = 0; i < 600; i++)); do
  [ ! -e "$PALETTE_STATE" ] || break
  alive || { echo "Blender ended early" >&2; return 1; }
  sleep 0.5
done
cat "$PALETTE_STATE"
python3 - "$PALETTE_STATE" <<'PY'
import json, sys
sys.exit(json.load(open(sys.argv[1]))["error"])
PY
