"""Corners and measures of regions as a script sets them, and corners from a camera that is matched to the photo."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from material_palette.core.rectification import plane_of_corners
from material_palette.operators import rectify


@pytest.fixture
def ready(settings, photo_and_masks):
    photo, masks = photo_and_masks
    bpy.ops.material_palette.open_photo(filepath=str(photo))
    bpy.ops.material_palette.import_masks(directory=str(masks))
    return settings


def add_camera(lens):
    data = bpy.data.cameras.new("camera")
    data.lens, data.sensor_width = lens, 36.0
    camera = bpy.data.objects.new("camera", data)
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    return camera


def add_plane(rotation):
    mesh = bpy.data.meshes.new("plane")
    plane = bpy.data.objects.new("plane", mesh)
    plane.rotation_euler = rotation
    bpy.context.scene.collection.objects.link(plane)
    bpy.context.view_layer.objects.active = plane
    bpy.context.view_layer.update()
    return plane


@pytest.mark.parametrize("rotation", [(0.9, 0.0, 0.0), (0.5, -0.6, 0.3), (-0.7, 0.2, 2.0)])
def test_corners_from_camera_lie_on_the_objects_plane(ready, rotation):
    add_camera(40.0)  # at the origin, looking along -Z: camera coordinates are the world's, but for the signs
    plane = add_plane(rotation)
    assert bpy.ops.material_palette.corners_from_camera() == {"FINISHED"}
    region = ready.regions[ready.active_region]
    assert region.has_corners and ready.focal_length == pytest.approx(40.0, rel=1e-4)
    width, height = ready.photo.size
    focal = 40.0 / 36.0 * max(width, height)
    corners = rectify.corners_of(region)
    to_photo, normal = plane_of_corners(corners, (height, width), focal)
    truth = np.array(plane.matrix_world.to_3x3().col[2]) * (1, -1, -1)
    assert abs(normal @ truth) == pytest.approx(1.0, abs=1e-4)
    back = np.linalg.inv(to_photo) @ np.append(corners, np.ones((4, 1)), 1).T
    assert (back[:2] / back[2]).T == pytest.approx(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), abs=1e-3)


def test_without_a_camera_or_an_object_it_says_so(ready):
    with pytest.raises(RuntimeError, match="no camera"):
        bpy.ops.material_palette.corners_from_camera()
    camera = add_camera(40.0)
    with pytest.raises(RuntimeError, match="No active object"):
        bpy.ops.material_palette.corners_from_camera()
    add_plane((np.pi / 2, 0.0, 0.0))
    camera.data.shift_x = 0.1
    with pytest.raises(RuntimeError, match="shifted"):
        bpy.ops.material_palette.corners_from_camera()


class Mouse(rectify._OverRegion):
    """Corners or measure of a region without a window: pixels of the editor are those of the photo."""

    def __init__(self, region, operator):
        self.key, self.held, self.reports = region.key, None, []
        self.begin, self.grab, self.keep = (f.__get__(self) for f in (operator.begin, operator.grab, operator.keep))
        self.points = self.begin(region)

    bl_label = "Mouse"
    in_photo = on_screen = staticmethod(lambda point: tuple(point))

    def report(self, kind, text):
        self.reports.append(text)

    def mouse(self, event):
        return event.place, True

    def __call__(self, value, place, kind="LEFTMOUSE"):
        return self.handle(bpy.context, SimpleNamespace(type=kind, value=value, place=place))


@pytest.mark.parametrize("press", ["PRESS", "DOUBLE_CLICK"])
def test_a_drag_belongs_to_the_region_that_it_began_with(ready, press):
    first, second = ready.regions
    rectify.set_corners(first, [[1, 1], [30, 1], [30, 20], [1, 20]])
    mouse = Mouse(first, rectify.MATERIAL_PALETTE_OT_corners)
    assert mouse(press, (1, 1)) == {"RUNNING_MODAL"}
    ready.active_region = 1
    mouse("RELEASE", (40, 40))
    assert rectify.corners_of(first)[0].tolist() == [40, 40] and not second.has_corners
    mouse(press, (40, 40))
    ready.active_region = 0
    bpy.ops.material_palette.remove_region()
    assert mouse("RELEASE", (50, 50)) == {"CANCELLED"} and mouse.reports == ["The region is gone"]
    assert not ready.regions[0].has_corners


def test_corners_and_measures_reach_the_extraction(ready):
    from material_palette.operators.extract import _read_order

    region = ready.regions[0]
    rectify.set_corners(region, [[1, 1], [30, 1], [30, 20], [1, 20]])
    region.measured, region.has_measure, region.measured_length = (1, 1, 30, 1), True, 0.25
    ready.focal_length, ready.rectify = 72.0, "quad"
    order = _read_order(ready, list(ready.regions), 0, True)
    corners, (points, metres) = order.geometry[region.name]
    assert corners.tolist() == [[1, 1], [30, 1], [30, 20], [1, 20]]
    assert points.tolist() == [[1, 1], [30, 1]] and metres == pytest.approx(0.25)
    assert order.focal == pytest.approx(2.0) and order.chosen["rectify"] == "quad"
    bpy.ops.material_palette.clear_corners()
    bpy.ops.material_palette.clear_measure()
    ready.active_region = 0
    bpy.ops.material_palette.clear_corners()
    assert _read_order(ready, list(ready.regions), 0, True).geometry[region.name][0] is None
