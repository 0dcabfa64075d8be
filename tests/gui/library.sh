# Sourced once the window is ready: the preferences, and what leaves the file: asset library, export, Asset Browser.
. "$PALETTE_STORIES/window.sh"

tell add_library
tell show_preferences
sleep 2
picture preferences
tell hide_preferences
sleep 3

# an engine that lacks something says so where it is chosen
tell two_regions
tell diffusion
picture diffusion
tell patch
press_text Options
picture options
press_text Options
sleep 1
press "Extract Palette" running 20
expect "not running and len(palette) == 2 and not error" 200
picture extracted

# one material in the place of another, chosen from the list of all
scroll
replace() {
  popped press_text Replace
  xdo type --delay 80 Material
  sleep 1
  key Return
}
again_until "cube in palette" replace
picture replaced

# into an asset library
scroll
library() {
  popped press_text "To Library"
  picture to-library
  key Return
}
again_until "'photo palette.blend' in library and 'blender_assets.cats.txt' in library" library

# for other programs
scroll
export_() {
  press_text Export
  sleep 3
  tell choose_folder
  sleep 2
  picture export
  xdo mousemove $(spot browser 500 900) sleep 0.5
  key Return
}
again_until "any(name.endswith('.mtlx') for name in exported)" export_
expect "any(name.endswith('_orm.png') for name in exported)" 10
sleep 2

# from the Asset Browser onto the cube
tell bare_cube
tell look_at_objects
tell browse_assets
sleep 4
picture assets
carry_asset() { carry $(state "'%d %d' % (browser[0] + 60, browser[1] + 60)") $(spot view 500 500); }
again_until "cube in palette" carry_asset
picture carried
