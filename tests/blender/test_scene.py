"""What the cameras of a scene can show of a material."""

import bpy
import numpy as np
import pytest
from stage import camera, plane

WIDTH, HEIGHT = 400, 200


@pytest.fixture
def stone(make_record, write_maps, tmp_path):
    from material_palette.core.nodes import build_material

    return build_material(make_record(write_maps(), metres_per_tile=0.5), tmp_path, pack=False)


@pytest.fixture
def scene(stone):
    """A wall of 2 x 2 m, its UV map in metres, seen from the front by an orthographic camera 4 m wide."""
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = WIDTH, HEIGHT, 100
    scene.frame_end = 1
    plane("wall", stone, 2.0)
    camera("front", (0, 0, 5))
    return scene


def seen(scene, stone):
    from material_palette.core.scene import look

    bpy.context.view_layer.update()
    return look(scene, [stone])["stone"]


def test_pixels_per_tile_of_an_orthographic_camera(scene, stone):
    # 100 px to the metre, half a metre to the tile
    found = seen(scene, stone)
    assert found.texels == pytest.approx(50, rel=1e-3) and found.why == ""
    assert found.share == pytest.approx(0.5, abs=0.03)  # 2 x 2 m of 4 x 2 m


def test_pixels_per_tile_of_a_perspective_camera(scene, stone):
    bpy.data.objects["front"].data.type = "PERSP"
    bpy.data.objects["front"].data.angle = 2 * np.arctan(0.5)  # 5 m wide at 5 m
    assert seen(scene, stone).texels == pytest.approx(0.5 * WIDTH / 5, rel=1e-3)


def test_resolution_object_and_mapping_scale_count(scene, stone):
    scene.render.resolution_percentage = 50
    assert seen(scene, stone).texels == pytest.approx(25, rel=1e-3)
    bpy.data.objects["wall"].scale = (2, 2, 2)  # the texture is stretched with the object
    assert seen(scene, stone).texels == pytest.approx(50, rel=1e-3)
    from material_palette.core.nodes import Controls

    Controls(stone).tile_size = 1.0
    assert seen(scene, stone).texels == pytest.approx(100, rel=1e-3)


def test_a_slanted_surface_is_judged_by_its_longer_side(scene, stone):
    bpy.data.objects["wall"].rotation_euler = (np.radians(80), 0, 0)
    assert seen(scene, stone).texels == pytest.approx(50, rel=1e-3)


def test_the_nearest_of_all_cameras_and_frames_counts(scene, stone):
    camera("near", (0, 0, 5), scale=1.0)
    assert seen(scene, stone).texels == pytest.approx(200, rel=1e-3)
    bpy.data.objects.remove(bpy.data.objects["near"])
    lens = bpy.data.cameras["front"]
    for frame, scale in ((1, 4.0), (100, 2.0)):
        lens.ortho_scale = scale
        lens.keyframe_insert("ortho_scale", frame=frame)
    scene.frame_end, scene.frame_current = 100, 7
    assert seen(scene, stone).texels == pytest.approx(100, rel=1e-3)
    assert scene.frame_current == 7


def test_what_is_hidden_behind_something_is_not_seen(scene, stone):
    bpy.data.objects["wall"].location.y = 0
    screen = plane("screen", bpy.data.materials.new("other"), 3.0, 1.0)
    assert seen(scene, stone).texels == 0
    glass = bpy.data.materials.new("glass")
    glass.use_nodes = True
    next(n for n in glass.node_tree.nodes if n.bl_idname == "ShaderNodeBsdfPrincipled").inputs[
        "Transmission Weight"
    ].default_value = 1.0
    screen.data.materials[0] = glass
    assert seen(scene, stone).texels == pytest.approx(50, rel=1e-3)


def test_modifiers_count(scene, stone):
    wall = bpy.data.objects["wall"]
    wall.modifiers.new("grid", "SUBSURF").subdivision_type = "SIMPLE"
    array = wall.modifiers.new("row", "ARRAY")
    array.count = 2
    found = seen(scene, stone)
    assert found.texels == pytest.approx(50, rel=1e-3) and found.share == pytest.approx(0.75, abs=0.03)


def test_a_mesh_without_uv_map_shows_one_texel(scene, stone):
    mesh = bpy.data.objects["wall"].data
    mesh.uv_layers.remove(mesh.uv_layers[0])
    found = seen(scene, stone)
    assert found.texels == 0 and found.share > 0.4


def test_what_cannot_be_judged_says_why(scene, stone):
    bpy.data.objects["wall"].hide_viewport = True
    assert "hidden" in seen(scene, stone).why
    bpy.data.objects["wall"].hide_viewport = False
    tree = stone.node_tree
    mapping = tree.nodes["Palette Mapping"]
    tree.links.remove(mapping.inputs["Vector"].links[0])
    assert "UV" in seen(scene, stone).why


def test_without_a_camera_it_says_so(scene, stone):
    from material_palette.core.errors import PaletteError

    bpy.data.objects.remove(bpy.data.objects["front"])
    with pytest.raises(PaletteError, match="camera"):
        seen(scene, stone)
