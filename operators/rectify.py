"""Corners, measure and camera of a region: what tells how its surface lies, when the photo alone does not."""

import bpy
import numpy as np
from bpy.types import Operator

from ..core.errors import PaletteError
from .draw_region import OverPhoto, draw_line
from .regions import NeedsRegion, read_photo_mask

_REACH = 14  # px of the screen, from a handle


def corners_of(region):
    """The active corners (4, 2) of a region in photo px from its upper left corner, None without."""
    return np.array(region.corners, float).reshape(4, 2) if region.has_corners else None


def measure_of(region):
    """Two points (2, 2) in photo px and the metres between them, None without."""
    return (np.array(region.measured, float).reshape(2, 2), region.measured_length) if region.has_measure else None


def set_corners(region, corners):
    region.corners = np.asarray(corners, float).ravel().tolist()
    region.has_corners = True


def set_measure(region, points, metres):
    region.measured = np.asarray(points, float).ravel().tolist()
    region.measured_length = metres
    region.has_measure = True


class _OverRegion(OverPhoto):
    """Mixin: handles on the photo that belong to the region active at first, dragged one at a time."""

    @classmethod
    def poll(cls, context):
        return super().poll(context) and bool(NeedsRegion.poll.__func__(cls, context))

    def invoke(self, context, event):
        settings = context.scene.material_palette
        try:
            region = settings.regions[settings.active_region]
            self.key, self.points = region.key, self.begin(region)
        except PaletteError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.held = None
        return super().invoke(context, event)

    def handle(self, context, event):
        place, usable = self.mouse(event)
        region = next((r for r in context.scene.material_palette.regions if r.key == self.key), None)
        if region is None:
            self.report({"ERROR"}, "The region is gone")
            return {"CANCELLED"}
        if event.type in {"RET", "NUMPAD_ENTER"} and event.value == "PRESS":
            return {"FINISHED"}
        if event.type == "LEFTMOUSE" and event.value in {"PRESS", "DOUBLE_CLICK"}:
            if not usable:
                return None
            self.held = self.grab(place)
        if self.held is not None and event.type in {"LEFTMOUSE", "MOUSEMOVE"}:
            self.points[self.held] = self.in_photo(place)
        if event.type == "LEFTMOUSE" and event.value == "RELEASE" and self.held is not None:
            self.held = None
            self.keep(region)
            bpy.ops.ed.undo_push(message=self.bl_label)
        return {"RUNNING_MODAL"}

    def grab(self, place):
        """The index of the point under the mouse, None where there is none."""
        distances = [np.hypot(*np.subtract(self.on_screen(point), place)) for point in self.points]
        nearest = int(np.argmin(distances)) if distances else 0
        return nearest if distances and distances[nearest] < _REACH else None

    def on_screen(self, point):
        width, height = self.photo.size
        return self.region.view2d.view_to_region(point[0] / width, 1.0 - point[1] / height, clip=False)

    def draw_marks(self):
        screen = [self.on_screen(point) for point in self.points]
        if len(screen) > 1:
            draw_line([*screen, screen[0]])
        for x, y in screen:
            draw_line([(x - 5, y - 5), (x + 5, y - 5), (x + 5, y + 5), (x - 5, y + 5), (x - 5, y - 5)])


class MATERIAL_PALETTE_OT_corners(_OverRegion, Operator):
    """Drag four points onto the corners of something that is a rectangle on the region's surface, such as a tile, a
    window or a board; the region is then seen from the front"""

    bl_idname = "material_palette.corners"
    bl_label = "Set Corners"
    hint = "Drag the corners onto a rectangle on the surface, the first one to its top left   Enter or Esc: done"

    def begin(self, region):
        corners = corners_of(region)
        if corners is None:
            mask = read_photo_mask(region, bpy.context.scene.material_palette.photo)
            rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
            if not len(rows):
                raise PaletteError(f"Region '{region.name}' is empty; paint it first")
            top, bottom = np.percentile(rows, (20, 80))
            left, right = np.percentile(columns, (20, 80))
            corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
        return np.asarray(corners, float)

    def keep(self, region):
        set_corners(region, self.points)


class MATERIAL_PALETTE_OT_measure(_OverRegion, Operator):
    """Drag a line over something of known length on the region's surface; type the length into the panel"""

    bl_idname = "material_palette.measure"
    bl_label = "Measure"
    hint = "Drag over a known length on the surface   Enter or Esc: done"

    def begin(self, region):
        measure = measure_of(region)
        return np.zeros((0, 2)) if measure is None else measure[0]

    def grab(self, place):
        held = super().grab(place)
        if held is None:
            self.points = np.array([self.in_photo(place)] * 2)
            held = 1
        return held

    def keep(self, region):
        if np.linalg.norm(self.points[1] - self.points[0]) >= 2:
            region.measured = self.points.ravel().tolist()
            region.has_measure = True


class _Forgets(NeedsRegion):
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        settings = context.scene.material_palette
        setattr(settings.regions[settings.active_region], self.flag, False)
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_clear_corners(_Forgets, Operator):
    """Forget the region's corners: its slant is found, or it stays as it is"""

    bl_idname = "material_palette.clear_corners"
    bl_label = "Clear Corners"
    flag = "has_corners"


class MATERIAL_PALETTE_OT_clear_measure(_Forgets, Operator):
    """Forget the region's measure: its tile has the size set for all"""

    bl_idname = "material_palette.clear_measure"
    bl_label = "Clear Measure"
    flag = "has_measure"


class MATERIAL_PALETTE_OT_corners_from_camera(NeedsRegion, Operator):
    """Take the region's corners from the scene's camera, matched to the photo, and from the active object, whose XY
    plane lies on the surface"""

    bl_idname = "material_palette.corners_from_camera"
    bl_label = "Corners from Camera"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        from ..core.rectification import corners_on_plane

        scene, settings, object_ = context.scene, context.scene.material_palette, context.active_object
        try:
            if scene.camera is None or scene.camera.type != "CAMERA":
                raise PaletteError("The scene has no camera: match one to the photo first")
            if object_ is None or object_ == scene.camera:
                raise PaletteError("No active object: put a plane onto the surface and make it the active object")
            focal = focal_length(scene.camera.data, settings.photo.size)
            turn = scene.camera.matrix_world.to_3x3().normalized().inverted() @ object_.matrix_world.to_3x3()
            # Blender's cameras look along -Z with Y up
            axes = np.array(turn.normalized().transposed()) * (1.0, -1.0, -1.0)
            region = settings.regions[settings.active_region]
            set_corners(region, corners_on_plane(axes[0], axes[1], focal, read_photo_mask(region, settings.photo)))
        except PaletteError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        settings.focal_length = focal / max(settings.photo.size) * 36.0
        return {"FINISHED"}


def focal_length(camera, size):
    """Focal length of a Blender camera in px of a photo of `size` (width, height) that fills its frame.

    Raises PaletteError for a camera that does not see as a photo does.
    """
    if camera.type != "PERSP":
        raise PaletteError(f"Camera '{camera.name}' is not a perspective one")
    if abs(camera.shift_x) > 1e-4 or abs(camera.shift_y) > 1e-4:
        raise PaletteError(f"Camera '{camera.name}' is shifted; photos are taken as unshifted")
    width, height = size
    if camera.sensor_fit == "VERTICAL":
        return camera.lens / camera.sensor_height * height
    return camera.lens / camera.sensor_width * (width if camera.sensor_fit == "HORIZONTAL" else max(size))


CLASSES = (
    MATERIAL_PALETTE_OT_corners,
    MATERIAL_PALETTE_OT_measure,
    MATERIAL_PALETTE_OT_clear_corners,
    MATERIAL_PALETTE_OT_clear_measure,
    MATERIAL_PALETTE_OT_corners_from_camera,
)
