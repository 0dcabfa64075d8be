#!/bin/bash
# The extension in a real Blender window: the example photo, real clicks, what the data holds afterwards, screenshots.
#
#   BLENDER_GUI=.../blender_gui.sh tests/gui/run.sh EXTENSION.zip OUT.png [artist|tools|card|library|interrupt|redraws]
#
# NAME.sh here drives the window from outside, NAME.py (or window.py) runs in Blender. artist, the default, goes from the
# photo to assigned materials, tools tries what it leaves out, card the eyedropper, library the preferences and what
# leaves the file; they also write OUT-STEP.png after their steps.
# Exit code 0 when all went as expected. PALETTE_EXAMPLE: another folder with photo.jpg and masks/.
# PALETTE_PATIENCE: a factor on all waits, for a busy machine (1).
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
if [ $# -lt 2 ]; then sed -n '2,10s/^# \{0,1\}//p' "$0" >&2; exit 2; fi
: "${BLENDER_GUI:?the path of blender_gui.sh}"

name=${3:-artist}
example=${PALETTE_EXAMPLE:-$(cd "$here/../../examples/facade" && pwd)}
mkdir -p "$(dirname "$2")"
out=$(cd "$(dirname "$2")" && pwd)/$(basename "$2")
export PALETTE_PHOTO="$example/photo.jpg" PALETTE_MASKS="$example/masks" PALETTE_SHOT=$out PALETTE_STATE="$out.state.json"
rm -f "$PALETTE_STATE" "$PALETTE_STATE.esc"
export BGUI_PASS="PALETTE_PHOTO PALETTE_MASKS PALETTE_STATE PALETTE_PATIENCE" BGUI_SHARE="$here:$example:$(dirname "$out")"
export PALETTE_STORIES=$here
script=$here/$name.py
[ -e "$script" ] || script=$here/window.py
code=0
GUI_DRIVE="$here/$name.sh" "$BLENDER_GUI" gui "$1" "$script" "$out" 2>&1 | tee "$out.txt" || code=$?
if [ "$name" = interrupt ]; then
  # this story ends with the end of Blender, which the driver reports with its exit code
  grep -q "Blender ended before the screenshot, code 0" "$out.txt" && ! grep -q "drive file failed" "$out.txt" && code=0
fi
if grep -q "^Traceback" "$out.log"; then
  sed -n '/^Traceback/,$p' "$out.log" >&2
  exit 1
fi
exit "$code"
