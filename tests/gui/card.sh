# Sourced once the window is ready: a grey card's colour, taken from the photo with the eyedropper.
. "$PALETTE_STORIES/window.sh"

tell set_up
press_text Options
tell card
scroll
read -r _ y <<<"$(find_text 'Keep Concepts' IMAGE_EDITOR UI || find_text KeepConcepts IMAGE_EDITOR UI)"
read -r x _ w _ <<<"$(state "' '.join(map(str, sidebar))")"
# over the colour's field, a row above, the key E takes the eyedropper
dropper() {
  xdo mousemove $((x + w * 2 / 3)) $((y - 23)) sleep 1
  key e
  sleep 1
  xdo mousemove $(at $(state card_place)) sleep 1 click 1
}
again_until "max(abs(a - b) for a, b in zip(card, at_card)) < 0.02" dropper
picture card
