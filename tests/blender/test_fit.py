"""A palette fitted to a scene: in the window's operator, and by the command line."""

import json

import bpy
import cv2
import numpy as np
import pytest
from material_palette.core.material import SVBRDF
from stage import camera, plane

SIDE = 256


@pytest.fixture
def made(tmp_path):
    """A palette in a folder: grainy stone and grain, each of SIDE texels, on tiles of a metre."""
    import torch
    from material_palette.core.palette import Material, Palette, Settings, write_palette
    from material_palette.core.torus import normal_from_height

    random = np.random.default_rng(0)
    materials = []
    for name in ("stone", "grain"):
        height = (random.random((SIDE, SIDE), np.float32) - 0.5) * 0.5 / SIDE
        albedo = np.repeat(0.1 + 0.5 * random.random((SIDE, SIDE, 1), np.float32), 3, -1)
        svbrdf = SVBRDF(albedo, normal_from_height(torch.from_numpy(height)).numpy(), 0.5, height)
        preview = np.ones((256, 256, 4), np.float32)
        texture = np.zeros((8, 8, 3), np.uint8)
        materials.append(Material(name, svbrdf=svbrdf, preview=preview, texture=texture))
    (tmp_path / "full").mkdir()
    palette = Palette(None, "wall.jpg", [], Settings(resolution=SIDE), materials)
    return tmp_path / "full", write_palette(palette, tmp_path / "full")


def dress(made, pack=True):
    """A wall of stone of 2 x 2 m, 100 px in the picture; nothing has the grain."""
    from material_palette.core.nodes import build_material

    folder, content = made
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 200, 100, 100
    scene.frame_end = 1
    materials = [build_material(record, folder, pack=pack) for record in content["materials"]]
    plane("wall", materials[0], 2.0)
    materials[1].use_fake_user = True
    camera("front", (0, 0, 5))
    bpy.context.view_layer.update()
    return materials


@pytest.fixture
def palette(settings, made):
    for key, material in enumerate(dress(made), 1):
        entry = settings.palette.add()
        entry.name, entry.key, entry.material = material.name, key, material
    return settings.palette


def side(material, kind="Palette Base Color"):
    node = material.node_tree.nodes.get(kind)
    return node.image.size[0] if node else 0


def test_seen_materials_get_what_the_camera_shows_and_unseen_ones_the_least(palette):
    assert bpy.ops.material_palette.fit_scene() == {"FINISHED"}
    stone, grain = (entry.material for entry in palette)
    assert 16 < side(stone) < SIDE and side(grain) <= 16  # a metre is 50 px
    assert [stone.name, grain.name] == ["stone", "grain"]
    assert bpy.data.objects["wall"].data.materials[0] == stone
    assert all(image.packed_file for image in bpy.data.images if image.users)
    assert side(palette[0].previous) == SIDE


def test_materials_whose_names_share_a_file_name_stay_apart(palette):
    stone, grain = (entry.material for entry in palette)
    stone.name, grain.name = "wall:1", "wall_1"
    plane("sign", grain, 1.0, 1.0)
    bpy.ops.material_palette.fit_scene()
    for entry, full in zip(palette, (stone, grain), strict=True):
        images = (material.node_tree.nodes["Palette Base Color"].image for material in (entry.material, full))
        fitted, whole = (np.array(image.pixels[:]).reshape(image.size[0], -1, 4)[:, :, 0] for image in images)
        shrunk = cv2.resize(whole, fitted.shape, interpolation=cv2.INTER_AREA)
        assert np.corrcoef(shrunk.ravel(), fitted.ravel())[0, 1] > 0.8


def test_full_materials_come_back(palette):
    bpy.ops.material_palette.fit_scene()
    assert bpy.ops.material_palette.compare() == {"FINISHED"}
    assert side(palette[0].material) == SIDE and bpy.data.objects["wall"].data.materials[0] == palette[0].material


def test_it_is_fitted_anew_from_the_full_maps_with_the_artists_adjustments(palette):
    from material_palette.core.nodes import Controls

    bpy.ops.material_palette.fit_scene()
    first = side(palette[0].material)
    Controls(palette[0].material).hue = 0.7
    bpy.data.cameras["front"].ortho_scale = 2.0
    bpy.context.view_layer.update()
    assert bpy.ops.material_palette.fit_scene() == {"FINISHED"}
    assert side(palette[0].material) > first
    assert Controls(palette[0].material).hue == pytest.approx(0.7)
    assert side(palette[0].previous) == SIDE
    assert len([m for m in bpy.data.materials if m.name.startswith("stone")]) == 2


def test_full_materials_are_deleted_where_that_is_asked_for(palette):
    assert bpy.ops.material_palette.fit_scene(keep_full=False) == {"FINISHED"}
    assert [m.name for m in bpy.data.materials] == ["grain", "stone"]
    assert max(image.size[0] for image in bpy.data.images) < SIDE


def test_what_was_learnt_and_what_stays_as_it_was_go_along(palette):
    bpy.context.scene.material_palette.resolution = SIDE  # more than the maps have is not asked for
    palette[0].material.material_palette.concept = "learnt"
    palette[0].material.material_palette.concept_tensors = "numbers"
    bpy.data.cameras["front"].ortho_scale = 0.5  # nearer than a texel to a pixel
    bpy.context.view_layer.update()
    bpy.ops.material_palette.fit_scene()
    fitted, full = palette[0].material, palette[0].previous
    assert fitted.material_palette.concept == "learnt" and fitted.material_palette.concept_tensors == "numbers"
    images = [m.node_tree.nodes["Palette Base Color"].image for m in (fitted, full)]
    assert images[0] == images[1] and images[0].users == 2
    assert bpy.ops.material_palette.discard_before() == {"FINISHED"}
    assert side(fitted) == SIDE and images[0].users == 1


def test_a_displaced_material_keeps_its_height(palette):
    from material_palette.core.nodes import Controls

    Controls(palette[0].material).relief = "DISPLACEMENT"
    bpy.data.cameras["front"].ortho_scale = 40.0  # from far away no relief shows
    bpy.context.view_layer.update()
    bpy.ops.material_palette.fit_scene()
    fitted = palette[0].material
    assert fitted.get("height") is not None and Controls(fitted).relief == "DISPLACEMENT"
    assert fitted["height_scale"] > 0


def test_without_camera_or_palette_it_says_so(settings):
    assert not bpy.ops.material_palette.fit_scene.poll()


def test_the_command_line_fits_into_another_folder(made, tmp_path, capsys):
    from material_palette.core.command import main

    dress(made)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    arguments = ["fit", str(made[0]), "--scene", str(tmp_path / "scene.blend"), "-o"]
    before = {p: p.read_bytes() for p in made[0].rglob("*") if p.is_file()}
    assert main([*arguments, str(tmp_path / "small")]) == 0
    said = capsys.readouterr().out
    assert "stone: a tile is at most 50 px long" in said and "MB" in said
    assert before == {p: p.read_bytes() for p in made[0].rglob("*") if p.is_file()}
    content = json.loads((tmp_path / "small" / "palette.json").read_text(encoding="utf-8"))
    stone, grain = content["materials"]
    assert any(line["map"] == "basecolor" and line["bytes"] > 0 for line in stone["reduced"])
    assert (tmp_path / "small" / "palette.blend").is_file()
    # the same folder would lose the full maps
    assert main([*arguments, str(made[0])]) == 2
    assert main(["fit", str(made[0]), "--scene", str(tmp_path / "none.blend"), "-o", str(tmp_path / "x")]) == 2


def test_maps_as_large_but_not_alike_are_not_shared():
    from material_palette.operators.fit import _same

    first, second = (bpy.data.images.new(name, 8, 8, is_data=True) for name in ("first", "second"))
    assert _same(first, second)
    pixels = np.zeros(8 * 8 * 4, np.float32)
    pixels[40] = 0.5
    second.pixels.foreach_set(pixels)
    assert not _same(first, second)
