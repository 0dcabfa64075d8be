"""What is exported is what the nodes render, and a saved library is complete in itself."""

import bpy
import cv2
import numpy as np
import pytest
from material_palette.core import nodes
from material_palette.operators.palette import put_in_palette


@pytest.fixture
def stone(settings, tmp_path, make_record, write_maps):
    material = nodes.build_material(make_record(write_maps(), metres_per_tile=2.0), tmp_path, pack=False)
    nodes.mark_asset(material, "Extracted from wall.jpg", "A. Painter", "CC0")
    put_in_palette(settings, 1, material)
    return material


def test_files_have_the_adjustments_in_them(stone, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    stone.material_palette.brightness = 0.5
    stone.material_palette.roughness_offset = 0.2
    assert bpy.ops.material_palette.export(directory=str(out)) == {"FINISHED"}
    written = {path.name for path in (out / "stone").iterdir()}
    kinds = ("basecolor", "normal", "roughness", "orm")
    assert written == {"stone.mtlx", *(f"stone_{kind}.png" for kind in kinds)}

    def linear(path):
        encoded = cv2.imread(str(path)) / 255
        return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)

    before = linear(tmp_path / "stone" / "stone_basecolor.png")
    np.testing.assert_allclose(linear(out / "stone" / "stone_basecolor.png"), before / 2, atol=0.01)
    rough = cv2.imread(str(tmp_path / "stone" / "stone_roughness.png"), cv2.IMREAD_GRAYSCALE) / 255
    packed = cv2.imread(str(out / "stone" / "stone_orm.png"))[..., 1] / 255
    np.testing.assert_allclose(packed, np.clip(rough + 0.2, 0, 1), atol=1.1 / 255)
    assert 'value="0.5, 0.5"' in (out / "stone" / "stone.mtlx").read_text()


def test_a_base_colour_of_16_bits_is_the_same_colour(settings, tmp_path, make_record, write_maps):
    from material_palette.operators.export import read_map

    read = []
    record = make_record(write_maps())
    path = tmp_path / "stone" / "stone_basecolor.png"
    encoded = cv2.imread(str(path))
    for pixels in (encoded, encoded.astype(np.uint16) * 257):
        cv2.imwrite(str(path), pixels)
        material = nodes.build_material(record, tmp_path, pack=True)
        read.append(read_map(nodes.Controls(material).node("basecolor").image))
    np.testing.assert_allclose(read[0], read[1], atol=1e-4)
    assert read[0].max() > 1.2 * read[0].mean()


def test_materialx_tells_of_the_relief_once(stone, tmp_path):
    for relief, kind in (("NORMAL", "normal"), ("BUMP", "height"), ("DISPLACEMENT", "height")):
        nodes.Controls(stone).relief = relief
        out = tmp_path / relief
        out.mkdir()
        bpy.ops.material_palette.export(directory=str(out), gltf=False)
        document = (out / "stone" / "stone.mtlx").read_text()
        assert [k for k in ("normal", "height") if f"stone_{k}.png" in document] == [kind]
        assert ("displacementshader" in document) == (kind == "height")


def test_normals_turn_with_materialx_and_not_with_gltf(stone, tmp_path):
    nodes.Controls(stone).rotation = np.pi / 2
    out = tmp_path / "out"
    out.mkdir()
    bpy.ops.material_palette.export(directory=str(out))

    def normals(path):
        vectors = cv2.imread(str(path))[..., ::-1] / 127.5 - 1
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    before = normals(tmp_path / "stone" / "stone_normal.png")
    up = before[..., 2] > 0.1
    np.testing.assert_allclose(normals(out / "stone" / "stone_normal.png")[up], before[up], atol=0.03)
    turned = np.stack([before[..., 1], -before[..., 0], before[..., 2]], -1)
    np.testing.assert_allclose(normals(out / "stone" / "stone_normal_turned.png")[up], turned[up], atol=0.03)
    assert "stone_normal_turned.png" in (out / "stone" / "stone.mtlx").read_text()


@pytest.mark.parametrize("formats", [{"gltf": False}, {"materialx": False}])
def test_maps_of_16_bits_stay_so(settings, tmp_path, make_record, write_maps, formats):
    record = make_record(write_maps())
    for kind in ("normal", "roughness"):
        path = str(tmp_path / "stone" / f"stone_{kind}.png")
        cv2.imwrite(path, cv2.imread(path, cv2.IMREAD_UNCHANGED).astype(np.uint16) * 257)
    put_in_palette(settings, 1, nodes.build_material(record, tmp_path, pack=True))
    out = tmp_path / "out"
    out.mkdir()
    bpy.ops.material_palette.export(directory=str(out), **formats)
    read = {path.stem[6:]: cv2.imread(str(path), cv2.IMREAD_UNCHANGED).dtype for path in out.rglob("*.png")}
    rough = "roughness" if "gltf" in formats else "orm"
    assert read == {"basecolor": np.uint8, "normal": np.uint16, rough: np.uint16}


def test_a_material_taken_apart_is_refused_by_name(stone, tmp_path):
    stone.node_tree.nodes.clear()
    with pytest.raises(RuntimeError, match="'stone'"):
        bpy.ops.material_palette.export(directory=str(tmp_path))


def test_names_that_share_a_file_name_are_refused(stone, settings, tmp_path, make_record):
    stone.name = "wall:1"
    other = nodes.build_material(make_record(), tmp_path, pack=False)
    other.name = "Wall_1"
    put_in_palette(settings, 2, other)
    (tmp_path / "out").mkdir()
    with pytest.raises(RuntimeError, match="'wall:1' and 'Wall_1'"):
        bpy.ops.material_palette.export(directory=str(tmp_path / "out"))
    assert not any((tmp_path / "out").iterdir())


@pytest.fixture
def library(tmp_path):
    folder = tmp_path / "library"
    folder.mkdir()
    libraries = bpy.context.preferences.filepaths.asset_libraries
    known = libraries.new(name="Mine", directory=str(folder))
    yield folder
    libraries.remove(known)


def test_a_library_is_complete_and_leaves_the_file_as_it_was(stone, library, tmp_path):
    paths = [image.filepath_raw for image in nodes.images_of(stone)]
    (library / "blender_assets.cats.txt").write_text("VERSION 1\n\n11111111-2222-3333-4444-555555555555:Mine:Mine\n")
    for _ in range(2):
        assert bpy.ops.material_palette.save_library(library="Mine", name="wall palette") == {"FINISHED"}
    assert [image.filepath_raw for image in nodes.images_of(stone)] == paths
    assert not any(image.packed_file for image in nodes.images_of(stone))
    assert sorted(path.name for path in library.glob("*.blend")) == ["wall palette 2.blend", "wall palette.blend"]
    catalogue = (library / "blender_assets.cats.txt").read_text()
    assert "Mine:Mine" in catalogue and catalogue.count(nodes.CATALOG_ID) == 1

    for file in (tmp_path / "stone").iterdir():
        file.unlink()
    bpy.ops.wm.open_mainfile(filepath=str(library / "wall palette.blend"))
    saved = bpy.data.materials["stone"]
    assert (saved.asset_data.author, saved.asset_data.license) == ("A. Painter", "CC0")
    assert all(image.packed_file and image.size[0] == 16 for image in nodes.images_of(saved))


def test_a_missing_library_is_said(stone):
    with pytest.raises((RuntimeError, TypeError)):
        bpy.ops.material_palette.save_library(library="Nowhere")


def test_a_library_whose_folder_is_not_there_yet_gets_it(stone, library):
    library.rmdir()
    assert bpy.ops.material_palette.save_library(library="Mine", name="wall") == {"FINISHED"}
    assert (library / "wall.blend").is_file()
    (library / "wall.blend").unlink()
    (library / "blender_assets.cats.txt").unlink()
    library.rmdir()
    library.touch()
    with pytest.raises(RuntimeError, match="can't be made"):
        bpy.ops.material_palette.save_library(library="Mine", name="wall")
