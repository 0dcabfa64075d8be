"""A material's preview is of the material as the artist has adjusted it."""

import bpy
import numpy as np
import pytest
from material_palette.core import nodes

pytest.importorskip("torch")


@pytest.fixture
def stripes(settings, tmp_path, make_record, write_maps):
    """A material whose texture changes from left to right only, with a preview."""
    maps = write_maps(roles=("basecolor", "roughness"))
    from material_palette.core.image import write_image

    across = np.broadcast_to(np.linspace(0.2, 0.8, 16, dtype=np.float32)[None, :, None], (16, 16, 3))
    write_image(tmp_path / maps["basecolor"]["file"], np.ascontiguousarray(across))
    grey = np.full((256, 256, 4), 0.5, np.float32)
    return nodes.build_material(make_record(maps), tmp_path, pack=True, preview=grey)


def is_up_to_date(material):
    return nodes.preview_is_of(material, nodes.Controls(material).look())


def paint(material):
    from material_palette.operators.preview import painter

    return painter(material)()


def middle(picture):
    from material_palette.core.image import linear_from_srgb

    return linear_from_srgb(picture[96:160, 96:160, :3])


@pytest.mark.parametrize(
    "change",
    [{"brightness": 0.5}, {"roughness_offset": 0.1}, {"rotation": 1.0}, {"tile_size": 0.5}, {"saturation": 0.0}],
)
def test_every_adjustment_is_noticed_and_so_is_its_end(stripes, change):
    assert is_up_to_date(stripes)
    for name, value in change.items():
        setattr(stripes.material_palette, name, value)
    assert not is_up_to_date(stripes)
    bpy.context.scene.material_palette.palette.add().material = stripes
    bpy.ops.material_palette.reset_material()
    assert is_up_to_date(stripes)


def test_a_constant_is_noticed_too(make_record, tmp_path):
    plain = nodes.build_material(make_record(), tmp_path, pack=True, preview=np.ones((256, 256, 4), np.float32))
    before = paint(plain)
    nodes.Controls(plain).node("principled").inputs["Base Color"].default_value = (0.8, 0.1, 0.1, 1.0)
    assert not is_up_to_date(plain)
    after = paint(plain)
    assert middle(after)[..., 0].mean() > 2 * middle(before)[..., 0].mean()
    nodes.set_preview(plain, after)
    assert is_up_to_date(plain)


def test_half_the_brightness_is_half_the_diffuse_light(stripes):
    stripes.material_palette.roughness_offset = 1.0  # next to no highlight
    before = middle(paint(stripes)).mean()
    stripes.material_palette.brightness = 0.5
    assert 0.45 < middle(paint(stripes)).mean() / before < 0.6


def test_a_quarter_turn_turns_the_stripes(stripes):
    def change(axis):
        return np.abs(np.diff(middle(paint(stripes)).mean(-1), axis=axis)).mean()

    assert change(1) > 3 * change(0)
    stripes.material_palette.rotation = np.pi / 2
    assert change(0) > 3 * change(1)


def test_maps_are_averaged_down(stripes):
    from material_palette.operators.export import adjuster

    full, small = (adjuster(stripes, most)()[0]["roughness"] for most in (None, 4))
    assert small.shape == (4, 4)
    np.testing.assert_allclose(small, full.reshape(4, 4, 4, 4).mean((1, 3)), atol=1e-5)
