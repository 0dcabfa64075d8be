"""The node tree is exactly what a set of maps needs, and a written .blend holds all of it."""

import bpy
import numpy as np
import pytest
from material_palette.core import nodes
from material_palette.core.errors import PaletteError

TEXTURED = {
    "ShaderNodeTexCoord": 1,
    "ShaderNodeMapping": 1,
    "ShaderNodeTexImage": 3,
    "ShaderNodeNormalMap": 1,
    "ShaderNodeBsdfPrincipled": 1,
    "ShaderNodeOutputMaterial": 1,
    "NodeFrame": 2,
}
# Blender keeps textures of nodes drawn open about this large; links run in the gaps
NODE_SIZES = {
    "ShaderNodeTexCoord": (140, 250),
    "ShaderNodeMapping": (140, 370),
    "ShaderNodeTexImage": (240, 290),
    "ShaderNodeNormalMap": (150, 160),
    "ShaderNodeBsdfPrincipled": (240, 620),
    "ShaderNodeOutputMaterial": (140, 130),
    "ShaderNodeHueSaturation": (150, 180),
    "ShaderNodeMath": (140, 160),
    "ShaderNodeVectorRotate": (140, 200),
    "ShaderNodeDisplacement": (140, 180),
}


def count_nodes(material):
    names = [node.bl_idname for node in material.node_tree.nodes]
    return {name: names.count(name) for name in names}


def links_of(material):
    """Every link as (node type, socket, node type, socket), Image Textures as the last word of their file."""

    def called(node):
        return node.image.name.rsplit("_", 1)[-1] if node.bl_idname == "ShaderNodeTexImage" else node.bl_idname[10:]

    return {
        (called(link.from_node), link.from_socket.name, called(link.to_node), link.to_socket.name)
        for link in material.node_tree.links
    }


def node_of(material, idname):
    return next(node for node in material.node_tree.nodes if node.bl_idname == idname)


def ramp_preview():
    preview = np.ones((256, 256, 4), np.float32)
    preview[..., 0] = np.linspace(0.0, 1.0, 256, dtype=np.float32)[:, None]
    preview[..., 1] = np.linspace(0.0, 1.0, 256, dtype=np.float32)[None]
    preview[:, 128:, 3] = 0.0
    return preview


def test_all_maps_give_exactly_these_nodes_and_links(tmp_path, make_record, write_maps):
    record = make_record(write_maps(), metres_per_tile=2.0)
    material = nodes.build_material(record, tmp_path, pack=True)
    assert count_nodes(material) == TEXTURED
    assert links_of(material) == {
        ("TexCoord", "UV", "Mapping", "Vector"),
        ("Mapping", "Vector", "basecolor", "Vector"),
        ("Mapping", "Vector", "normal", "Vector"),
        ("Mapping", "Vector", "roughness", "Vector"),
        ("basecolor", "Color", "BsdfPrincipled", "Base Color"),
        ("roughness", "Color", "BsdfPrincipled", "Roughness"),
        ("normal", "Color", "NormalMap", "Color"),
        ("NormalMap", "Normal", "BsdfPrincipled", "Normal"),
        ("BsdfPrincipled", "BSDF", "OutputMaterial", "Surface"),
    }
    assert tuple(node_of(material, "ShaderNodeMapping").inputs["Scale"].default_value) == (0.5, 0.5, 0.5)


def test_colour_spaces(tmp_path, make_record, write_maps):
    material = nodes.build_material(make_record(write_maps()), tmp_path, pack=True)
    spaces = {image.name: image.colorspace_settings.name for image in nodes.images_of(material)}
    assert spaces == {
        "stone_basecolor": "sRGB",
        "stone_normal": "Non-Color",
        "stone_roughness": "Non-Color",
        "stone_height": "Non-Color",
    }


@pytest.mark.parametrize("bits", [8, 16])
def test_solid_shading_shows_the_mean_colour(tmp_path, make_record, bits):
    from material_palette.core.image import srgb_from_linear, write_image

    colours = np.array([[[0.5, 0.1, 0.02]], [[0.1, 0.3, 0.06]]], np.float32)
    write_image(tmp_path / "stone.png", srgb_from_linear(np.tile(colours, (8, 16, 1))), bits=bits)
    material = nodes.build_material(make_record({"basecolor": {"file": "stone.png"}}), tmp_path, pack=True)
    assert tuple(material.diffuse_color) == pytest.approx((0.3, 0.2, 0.04, 1.0), abs=0.003)
    constant = nodes.build_material(make_record(), tmp_path, pack=True)
    assert tuple(constant.diffuse_color) == pytest.approx((0.2, 0.3, 0.4, 1.0))


def test_height_rides_along_without_a_node(tmp_path, make_record, write_maps):
    material = nodes.build_material(make_record(write_maps()), tmp_path, pack=True)
    assert material["height"].name == "stone_height"
    assert (material["height_scale"], material["height_midlevel"]) == pytest.approx((0.05, 0.5))
    assert "height" not in {name for link in links_of(material) for name in link}


@pytest.fixture
def stone(tmp_path, make_record, write_maps):
    return nodes.build_material(make_record(write_maps(), metres_per_tile=2.0), tmp_path, pack=True)


def test_controls_at_their_defaults_need_no_node(stone):
    controls = nodes.Controls(stone)
    assert controls.values() == nodes.Controls.DEFAULTS | {"tile_size": 2.0}
    before = links_of(stone), count_nodes(stone)
    changed = {"rotation": 0.3, "relief": "BUMP", "strength": 0.5, "roughness_offset": -0.2, "hue": 0.6}
    controls.set(changed | {"saturation": 0.5, "brightness": 1.5, "tile_size": 4.0})
    assert controls.values() == pytest.approx(
        changed | {"saturation": 0.5, "brightness": 1.5, "tile_size": 4.0, "relief": "BUMP"}
    )
    controls.reset()
    assert (links_of(stone), count_nodes(stone)) == before
    assert controls.values() == nodes.Controls.DEFAULTS | {"tile_size": 2.0}


def test_controls_put_their_nodes_in_the_way_of_their_map(stone):
    controls = nodes.Controls(stone)
    before = links_of(stone)
    controls.set({"brightness": 0.5, "roughness_offset": 0.1, "rotation": 1.0})
    assert before - links_of(stone) == {
        ("basecolor", "Color", "BsdfPrincipled", "Base Color"),
        ("roughness", "Color", "BsdfPrincipled", "Roughness"),
        ("normal", "Color", "NormalMap", "Color"),
    }
    assert links_of(stone) - before == {
        ("basecolor", "Color", "HueSaturation", "Color"),
        ("HueSaturation", "Color", "BsdfPrincipled", "Base Color"),
        ("roughness", "Color", "Math", "Value"),
        ("Math", "Value", "BsdfPrincipled", "Roughness"),
        ("normal", "Color", "VectorRotate", "Vector"),
        ("VectorRotate", "Vector", "NormalMap", "Color"),
    }


def test_relief_is_told_once_and_in_metres(stone):
    controls = nodes.Controls(stone)
    controls.strength = 0.5
    for relief, method in (("BUMP", "BUMP"), ("DISPLACEMENT", "BOTH")):
        controls.relief = relief
        assert (controls.relief, stone.displacement_method) == (relief, method)
        assert not node_of(stone, "ShaderNodeBsdfPrincipled").inputs["Normal"].is_linked
        # half of 0.05 tile widths, two metres each
        assert node_of(stone, "ShaderNodeDisplacement").inputs["Scale"].default_value == pytest.approx(0.05)
    controls.tile_size = 1.0
    assert node_of(stone, "ShaderNodeDisplacement").inputs["Scale"].default_value == pytest.approx(0.025)
    assert ("height", "Color", "Displacement", "Height") in links_of(stone)


def test_controls_of_what_is_not_there_do_nothing(tmp_path, make_record):
    plain = nodes.build_material(make_record(), tmp_path, pack=True)
    before = count_nodes(plain)
    controls = nodes.Controls(plain)
    controls.set(nodes.Controls.DEFAULTS | {"rotation": 1.0, "relief": "BUMP", "hue": 0.1, "tile_size": 3.0})
    assert count_nodes(plain) == before and controls.tile_size is None
    assert not nodes.Controls(bpy.data.materials.new("someone else's"))


def test_constant_roughness_is_a_value_and_no_node(tmp_path, make_record, write_maps):
    record = make_record(write_maps(roles=("basecolor", "normal")) | {"roughness": {"value": 0.35}})
    material = nodes.build_material(record, tmp_path, pack=True)
    assert count_nodes(material) == TEXTURED | {"ShaderNodeTexImage": 2}
    roughness = node_of(material, "ShaderNodeBsdfPrincipled").inputs["Roughness"]
    assert not roughness.is_linked
    assert roughness.default_value == pytest.approx(0.35)


def test_flat_normal_has_no_normal_map_node(tmp_path, make_record, write_maps):
    material = nodes.build_material(make_record(write_maps(roles=("basecolor",))), tmp_path, pack=True)
    assert "ShaderNodeNormalMap" not in count_nodes(material)
    assert not node_of(material, "ShaderNodeBsdfPrincipled").inputs["Normal"].is_linked


def test_constants_alone_need_two_nodes_and_no_image(tmp_path, make_record):
    material = nodes.build_material(make_record(), tmp_path, pack=True)
    assert count_nodes(material) == {"ShaderNodeBsdfPrincipled": 1, "ShaderNodeOutputMaterial": 1}
    principled = node_of(material, "ShaderNodeBsdfPrincipled")
    assert tuple(principled.inputs["Base Color"].default_value) == pytest.approx((0.2, 0.3, 0.4, 1.0))
    assert principled.inputs["Roughness"].default_value == pytest.approx(0.7)
    assert nodes.images_of(material) == []
    assert "height" not in material


@pytest.mark.parametrize("adjusted", [False, True])
def test_no_two_nodes_overlap_and_links_run_to_the_right(tmp_path, make_record, write_maps, adjusted):
    material = nodes.build_material(make_record(write_maps()), tmp_path, pack=True)
    if adjusted:
        nodes.Controls(material).set({"rotation": 1, "relief": "BUMP", "roughness_offset": 0.1, "hue": 0.1})
    boxes = []
    for node in material.node_tree.nodes:
        if node.bl_idname == "NodeFrame":
            continue
        assert tuple(node.parent.location if node.parent else (0, 0)) == (0, 0)
        (x, y), (width, height) = node.location, NODE_SIZES[node.bl_idname]
        boxes.append((x, y - height, x + width, y))
    for i, (left, bottom, right, top) in enumerate(boxes):
        for left2, bottom2, right2, top2 in boxes[:i]:
            assert right < left2 or right2 < left or top < bottom2 or top2 < bottom
    for link in material.node_tree.links:
        assert link.from_node.location.x < link.to_node.location.x


def test_packed_textures_need_no_file_and_name_no_folder_of_this_machine(tmp_path, make_record, write_maps):
    material = nodes.build_material(make_record(write_maps()), tmp_path, pack=True)
    for image in nodes.images_of(material):
        assert image.packed_file is not None
        assert image.filepath_raw == f"//stone/{image.name}.png"
        assert image.packed_files[0].filepath == image.filepath_raw


def test_unpacked_textures_are_relative_to_a_saved_file(tmp_path, make_record, write_maps):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    material = nodes.build_material(make_record(write_maps()), tmp_path, pack=False)
    for image in nodes.images_of(material):
        assert image.packed_file is None
        assert image.filepath_raw == f"//stone/{image.name}.png"
        assert tuple(image.size) == (16, 16)


def test_names_with_letters_of_any_script(tmp_path, make_record, write_maps):
    name = "Größe 石垣 & co"
    material = nodes.build_material(make_record(write_maps(name), name=name), tmp_path, pack=True)
    assert material.name == name


@pytest.mark.parametrize("pack", [True, False])
def test_a_missing_texture_is_named_and_leaves_nothing(tmp_path, make_record, write_maps, data_blocks, pack):
    record = make_record(write_maps())
    (tmp_path / "stone" / "stone_height.png").unlink()
    before = data_blocks()
    with pytest.raises(PaletteError, match="stone_height.png"):
        nodes.build_material(record, tmp_path, pack=pack)
    assert data_blocks() == before


@pytest.mark.parametrize(
    "change, word",
    [
        ({"status": "failed", "maps": {}, "error": "too small"}, "too small"),
        ({"maps": {"normal": {"value": [0.0, 0.6, 0.8]}}}, "flat"),
    ],
)
def test_what_can_not_be_built_is_refused(tmp_path, make_record, data_blocks, change, word):
    before = data_blocks()
    with pytest.raises(PaletteError, match=word):
        nodes.build_material(make_record() | change, tmp_path, pack=True)
    assert data_blocks() == before


def test_preview_is_upright_and_not_rendered_over(tmp_path, make_record):
    preview = ramp_preview()
    material = nodes.build_material(make_record(), tmp_path, pack=True, preview=preview)
    slot = material.preview
    assert slot.is_image_custom and slot.is_icon_custom
    assert tuple(slot.image_size) == (256, 256)
    pixels = np.empty(256 * 256 * 4, np.float32)
    slot.image_pixels_float.foreach_get(pixels)
    expected = np.where(preview[..., 3:] > 0, preview, 0.0)  # nothing shines through where it is transparent
    np.testing.assert_allclose(pixels.reshape(256, 256, 4)[::-1], expected, atol=1 / 255)


def test_preview_of_another_size_is_refused(tmp_path, make_record, data_blocks):
    before = data_blocks()
    with pytest.raises(PaletteError, match="256 x 256"):
        nodes.build_material(make_record(), tmp_path, pack=True, preview=np.zeros((64, 64, 4), np.float32))
    assert data_blocks() == before


def palette_of(*records):
    return {"version": 1, "photo": "wall.jpg", "settings": {}, "seconds": {}, "warnings": [], "materials": records}


@pytest.mark.parametrize("pack", [True, False])
def test_written_blend_reloads_as_assets_and_can_be_moved(tmp_path, make_record, write_maps, data_blocks, pack):
    (tmp_path / "staging").mkdir()
    staging = tmp_path / "staging"
    maps = write_maps()
    (tmp_path / "stone").rename(staging / "stone")
    failed = make_record(name="sky", status="failed", error="empty") | {"maps": {}}
    palette = palette_of(make_record(maps), make_record(name="paint"), failed)
    # a material of the same name in the open file must not change the written name
    mine = bpy.data.materials.new("stone")
    before = data_blocks()

    nodes.write_blend(staging / "palette.blend", palette, staging, {"stone": ramp_preview()}, pack=pack)

    assert data_blocks() == before
    assert mine.name == "stone"
    moved = staging.rename(tmp_path / "moved")
    if pack:
        for file in (moved / "stone").iterdir():
            file.unlink()
    assert str(tmp_path).encode() not in (moved / "palette.blend").read_bytes()

    bpy.ops.wm.open_mainfile(filepath=str(moved / "palette.blend"))
    assert sorted(m.name for m in bpy.data.materials) == ["paint", "stone"]
    for material in bpy.data.materials:
        assert material.asset_data.catalog_id == nodes.CATALOG_ID
        assert "wall.jpg" in material.asset_data.description
        assert material.use_fake_user
    stone = bpy.data.materials["stone"]
    assert stone.preview.is_image_custom and tuple(stone.preview.image_size) == (256, 256)
    assert count_nodes(stone) == TEXTURED
    images = nodes.images_of(stone)
    assert len(images) == 4
    for image in images:
        assert image.filepath_raw.replace("\\", "/") == f"//stone/{image.name}.png"
        assert tuple(image.size) == (16, 16)  # the pixels are found


def test_catalogue_file_names_the_assets_catalogue(tmp_path, make_record):
    nodes.write_blend(tmp_path / "palette.blend", palette_of(make_record()), tmp_path, {}, pack=True)
    lines = (tmp_path / "blender_assets.cats.txt").read_text().splitlines()
    assert lines[0] == "VERSION 1"
    assert f"{nodes.CATALOG_ID}:Material Palette:Material Palette" in lines


def test_a_catalogue_file_that_can_not_be_written_stays_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "blender_assets.cats.txt"
    text = "VERSION 1\n\n11111111-2222-3333-4444-555555555555:Mine:Mine\n"
    path.write_text(text)

    def full(self, *_content, **_how):
        self.write_bytes(b"VERS")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(path), "write_text", full)
    with pytest.raises(OSError, match="No space"):
        nodes.add_catalogue(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == [path.name] and path.read_text() == text


def test_a_failing_write_leaves_the_open_file_as_it_was(tmp_path, make_record, write_maps, data_blocks):
    palette = palette_of(make_record(name="paint"), make_record(write_maps()))
    (tmp_path / "stone" / "stone_normal.png").unlink()
    before = data_blocks()
    with pytest.raises(PaletteError, match="stone_normal.png"):
        nodes.write_blend(tmp_path / "palette.blend", palette, tmp_path, {}, pack=True)
    assert data_blocks() == before
    assert not (tmp_path / "palette.blend").exists()
