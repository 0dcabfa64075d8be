"""Other programs get what the material looks like: colours as of Blender's node, normals turned, glTF's channels."""

import colorsys
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from material_palette.core import export

MAPS = {"basecolor": (0.2, 0.4, 0.6), "roughness": 0.7, "metallic": 0.0, "normal": None, "height": None}


@pytest.mark.parametrize(
    "adjustment", [(0.5, 1.0, 1.0), (0.75, 1.0, 1.0), (0.1, 0.4, 1.0), (0.5, 1.6, 0.5), (0.5, 0, 2)]
)
def test_colour_is_adjusted_in_hsv(adjustment):
    colours = np.random.default_rng(0).random((5, 7, 3), np.float32)
    hue, saturation, brightness = adjustment
    expected = [
        colorsys.hsv_to_rgb((h + hue - 0.5) % 1, min(s * saturation, 1), v * brightness)
        for h, s, v in (colorsys.rgb_to_hsv(*colour) for colour in colours.reshape(-1, 3).tolist())
    ]
    np.testing.assert_allclose(export.adjust_colour(colours, *adjustment).reshape(-1, 3), expected, atol=1e-5)


def test_one_colour_is_adjusted_as_well():
    np.testing.assert_allclose(export.adjust_colour(np.array([0.2, 0.4, 0.6], np.float32), 0.5, 0, 1), [0.6] * 3)


def test_strength_is_a_factor_on_the_slope_and_rotation_turns_it():
    normal = np.array([[[0.6, 0.0, 0.8]]], np.float32)
    steeper = export.adjust_normal(normal, 2.0, 0.0)[0, 0]
    assert steeper[0] / steeper[2] == pytest.approx(1.5) and np.linalg.norm(steeper) == pytest.approx(1.0)
    np.testing.assert_allclose(export.adjust_normal(normal, 1.0, np.pi / 2)[0, 0], [0, -0.6, 0.8], atol=1e-6)


def test_gltf_finds_roughness_in_green_and_metallic_in_blue(tmp_path):
    roughness = np.linspace(0, 1, 64, dtype=np.float32).reshape(8, 8)
    files = export.write_gltf_maps(tmp_path, "stone", MAPS | {"roughness": roughness, "metallic": 0.25})
    assert files == ["stone_basecolor.png", "stone_orm.png"]
    blue, green, red = np.moveaxis(cv2.imread(str(tmp_path / "stone_orm.png")) / 255, -1, 0)
    np.testing.assert_allclose(green, roughness, atol=1 / 255)
    np.testing.assert_allclose(blue, 0.25, atol=1 / 255)
    assert (red == 1).all()


def read(path):
    root = ElementTree.parse(path).getroot()
    return root, {node.get("name"): node for node in root.iter() if node.tag not in ("input", "output")}


def test_materialx_of_files_links_every_map(tmp_path):
    files = {kind: f"stone_{kind}.png" for kind in ("basecolor", "roughness", "normal", "height")}
    export.write_materialx(tmp_path / "m.mtlx", "2 stone", MAPS | files | {"height_scale": 0.1}, 2.0, np.pi / 2)
    root, nodes = read(tmp_path / "m.mtlx")
    found = {i.get("value") for i in root.iter("input") if i.get("type") == "filename"}
    assert found == set(files.values())
    for link in root.iter("input"):
        if link.get("nodename"):
            assert link.get("nodename") in nodes
        if link.get("output"):
            assert link.get("output") in {o.get("name") for o in nodes[link.get("nodegraph")].iter("output")}
    assert all(i.get("value") == "0.5, 0.5" for i in root.iter("input") if i.get("name") == "uvtiling")
    assert {i.get("colorspace") for i in nodes["image_basecolor"]} - {None} == {"srgb_texture"}


def test_materialx_of_values_has_no_graph(tmp_path):
    export.write_materialx(tmp_path / "m.mtlx", "paint", MAPS, None)
    root, _nodes = read(tmp_path / "m.mtlx")
    assert [child.tag for child in root] == ["standard_surface", "surfacematerial"]
    assert {i.get("name"): i.get("value") for i in root[0]} == {
        "base_color": "0.2, 0.4, 0.6",
        "specular_roughness": "0.7",
        "metalness": "0",
        "base": "1",
    }


@pytest.mark.parametrize("files", [(), ("basecolor", "normal"), ("basecolor", "roughness", "normal", "height")])
def test_materialx_is_valid_by_its_own_library(tmp_path, files):
    materialx = pytest.importorskip("MaterialX")
    maps = MAPS | {kind: f"{kind}.png" for kind in files} | {"height_scale": 0.1}
    export.write_materialx(tmp_path / "m.mtlx", "Größe", maps, 1.0, 0.3)
    library, document = materialx.createDocument(), materialx.createDocument()
    materialx.loadLibraries(materialx.getDefaultDataLibraryFolders(), materialx.getDefaultDataSearchPath(), library)
    materialx.readFromXmlFile(document, str(tmp_path / "m.mtlx"))
    document.importLibrary(library)
    valid, said = document.validate()
    assert valid, said
    assert all(node.getNodeDef() for node in document.getNodes())
