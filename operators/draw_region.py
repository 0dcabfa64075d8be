"""Lasso, polygon and box over the photo in the Image Editor: what is inside joins or leaves the active region."""

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty
from bpy.types import Operator

from ..core.errors import PaletteError
from .regions import NeedsPhoto, add_region, image_editor, read_photo_mask, set_mask, show_photo
from .setup import NeedsPackages

_handlers = set()  # of what is drawn by operators at work
_NEAR = 10  # px; a click that near to a polygon's first corner closes it


def apply_outline(settings, points, take_away=False):
    """Add the inside of `points` (n, 2), x and y in px of the photo from its upper left corner, to the active region,
    or take it away; without a region make one. Raises PaletteError for a mask that can't be used."""
    from ..core.mask import polygon

    width, height = settings.photo.size
    inside = polygon((height, width), points)
    if settings.active_region >= len(settings.regions):
        add_region(settings, "Region", inside)
        return
    region = settings.regions[settings.active_region]
    mask = read_photo_mask(region, settings.photo)
    set_mask(region, mask & ~inside if take_away else mask | inside)


def forget():
    """The extension is switched off while a tool is in use: nothing of it may be drawn any longer."""
    for handler in list(_handlers):
        _remove(handler)


def _remove(handler):
    _handlers.remove(handler)
    bpy.types.SpaceImageEditor.draw_handler_remove(handler, "WINDOW")


class OverPhoto(NeedsPackages, NeedsPhoto):
    """Mixin of a modal operator that is used with the mouse over the photo in the Image Editor.

    A subclass gives `handle(context, event)`, which returns a modal result, or None to let Blender have the event, and
    `draw_marks()` in pixels of the editor. Esc and the right button end it; zooming and panning work meanwhile.
    """

    bl_options = {"REGISTER"}
    hint = ""
    _PASSED = {"MIDDLEMOUSE", "WHEELUPMOUSE", "WHEELDOWNMOUSE", "TRACKPADPAN", "TRACKPADZOOM", "TIMER", "HOME"}

    def execute(self, context):
        self.report({"ERROR"}, f"{self.bl_label} needs a window and a mouse")
        return {"CANCELLED"}

    def invoke(self, context, event):
        self.area = image_editor(context)
        if self.area is None:
            self.report({"ERROR"}, "No Image Editor in this window: open one beside this editor")
            return {"CANCELLED"}
        show_photo(context, self.area)
        self.region = next(region for region in self.area.regions if region.type == "WINDOW")
        self.photo = context.scene.material_palette.photo
        self.handler = bpy.types.SpaceImageEditor.draw_handler_add(self._draw, (), "WINDOW", "POST_PIXEL")
        _handlers.add(self.handler)
        context.window_manager.modal_handler_add(self)
        context.window.cursor_modal_set("CROSSHAIR")
        context.workspace.status_text_set(self.hint)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if self.area not in list(context.window.screen.areas) or self.area.type != "IMAGE_EDITOR":
            return self.end(context, {"CANCELLED"})
        if event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            return self.end(context, self.stop(context))
        if event.type in self._PASSED or event.type.startswith("NUMPAD"):
            return {"PASS_THROUGH"}
        try:
            result = self.handle(context, event)
        except BaseException:
            self.end(context, {"CANCELLED"})
            raise
        self.region.tag_redraw()
        if result is None:
            return {"PASS_THROUGH"}
        return self.end(context, result) if result & {"FINISHED", "CANCELLED"} else result

    def stop(self, context):
        """The user has ended it; return what the operator returns."""
        return {"FINISHED"}

    def cancel(self, context):
        self.end(context, {"CANCELLED"})

    def end(self, context, result):
        if self.handler in _handlers:
            _remove(self.handler)
            context.window.cursor_modal_restore()
            context.workspace.status_text_set(None)
            if self.area in list(context.window.screen.areas):
                self.area.tag_redraw()
        return result

    def mouse(self, event):
        """The mouse in pixels of the editor's main region, and whether it is over nothing else."""
        x, y = event.mouse_x - self.region.x, event.mouse_y - self.region.y
        inside = 0 <= x < self.region.width and 0 <= y < self.region.height
        covered = any(
            region.type in {"UI", "TOOLS", "HEADER", "TOOL_HEADER", "ASSET_SHELF", "HUD"}
            and region.width > 1
            and region.x <= event.mouse_x < region.x + region.width
            and region.y <= event.mouse_y < region.y + region.height
            for region in self.area.regions
        )
        return (x, y), inside and not covered

    def in_photo(self, point):
        """A point of the editor in px of the photo, from its upper left corner."""
        width, height = self.photo.size
        x, y = self.region.view2d.region_to_view(*point)
        return x * width, (1.0 - y) * height

    def _draw(self):
        if bpy.context.area == self.area:
            self.draw_marks()


_SHAPES = (
    ("LASSO", "Lasso", "Drag around the region"),
    ("POLYGON", "Polygon", "Click the corners; a double click or Enter closes it"),
    ("BOX", "Box", "Drag from corner to corner"),
)


class MATERIAL_PALETTE_OT_draw_region(OverPhoto, Operator):
    """Draw an outline over the photo; what is inside joins the active region, or leaves it with Ctrl held"""

    bl_idname = "material_palette.draw_region"
    bl_label = "Draw Region"

    shape: EnumProperty(name="Shape", description="What is drawn", items=_SHAPES)
    new: BoolProperty(name="New Region", description="Make a new region of what is drawn", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context, properties):
        how = next(description for shape, _, description in _SHAPES if shape == properties.shape)
        return f"{how}. What is inside joins the active region, with Ctrl it leaves it"

    @property
    def hint(self):
        how = {"LASSO": "Drag around a region", "BOX": "Drag a box", "POLYGON": "Click corners, Enter closes"}
        return f"{how[self.shape]}   Ctrl: take away   Esc or right button: done"

    def invoke(self, context, event):
        self.points, self.drawing, self.take_away, self.place = [], False, False, (0, 0)
        return super().invoke(context, event)

    def handle(self, context, event):
        self.place, usable = self.mouse(event)
        if self.shape == "POLYGON":
            return self._corner(context, event, usable)
        if event.type == "LEFTMOUSE" and event.value in {"PRESS", "DOUBLE_CLICK"}:
            if not usable:
                return None
            self.points, self.drawing, self.take_away = [self.place], True, event.ctrl
        elif event.type == "MOUSEMOVE" and self.drawing:
            self.points = [*self.points, self.place] if self.shape == "LASSO" else [self.points[0], self.place]
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE" and self.drawing:
            return self._close(context, event.ctrl or self.take_away)
        elif event.type == "LEFTMOUSE":
            return None
        return {"RUNNING_MODAL"}

    def _corner(self, context, event, usable):
        first = self.points[0] if self.points else None
        closes = event.type in {"RET", "NUMPAD_ENTER"} and event.value == "PRESS"
        if event.type == "LEFTMOUSE" and event.value in {"PRESS", "DOUBLE_CLICK"}:
            if not usable:
                return None
            at_first = first and max(abs(a - b) for a, b in zip(first, self.place, strict=True)) < _NEAR
            closes = len(self.points) > 2 and (at_first or event.value == "DOUBLE_CLICK")
            if not closes:
                self.points.append(self.place)
        elif event.type == "BACK_SPACE" and event.value == "PRESS" and self.points:
            self.points.pop()
        return self._close(context, event.ctrl) if closes else {"RUNNING_MODAL"}

    def outline(self):
        if self.shape == "BOX" and len(self.points) == 2:
            (left, bottom), (right, top) = self.points
            return [(left, bottom), (right, bottom), (right, top), (left, top)]
        return self.points

    def _close(self, context, take_away):
        points, self.points, self.drawing = self.outline(), [], False
        if len(points) < 3:
            return {"RUNNING_MODAL"}
        settings = context.scene.material_palette
        try:
            if self.new and not take_away:
                add_region(settings, "Region", None)
                self.new = False
            apply_outline(settings, np.array([self.in_photo(point) for point in points]), take_away)
        except PaletteError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        bpy.ops.ed.undo_push(message=f"{self.shape.title()} Region")
        self.area.tag_redraw()
        return {"RUNNING_MODAL"}

    def draw_marks(self):
        points = self.outline()
        if self.shape == "POLYGON" and points:
            points = [*points, self.place]
        if len(points) > 1:
            draw_line([*points, points[0]])


def draw_line(points):
    """A black and white line through `points` in pixels, to be seen on any photo."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    shader = gpu.shader.from_builtin("UNIFORM_COLOR")
    batch = batch_for_shader(shader, "LINE_STRIP", {"pos": [(float(x), float(y)) for x, y in points]})
    for width, colour in ((3.0, (0.0, 0.0, 0.0, 1.0)), (1.0, (1.0, 1.0, 1.0, 1.0))):
        gpu.state.line_width_set(width)
        shader.uniform_float("color", colour)
        batch.draw(shader)
    gpu.state.line_width_set(1.0)


CLASSES = (MATERIAL_PALETTE_OT_draw_region,)
