"""`core/brdf.py` against Principled BSDF in Cycles: same numbers in, same light out, roughness included."""

import bpy
import numpy as np
import pytest
import torch
from material_palette.core import brdf
from mathutils import Vector

SIZE = 96
UP = torch.tensor([0.0, 0.0, 1.0])
COLOUR = (0.8, 0.5, 0.2)
SUNS = {"above": (0.0, 0.0, 1.0), "aside": (0.6, 0.0, 0.8), "grazing": (0.9, 0.3, 0.316)}


@pytest.fixture
def render(tmp_path):
    """render(light, roughness, metallic=0, distribution="GGX", plane=False): linear picture (96, 96, 3) from above.

    light is a direction towards a sun, a lamp's place where `lamp` is set, None for a white sky.
    """
    import OpenImageIO as oiio

    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.use_denoising = False
    scene.cycles.pixel_filter_type = "BOX"
    scene.cycles.filter_width = 0.01
    scene.cycles.max_bounces = 0
    scene.render.threads_mode = "FIXED"
    scene.render.threads = 1
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type = "ORTHO"
    camera.data.ortho_scale = 2.0
    camera.location = (0, 0, 5)
    scene.collection.objects.link(camera)
    scene.camera = camera

    bpy.ops.mesh.primitive_plane_add(size=4)
    objects = {True: bpy.context.object}
    bpy.ops.mesh.primitive_uv_sphere_add(radius=1, segments=192, ring_count=96)
    objects[False] = bpy.context.object
    for each in objects.values():
        mesh = each.data
        mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))

    def render(light, roughness, metallic=0.0, distribution="GGX", plane=False, lamp=False):
        surface = objects[plane]
        for each in objects.values():
            each.hide_render = each is not surface
        material = bpy.data.materials.new("material")
        if material.node_tree is None:
            material.use_nodes = True
        principled = next(n for n in material.node_tree.nodes if n.bl_idname == "ShaderNodeBsdfPrincipled")
        principled.distribution = distribution
        principled.inputs["Base Color"].default_value = (*COLOUR, 1)
        principled.inputs["Roughness"].default_value = roughness
        principled.inputs["Metallic"].default_value = metallic
        surface.data.materials.clear()
        surface.data.materials.append(material)
        world = scene.world = bpy.data.worlds.new("sky")
        if world.node_tree is None:
            world.use_nodes = True
        background = next(n for n in world.node_tree.nodes if n.bl_idname == "ShaderNodeBackground")
        background.inputs["Color"].default_value = (1, 1, 1, 1) if light is None else (0, 0, 0, 1)
        scene.cycles.samples = 64 if light is None else 1
        if light is not None:
            source = bpy.data.lights.new("light", "POINT" if lamp else "SUN")
            # irradiance pi where the light arrives at a right angle (for the lamp: at the origin)
            source.energy = 4 * np.pi**2 * Vector(light).length_squared if lamp else np.pi
            if lamp:
                source.shadow_soft_size = 0.0
            else:
                source.angle = 0.0
            holder = bpy.data.objects.new("light", source)
            holder.location = light
            holder.rotation_euler = Vector(light).to_track_quat("Z", "Y").to_euler()
            scene.collection.objects.link(holder)
        scene.render.filepath = str(tmp_path / "render.exr")
        bpy.ops.render.render(write_still=True)
        picture = oiio.ImageInput.open(scene.render.filepath)
        pixels = np.asarray(picture.read_image(0, 0, 0, 3, "float"))
        picture.close()
        if light is not None:
            bpy.data.objects.remove(holder)
        return torch.from_numpy(pixels)

    return render


def sphere():
    """Normals (96, 96, 3) as the camera sees them, and where they are at most 72 degrees from the view."""
    places = 2 * brdf.plane(SIZE, SIZE)
    squared = places.square().sum(-1)
    return torch.stack([places[..., 0], places[..., 1], torch.sqrt((1 - squared).clamp_min(0))], -1), squared < 0.9


def deviation(theirs, ours, where):
    """(mean absolute, mean) difference of the light, ours from theirs, over the mean of theirs."""
    difference = (ours - theirs)[where]
    return (difference.abs().mean() / theirs[where].mean()).item(), (difference.mean() / theirs[where].mean()).item()


def compare(render, sun, roughness, metallic, distribution="GGX"):
    normal, where = sphere()
    theirs = render(sun, roughness, metallic, distribution)
    maps = torch.tensor(COLOUR).expand_as(normal), normal, torch.full((SIZE, SIZE), roughness)
    return deviation(theirs, brdf.shade(*maps, torch.tensor(sun), UP, torch.full((SIZE, SIZE), metallic)), where)


def test_spheres_in_the_sun(render):
    for metallic in (0.0, 1.0):
        # alpha = roughness would give a highlight a quarter as bright
        absolute, mean = compare(render, SUNS["aside"], 0.5, metallic)
        assert absolute < 0.025 and abs(mean) < 0.02, metallic


@pytest.mark.slow
@pytest.mark.parametrize("sun", SUNS)
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_spheres_of_every_roughness_in_the_sun(render, metallic, sun):
    for roughness in (0.2, 0.4, 0.6, 0.9):
        absolute, mean = compare(render, SUNS[sun], roughness, metallic)
        print(f"sun {sun}, metallic {metallic}, roughness {roughness}: {absolute:.3f} {mean:+.3f}")
        assert absolute < 0.03, roughness
        assert abs(mean) < 0.03, roughness


@pytest.mark.slow
def test_light_scattered_several_times_is_what_we_leave_out(render):
    expected = {
        (0.0, 0.6): (-0.02, 0.02),
        (0.0, 0.9): (-0.04, 0.0),
        (1.0, 0.4): (-0.05, 0.0),
        (1.0, 0.6): (-0.15, -0.05),
    }
    for (metallic, roughness), (low, high) in expected.items():
        _, mean = compare(render, SUNS["aside"], roughness, metallic, "MULTI_GGX")
        print(f"several times, metallic {metallic}, roughness {roughness}: {mean:+.3f}")
        assert low < mean < high, (metallic, roughness)


@pytest.mark.slow
def test_a_plane_under_a_lamp(render):
    lamp = (0.4, -0.3, 1.2)
    light, falloff = brdf.towards(torch.tensor(lamp), 2 * brdf.plane(SIZE, SIZE))
    maps = torch.tensor(COLOUR).expand(SIZE, SIZE, 3), UP.expand(SIZE, SIZE, 3), torch.full((SIZE, SIZE), 0.4)
    ours = brdf.render(*maps, light[None], falloff[None], UP)
    theirs = render(lamp, 0.4, plane=True, lamp=True)
    absolute, mean = deviation(theirs, ours, torch.ones(SIZE, SIZE, dtype=torch.bool))
    assert absolute < 0.025 and abs(mean) < 0.025


@pytest.mark.slow
@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_a_plane_under_a_white_sky(render, metallic):
    maps = torch.tensor(COLOUR).expand(1, 1, 3), UP.expand(1, 1, 3), torch.full((1, 1), 0.5)
    lights = brdf.sky(4096)
    ours = brdf.render(*maps, lights[:, None, None], torch.full((4096, 1), 2 / 4096), UP, torch.full((1, 1), metallic))
    theirs = render(None, 0.5, metallic, plane=True).mean((0, 1))
    assert torch.allclose(ours[0, 0], theirs, rtol=0.04)
