"""Pick Material: click on a material in the photo, see the region that is made of it, drag for the tolerance."""

import threading

import bpy
import numpy as np
from bpy.props import BoolProperty
from bpy.types import Operator

from ..core.errors import PaletteError
from .draw_region import OverPhoto, draw_line
from .photo import photo_reader, photo_state
from .preferences import pick_weights
from .regions import add_region, set_mask

_DRAG = 300.0  # px of dragging for the whole range of the tolerance
_features = {}  # what has looked at one photo: that takes a second and is the same for every click


def picker_of(photo, weights=""):
    """What answers clicks on the photo; raises PaletteError when photo or weights can't be read."""
    key = _key(photo, weights)
    if key not in _features:
        look(key, photo_reader(photo), weights)
    return _features[key]


def look(key, read, weights):
    from ..core.segmentation import picker

    found = picker(weights)
    found.look(read()[0])
    _features.clear()
    _features[key] = found


def forget():
    _features.clear()


def select(photo, clicks, tolerance, weights="", box=None):
    """(H, W) bool of the photo's size: what is of the clicked material.

    clicks: (x, y, positive) in px of the photo from its upper left corner. weights: of Segment Anything or
    Materialistic instead of what ships; the first also takes a box, (left, top, right, bottom) in px of the photo.
    """
    from ..core.segmentation.pick import Click

    found = picker_of(photo, weights)
    width, height = photo.size
    rows, columns = found.shape
    scaled = [Click(x * columns / width, y * rows / height, positive) for x, y, positive in clicks]
    if box is None:
        mask = found.select(scaled, tolerance)
    else:
        scale = (columns / width, rows / height) * 2
        mask = found.select(scaled, tolerance, box=tuple(a * b for a, b in zip(box, scale, strict=True)))
    if mask.shape != (height, width):  # a huge photo is reduced when it is read
        across = (np.arange(height) * rows // height)[:, None], np.arange(width) * columns // width
        mask = mask[across]
    return mask


def _key(photo, weights):
    return *photo_state(photo), weights


class MATERIAL_PALETTE_OT_pick_region(OverPhoto, Operator):
    """Click on a material in the photo: a new region of all that is made of it. Drag to widen or narrow, Shift adds a
    place, Ctrl takes one away"""

    bl_idname = "material_palette.pick_region"
    bl_label = "Pick Material"

    extend: BoolProperty(
        name="Extend", description="Begin with the active region's material", options={"SKIP_SAVE", "HIDDEN"}
    )

    @property
    def hint(self):
        box = "   Alt and drag: box" if self.takes_box else ""
        return f"Click, drag for tolerance   Shift: add a place   Ctrl: take one away{box}   Esc or right button: done"

    @property
    def takes_box(self):
        found = _features.get(_key(self.photo, self.weights))  # not there yet: still looking at the photo
        return found is not None and found.takes_box

    def invoke(self, context, event):
        self.clicks, self.tolerance, self.key = [], 0.5, None
        self.box, self.corner, self.weights = None, None, pick_weights(context)
        self.pressed, self.at_press, self.shown = None, 0.5, 0.5
        self.failure, self.thread, self.timer, self.waiting = None, None, None, False
        result = super().invoke(context, event)
        if "RUNNING_MODAL" in result:
            self._look(context)
        return result

    def _look(self, context):
        """Find the photo's features on a thread: the first click must not wait in a frozen window."""
        key, weights = _key(self.photo, self.weights), self.weights
        if key in _features:
            return
        try:
            read = photo_reader(self.photo)
        except PaletteError as error:
            self.failure = error
            return

        def work():
            try:
                look(key, read, weights)
            except Exception as error:
                self.failure = error

        self.thread = threading.Thread(target=work, name="material_palette_pick", daemon=True)
        self.thread.start()
        self.timer = context.window_manager.event_timer_add(0.1, window=context.window)

    def modal(self, context, event):
        if event.type == "TIMER" and self.waiting and not self.thread.is_alive():
            if self.failure is not None:
                return self.end(context, self.handle(context, event))
            self._apply(context)
            if self.pressed is None:
                bpy.ops.ed.undo_push(message="Pick Material")
        return super().modal(context, event)

    def end(self, context, result):
        if self.timer is not None:
            context.window_manager.event_timer_remove(self.timer)
            self.timer = None
        return super().end(context, result)

    def handle(self, context, event):
        if self.failure is not None:
            self.report({"ERROR"}, str(self.failure))
            return {"CANCELLED"}
        place, usable = self.mouse(event)
        if event.type == "LEFTMOUSE" and event.value in {"PRESS", "DOUBLE_CLICK"}:
            if not usable:
                return None
            x, y = self.in_photo(place)
            width, height = self.photo.size
            if not (0 <= x < width and 0 <= y < height):
                return {"RUNNING_MODAL"}
            if event.alt and self.takes_box:
                self.clicks, self.key, self.box, self.corner = [], None, None, place
                return {"RUNNING_MODAL"}
            if not (event.shift or event.ctrl):
                self.clicks, self.key, self.box = [], None, None  # another material
            if self.clicks or self.box or not event.ctrl:
                self.clicks.append((x, y, not event.ctrl))
                self.pressed, self.at_press = place, self.tolerance
                self._apply(context)
        elif self.corner is not None and event.type in {"MOUSEMOVE", "LEFTMOUSE"}:
            self.box = self._box(place)
            if event.type == "LEFTMOUSE" and event.value == "RELEASE":
                self.corner = None
                if min(self.box[2] - self.box[0], self.box[3] - self.box[1]) < 1:
                    self.box = None
                else:
                    self._finish(context)
        elif event.type == "MOUSEMOVE" and self.pressed is not None:
            change = (place[0] - self.pressed[0]) / _DRAG
            self.tolerance = min(max(self.at_press + change, 0.0), 1.0)
            if abs(self.tolerance - self.shown) > 0.01:
                self._apply(context)
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            if self.pressed is not None:
                self.pressed = None
                self._finish(context)
        elif event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}:
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def _box(self, place):
        """(left, top, right, bottom) in px of the photo, of what is dragged so far."""
        (x, y), (u, v) = self.in_photo(self.corner), self.in_photo(place)
        self.dragged = self.corner, place
        width, height = self.photo.size
        left, right = (min(max(at, 0), width) for at in sorted((x, u)))
        top, bottom = (min(max(at, 0), height) for at in sorted((y, v)))
        return left, top, right, bottom

    def _finish(self, context):
        self._apply(context)
        if not self.waiting:
            bpy.ops.ed.undo_push(message="Pick Material")

    def _apply(self, context):
        """Select what was clicked, or, while the photo is still being looked at, wait for the timer to do it."""
        self.waiting = self.thread is not None and self.thread.is_alive()
        if self.waiting:
            context.workspace.status_text_set(f"Looking at the photo ...   {self.hint}")
            return
        if self.failure is not None:
            return
        settings = context.scene.material_palette
        self.shown = self.tolerance
        mask = select(self.photo, self.clicks, self.tolerance, self.weights, self.box)
        region = next((r for r in settings.regions if r.key == self.key), None)
        if region is None:
            self.key = add_region(settings, "Picked", mask).key
        else:
            set_mask(region, mask)
        self.area.tag_redraw()
        text = f"Tolerance {self.tolerance:.0%}, {mask.mean():.1%} of the photo"
        context.workspace.status_text_set(f"{text}   {self.hint}")

    def draw_marks(self):
        if self.corner is not None and self.box is not None:
            (x, y), (u, v) = self.dragged
            draw_line([(x, y), (u, y), (u, v), (x, v), (x, y)])
        if self.pressed is not None:
            x, y = self.pressed
            draw_line([(x - _DRAG * self.at_press, y), (x + _DRAG * (1.0 - self.at_press), y)])
            at = x + _DRAG * (self.tolerance - self.at_press)
            draw_line([(at, y - 6), (at, y + 6)])


CLASSES = (MATERIAL_PALETTE_OT_pick_region,)
