# Sourced once the window is ready: what the artist's story leaves out, each tool once, with the mouse.
. "$PALETTE_STORIES/window.sh"

# a photo dropped from Blender's file browser
tell browse
sleep 2
at=$(find_text photo.jpg || find_text photo.ipg)
drop() {
  carry $at $(spot editor 300 500)
  picture drop
  key p # Blender asks: Open Images or Open Photo
}
again_until "photo == 'photo.jpg'" drop
picture dropped
echo "paste is offered: $(state pastes)"

# corners by their handles, and a length; both end with Enter
tell masks
press Corners "'MATERIAL_PALETTE_OT_corners' in modal" 10
sleep 1
again_until "corners and abs(corners[0] - 0.100 * size[0]) < 4 and abs(corners[1] - 0.150 * size[1]) < 4" \
  drag $(state "' '.join(map(str, handle))") 100 150
key Return
expect "not modal" 10
press Measure "'MATERIAL_PALETTE_OT_measure' in modal" 10
sleep 1
again_until "measured and abs(measured[2] - 0.6 * size[0]) < 4 and abs(measured[3] - 0.32 * size[1]) < 4" drag 200 300 600 320
key Return
expect "not modal" 10
picture corners

# a region alone, made larger from what is kept of it
tell clear
read -r x y <<<"$(find_text 'Extract Palette' IMAGE_EDITOR UI)"
again_until running click $((x + 110)) "$y"
expect "not running and len(palette) == 1 and max(widths) <= 64 and not error" 200
tell larger
scroll
press Resample running 20
expect "not running and len(palette) == 1 and before[0] and not error" 200
picture resampled

# an adjustment is seen on the preview, and undone there
scroll
before=$(state seen)
again_until "abs(brightness - 0.4) < 1e-3" fill Brightness 0.4
expect "seen < 0.85 * $before" 30
picture adjusted
read -r x y <<<"$(spot editor 300 500)"
xdo mousemove "$x" "$y" sleep 0.3
key ctrl+z
expect "brightness == 1 and abs(seen - $before) < 0.02" 30

# the search finds what stands in menus
# keys before it is there would be Blender's shortcuts; the key F3 itself doesn't arrive in Debian's Blender 5.2
popped key F3 || popped tell search
xdo type --delay 80 "palette restore"
sleep 2
picture search
key Return
expect "resolution == 1024" 10

# onto an object from the shelf, onto a face by a click
tell look_at_objects
sleep 2
scroll
press "Shelf to Drag From" shelf 20
sleep 3
picture shelf
again_until "cube == palette[0]" \
  carry $(state "'%d %d' % (shelf[0] + 50, shelf[1] + shelf[3] / 2)") $(spot view 500 500)
picture carried
tell one_face
scroll
press Assign "slots == [None, palette[0]]" 10
tell leave_edit_mode
expect "faces == [0, 0, 1, 0, 0, 0]" 10
picture face
