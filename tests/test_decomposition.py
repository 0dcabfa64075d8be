import numpy as np
import pytest
import torch
from material_palette.core.decomposition import analytic, constant, decompose, unet
from material_palette.core.errors import Cancelled, PaletteError
from material_palette.core.exemplar import LUMINANCE
from material_palette.core.image import linear_from_srgb
from material_palette.core.torus import WRAP_GATE, gradient, wrap_ratio
from textures import quiet, tileable_noise


@pytest.fixture(scope="module")
def texture():
    grey = 0.1 + 0.6 * tileable_noise(96, 128)
    tint = 1 + 0.3 * (tileable_noise(96, 128, 1) - 0.5)
    return np.stack([grey * tint, grey, grey / tint], -1).astype(np.float32)


each = pytest.mark.parametrize("decomposer", ["unet", "analytic"])


@each
@pytest.mark.parametrize("shift", [(31, -50), (1, 0)])
def test_rolling_the_texture_rolls_the_maps(texture, decomposer, shift):
    maps = decompose(texture, quiet, decomposer)
    rolled = decompose(np.roll(texture, shift, (0, 1)), quiet, decomposer)
    for name in ("albedo", "normal", "height", "roughness"):
        value = getattr(maps, name)
        expected = np.roll(value, shift, (0, 1)) if np.ndim(value) > 1 else value
        assert np.abs(getattr(rolled, name) - expected).max() < 1e-3, name


@each
def test_all_maps_tile(texture, decomposer):
    maps = decompose(texture, quiet, decomposer)
    shown = [m for m in (maps.albedo, maps.normal, maps.height, maps.roughness) if np.ndim(m) > 1]
    assert all(wrap_ratio(m) <= WRAP_GATE for m in shown)


@each
def test_normal_is_the_gradient_of_the_height(texture, decomposer):
    maps = decompose(texture, quiet, decomposer)
    dx, dy = gradient(torch.from_numpy(maps.height) * texture.shape[1])
    assert np.allclose(np.linalg.norm(maps.normal, axis=-1), 1, atol=1e-5)
    assert np.allclose(maps.normal[..., 0] / maps.normal[..., 2], -dx.numpy(), atol=1e-4)
    assert np.allclose(maps.normal[..., 1] / maps.normal[..., 2], dy.numpy(), atol=1e-4)
    assert abs(maps.height.mean()) < 1e-6


@each
def test_roughness_varies_a_little_and_less_where_there_is_little_to_see(texture, decomposer):
    maps = decompose(texture, quiet, decomposer)
    luminance = np.log(maps.albedo @ LUMINANCE + analytic.DARKEST)
    assert np.corrcoef(maps.roughness.ravel(), luminance.ravel())[0, 1] < -0.95
    assert maps.roughness.std() == pytest.approx(analytic.VARIATION, rel=0.02)
    mean = texture.mean((0, 1))
    faint = decompose((mean + 0.05 * (texture - mean)).astype(np.float32), quiet, decomposer)
    assert faint.roughness.std() < analytic.VARIATION / 2


@each
def test_any_size(decomposer):
    texture = linear_from_srgb(tileable_noise(70, 33)[..., None].repeat(3, -1).astype(np.float32))
    maps = decompose(texture, quiet, decomposer)
    assert maps.albedo.shape == maps.normal.shape == (70, 33, 3)
    assert 0 <= maps.albedo.min() and maps.albedo.max() <= 1
    assert np.isfinite(maps.height).all()


@each
def test_cancelling_ends_it(texture, decomposer):
    def stop(fraction, message):
        if fraction > 0.3:
            raise Cancelled

    with pytest.raises(Cancelled):
        decompose(texture, stop, decomposer)


@each
def test_a_constant_texture_is_flat_and_keeps_its_colour(decomposer):
    maps = decompose(np.full((64, 64, 3), 0.3, np.float32), quiet, decomposer)
    assert np.ptp(maps.albedo) < 0.02
    assert np.abs(maps.albedo - 0.3).max() < 0.06
    assert maps.normal[..., 2].min() > 0.999


@each
def test_shading_of_a_flat_surface_is_no_relief(decomposer):
    v = np.linspace(0, 2 * np.pi, 256, endpoint=False, dtype=np.float32)
    shading = 0.35 + 0.15 * np.sin(v)[:, None] * np.sin(v)[None]
    maps = decompose(np.repeat(shading[..., None], 3, -1).astype(np.float32), quiet, decomposer)
    assert maps.normal[..., 2].min() > 0.995


def test_an_unknown_decomposer_is_named():
    with pytest.raises(PaletteError, match="nonsense.*unet"):
        decompose(np.zeros((32, 32, 3), np.float32), quiet, "nonsense")


def test_weights_come_from_the_file_that_is_named(tmp_path):
    with pytest.raises(PaletteError, match="resnet101=FILE"):
        decompose(np.zeros((32, 32, 3), np.float32), quiet, "resnet101")
    with pytest.raises(PaletteError, match="none at .*missing.ckpt"):
        decompose(np.zeros((32, 32, 3), np.float32), quiet, f"resnet101={tmp_path / 'missing.ckpt'}")
    with pytest.raises(PaletteError, match="unknown"):
        decompose(np.zeros((32, 32, 3), np.float32), quiet, f"analytic={unet.WEIGHTS}")
    texture = np.repeat(tileable_noise(64, 64)[..., None], 3, -1).astype(np.float32)
    named, shipped = (decompose(texture, quiet, d) for d in (f"unet={unet.WEIGHTS}", "unet"))
    assert np.array_equal(named.normal, shipped.normal)


def test_tiles_give_what_one_pass_gives(monkeypatch):
    shades = tileable_noise(640, 640)
    texture = (0.1 + 0.5 * np.stack([shades, shades**2, shades], -1)).astype(np.float32)
    monkeypatch.setattr(unet, "TILE", (384, 640))
    tiled = decompose(texture, quiet)
    monkeypatch.setattr(unet, "TILE", (640, 640))
    whole = decompose(texture, quiet)
    for name in ("albedo", "normal"):
        assert np.abs(getattr(tiled, name) - getattr(whole, name)).max() < 1 / 255, name


def test_weights_of_another_network_are_refused_by_name():
    with pytest.raises(PaletteError, match=r"stlpips_alex\.safetensors"):
        unet.load(unet.WEIGHTS.with_name("stlpips_alex.safetensors"))


def test_a_bright_bump_faces_up_at_its_upper_side():
    y, x = np.mgrid[-32:32, -32:32].astype(np.float32)
    bump = 0.2 + 0.5 * np.exp(-(x**2 + y**2) / 50)
    maps = analytic.decompose(np.repeat(bump[..., None], 3, -1), quiet)
    assert maps.normal[26, 32, 1] > 0.02
    assert maps.normal[38, 32, 1] < -0.02
    assert maps.normal[32, 26, 0] < -0.02
    assert maps.height[32, 32] == maps.height.max()


def test_a_change_of_colour_alone_is_no_relief():
    stripes = (np.sin(np.arange(64) / 64 * 2 * np.pi * 4) > 0).astype(np.float32)[None, :, None]
    red, green = np.array([0.6, 0.1, 0.1]), np.array([0.1, 0.0, 0.1])
    green[1] = (red @ LUMINANCE - green @ LUMINANCE) / LUMINANCE[1]
    texture = np.broadcast_to(stripes * red + (1 - stripes) * green, (64, 64, 3)).astype(np.float32)
    maps = analytic.decompose(texture, quiet)
    assert maps.normal[..., 2].min() > 0.999
    assert np.abs(maps.albedo - texture).max() < 0.01


def test_a_uniform_regions_material_has_no_map():
    material = constant(np.array([0.2, 1.4, 0.1]))
    assert material.albedo.tolist() == pytest.approx([0.2, 1.0, 0.1])
    assert material.height is None and material.normal.tolist() == [0, 0, 1]
