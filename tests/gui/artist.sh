# Sourced once the window is ready: works as an artist does, and looks at the data and takes a picture after each step.
. "$PALETTE_STORIES/window.sh"

tell set_up
expect "photo and not regions" 30
picture 1-photo

# paint the door with the brush, where Blender has brushes (some distributions leave them out); undo takes a stroke back
press Paint "mode == 'PAINT' and len(regions) == 1" 15
sleep 2
if [ "$(state brush)" = True ]; then
  drag 350 600 350 800
  expect "shares[0] > 0.001" 15
  picture 2-painted
  before=$(state 'shares[0]')
  drag 350 800 450 800
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
