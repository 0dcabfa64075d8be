"""Pick Material: click on a material in the photo, see the region that is made of it, drag for the tolerance."""

import threading

import bpy
import numpy as np
from bpy.props import BoolProperty
from bpy.types import Operator

from ..core.errors import PaletteError
from .draw_region import OverPhoto, draw_line
from .photo import photo_reader
from .regions import add_region, set_mask

_DRAG = 300.0  # px of dragging for the whole range of the tolerance
_features = {}  # of one photo: they take a second and are the same for every click


def features_of(photo, progress=lambda fraction, message: None):
    """What `core.segmentation` finds in the photo's pixels; raises PaletteError when it can't be read."""
    key = _key(photo)
    if key not in _features:
        describe(key, photo_reader(photo), progress)
    return _features[key]


def describe(key, read, progress):
    from ..core.segmentation.features import describe as look

    found = look(read()[0], progress)
    _features.clear()
    _features[key] = found


def forget():
    _features.clear()


def select(photo, clicks, tolerance):
    """(H, W) bool of the photo's size: what is of the clicked material.

    clicks: (x, y, positive) in px of the photo from its upper left corner.
    """
    from ..core.segmentation.pick import Click, select

    features = features_of(photo)
    width, height = photo.size
    rows, columns = features.shape
    scaled = [Click(x * columns / width, y * rows / height, positive) for x, y, positive in clicks]
    mask = select(features, scaled, tolerance)
    if mask.shape != (height, width):  # a huge photo is reduced when it is read
        across = (np.arange(height) * rows // height)[:, None], np.arange(width) * columns // width
        mask = mask[across]
    return mask


def _key(photo):
    return photo.session_uid, tuple(photo.size), photo.filepath_raw


class MATERIAL_PALETTE_OT_pick_region(OverPhoto, Operator):
    """Click on a material in the photo: a new region of all that is made of it. Drag to widen or narrow, Shift adds a
    place, Ctrl takes one away"""

    bl_idname = "material_palette.pick_region"
    bl_label = "Pick Material"

    extend: BoolProperty(
        name="Extend", description="Begin with the active region's material", options={"SKIP_SAVE", "HIDDEN"}
    )

    hint = "Click a material, drag for tolerance   Shift: add a place   Ctrl: take one away   Esc or right button: done"

    def invoke(self, context, event):
        self.clicks, self.tolerance, self.key = [], 0.5, None
        self.pressed, self.at_press, self.shown = None, 0.5, 0.5
        self.failure, self.thread = None, None
        result = super().invoke(context, event)
        if "RUNNING_MODAL" in result:
            self._look(context)
        return result

    def _look(self, context):
        """Find the photo's features on a thread: the first click must not wait in a frozen window."""
        key = _key(self.photo)
        if key in _features:
            return
        try:
            read = photo_reader(self.photo)
        except PaletteError as error:
            self.failure = error
            return

        def work():
            try:
                describe(key, read, lambda fraction, message: None)
            except Exception as error:
                self.failure = error

        self.thread = threading.Thread(target=work, name="material_palette_pick", daemon=True)
        self.thread.start()

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
            if not (event.shift or event.ctrl):
                self.clicks, self.key = [], None  # another material
            if self.clicks or not event.ctrl:
                self.clicks.append((x, y, not event.ctrl))
                self.pressed, self.at_press = place, self.tolerance
                self._apply(context)
        elif event.type == "MOUSEMOVE" and self.pressed is not None:
            change = (place[0] - self.pressed[0]) / _DRAG
            self.tolerance = min(max(self.at_press + change, 0.0), 1.0)
            if abs(self.tolerance - self.shown) > 0.01:
                self._apply(context)
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            if self.pressed is not None:
                self.pressed = None
                self._apply(context)
                bpy.ops.ed.undo_push(message="Pick Material")
        elif event.type in {"MOUSEMOVE", "INBETWEEN_MOUSEMOVE"}:
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def _apply(self, context):
        settings = context.scene.material_palette
        if self.thread is not None:
            self.thread.join()
        if self.failure is not None:
            return
        self.shown = self.tolerance
        mask = select(self.photo, self.clicks, self.tolerance)
        region = next((r for r in settings.regions if r.key == self.key), None)
        if region is None:
            self.key = add_region(settings, "Picked", mask).key
        else:
            set_mask(region, mask)
        self.area.tag_redraw()
        text = f"Tolerance {self.tolerance:.0%}, {mask.mean():.1%} of the photo"
        context.workspace.status_text_set(f"{text}   {self.hint}")

    def draw_marks(self):
        if self.pressed is not None:
            x, y = self.pressed
            draw_line([(x - _DRAG * self.at_press, y), (x + _DRAG * (1.0 - self.at_press), y)])
            at = x + _DRAG * (self.tolerance - self.at_press)
            draw_line([(at, y - 6), (at, y + 6)])


CLASSES = (MATERIAL_PALETTE_OT_pick_region,)
