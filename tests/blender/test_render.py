"""Cycles renders what the maps say: colour, roughness and the direction of normals, from first principles."""

import bpy
import numpy as np
import pytest
from material_palette.core import nodes
from material_palette.core.image import srgb_from_linear, write_image

SIZE = 96


@pytest.fixture
def render(tmp_path):
    """render(material, sun=None, plane=False): (96, 96, 3) linear picture from above of a sphere or a plane.

    Light comes from a white sky of radiance 1, or with `sun`, a direction towards it, from there only with irradiance
    pi: a white matt surface that faces it has radiance 1 either way.
    """
    import OpenImageIO as oiio

    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = 16
    scene.cycles.use_denoising = False
    scene.cycles.pixel_filter_type = "BOX"
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type = "ORTHO"
    camera.data.ortho_scale = 2.0
    camera.location = (0, 0, 5)
    scene.collection.objects.link(camera)
    scene.camera = camera

    def render(material, sun=None, plane=False):
        add = bpy.ops.mesh.primitive_plane_add if plane else bpy.ops.mesh.primitive_uv_sphere_add
        add(**({"size": 4} if plane else {"radius": 1, "segments": 96, "ring_count": 48}))
        surface = bpy.context.object
        for polygon in surface.data.polygons:
            polygon.use_smooth = True
        surface.data.materials.append(material)
        world = scene.world = bpy.data.worlds.new("sky")
        if world.node_tree is None:
            world.use_nodes = True
        sky = next(node for node in world.node_tree.nodes if node.bl_idname == "ShaderNodeBackground")
        sky.inputs["Color"].default_value = (1, 1, 1, 1) if sun is None else (0, 0, 0, 1)
        lamp = None
        if sun is not None:
            from mathutils import Vector

            lamp = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
            lamp.data.energy = np.pi
            lamp.data.angle = 0.0
            lamp.rotation_euler = Vector(sun).to_track_quat("Z", "Y").to_euler()
            scene.collection.objects.link(lamp)
        path = tmp_path / "render.exr"
        scene.render.filepath = str(path)
        bpy.ops.render.render(write_still=True)
        picture = oiio.ImageInput.open(str(path))
        pixels = np.asarray(picture.read_image(0, 0, 0, 3, "float"))
        picture.close()
        for obj in filter(None, (surface, lamp)):
            bpy.data.objects.remove(obj)
        return pixels

    return render


def middle(pixels, half=6):
    inner = slice(SIZE // 2 - half, SIZE // 2 + half)
    return pixels[inner, inner].mean((0, 1))


def dielectric(albedo):
    """Radiance under a white sky at normal incidence: 4 % is reflected (IOR 1.5), the rest meets the albedo."""
    return 0.04 + 0.96 * np.array(albedo)


def test_constant_material_reflects_its_albedo(tmp_path, make_record, render):
    albedo = [0.1, 0.4, 0.8]
    maps = {"basecolor": {"value": albedo}, "roughness": {"value": 0.5}}
    picture = render(nodes.build_material(make_record(maps), tmp_path, pack=True))
    np.testing.assert_allclose(middle(picture), dielectric(albedo), atol=0.02)


def test_texture_of_a_colour_renders_as_the_constant(tmp_path, make_record, render):
    albedo = np.array([0.1, 0.4, 0.8], np.float32)
    (tmp_path / "stone").mkdir()
    write_image(tmp_path / "stone/stone_basecolor.png", np.tile(srgb_from_linear(albedo), (8, 8, 1)))
    write_image(tmp_path / "stone/stone_roughness.png", np.full((8, 8), 0.5, np.float32))
    maps = {role: {"file": f"stone/stone_{role}.png"} for role in ("basecolor", "roughness")}
    picture = render(nodes.build_material(make_record(maps), tmp_path, pack=True))
    np.testing.assert_allclose(middle(picture), dielectric(albedo), atol=0.02)


def test_a_smooth_surface_has_a_brighter_smaller_highlight_than_a_rough_one(tmp_path, make_record, render):
    peaks = {}
    for roughness in (0.4, 0.8):
        maps = {"basecolor": {"value": [0.0, 0.0, 0.0]}, "roughness": {"value": roughness}}
        picture = render(nodes.build_material(make_record(maps), tmp_path, pack=True), sun=(0, 0, 1))
        peaks[roughness] = middle(picture, half=1).mean()
        # the peak of GGX at normal incidence: F0 / (4 pi alpha^2) times the irradiance pi, alpha = roughness^2
        assert peaks[roughness] == pytest.approx(0.04 / (4 * roughness**4), rel=0.1)
    assert peaks[0.4] > 10 * peaks[0.8]


def test_green_of_a_normal_map_points_up(tmp_path, make_record, render):
    """A surface tilted 30 degrees to +Y faces a sun there and turns 60 degrees from one at -Y: twice the light."""
    tilted = np.array([0.0, 0.5, np.sqrt(0.75)], np.float32)
    (tmp_path / "stone").mkdir()
    write_image(tmp_path / "stone/stone_normal.png", np.tile((tilted + 1) / 2, (8, 8, 1)))
    maps = {
        "basecolor": {"value": [0.5, 0.5, 0.5]},
        "normal": {"file": "stone/stone_normal.png"},
        "roughness": {"value": 1.0},
    }
    material = nodes.build_material(make_record(maps), tmp_path, pack=True)
    up, down = (middle(render(material, sun=(0, y, np.sqrt(0.75)), plane=True)).mean() for y in (0.5, -0.5))
    assert up / down == pytest.approx(2.0, rel=0.1)
    assert up == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("angle, sun", [(np.pi / 2, (1, 0)), (np.pi, (0, -1)), (-np.pi / 2, (-1, 0))])
def test_a_turned_texture_turns_its_relief_along(tmp_path, make_record, render, angle, sun):
    """The surface tilts to +Y of the texture. Turned on the mesh, it faces where +Y of the texture points there.

    The mapping reads the texture at the turned coordinate, so that the picture itself turns the other way.
    """
    tilted = np.array([0.0, 0.5, np.sqrt(0.75)], np.float32)
    (tmp_path / "stone").mkdir()
    write_image(tmp_path / "stone/stone_normal.png", np.tile((tilted + 1) / 2, (8, 8, 1)))
    maps = {
        "basecolor": {"value": [0.5] * 3},
        "normal": {"file": "stone/stone_normal.png"},
        "roughness": {"value": 1.0},
    }
    material = nodes.build_material(make_record(maps), tmp_path, pack=True)
    nodes.Controls(material).rotation = angle
    x, y = sun
    towards, away = (
        middle(render(material, sun=(sign * x / 2, sign * y / 2, np.sqrt(0.75)), plane=True)).mean() for sign in (1, -1)
    )
    assert towards / away == pytest.approx(2.0, rel=0.1)
