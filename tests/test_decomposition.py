import numpy as np
import pytest
import torch
from material_palette.core.decomposition import constant, decompose
from material_palette.core.exemplar import LUMINANCE
from material_palette.core.torus import WRAP_GATE, gradient, wrap_ratio
from textures import quiet, tileable_noise


@pytest.fixture(scope="module")
def texture():
    grey = 0.1 + 0.6 * tileable_noise(96, 128)
    tint = 1 + 0.3 * (tileable_noise(96, 128, 1) - 0.5)
    return np.stack([grey * tint, grey, grey / tint], -1).astype(np.float32)


def test_rolling_the_texture_rolls_the_maps(texture):
    shift = (31, -50)
    maps, rolled = decompose(texture, quiet), decompose(np.roll(texture, shift, (0, 1)), quiet)
    for name in ("albedo", "normal", "height"):
        expected = np.roll(getattr(maps, name), shift, (0, 1))
        assert np.abs(getattr(rolled, name) - expected).max() < 1e-3, name


def test_all_maps_tile(texture):
    maps = decompose(texture, quiet)
    assert all(wrap_ratio(m) <= WRAP_GATE for m in (maps.albedo, maps.normal, maps.height))


def test_normal_is_the_gradient_of_the_height(texture):
    maps = decompose(texture, quiet)
    dx, dy = gradient(torch.from_numpy(maps.height) * texture.shape[1])
    assert np.allclose(np.linalg.norm(maps.normal, axis=-1), 1, atol=1e-5)
    assert np.allclose(maps.normal[..., 0] / maps.normal[..., 2], -dx.numpy(), atol=1e-4)
    assert np.allclose(maps.normal[..., 1] / maps.normal[..., 2], dy.numpy(), atol=1e-4)
    assert abs(maps.height.mean()) < 1e-6


def test_a_bright_bump_faces_up_at_its_upper_side():
    y, x = np.mgrid[-32:32, -32:32].astype(np.float32)
    bump = 0.2 + 0.5 * np.exp(-(x**2 + y**2) / 50)
    maps = decompose(np.repeat(bump[..., None], 3, -1), quiet)
    assert maps.normal[26, 32, 1] > 0.02
    assert maps.normal[38, 32, 1] < -0.02
    assert maps.normal[32, 26, 0] < -0.02
    assert maps.height[32, 32] == maps.height.max()


def test_a_change_of_colour_alone_is_no_relief():
    stripes = (np.sin(np.arange(64) / 64 * 2 * np.pi * 4) > 0).astype(np.float32)[None, :, None]
    red, green = np.array([0.6, 0.1, 0.1]), np.array([0.1, 0.0, 0.1])
    green[1] = (red @ LUMINANCE - green @ LUMINANCE) / LUMINANCE[1]
    texture = np.broadcast_to(stripes * red + (1 - stripes) * green, (64, 64, 3)).astype(np.float32)
    maps = decompose(texture, quiet)
    assert maps.normal[..., 2].min() > 0.999
    assert np.abs(maps.albedo - texture).max() < 0.01


def test_a_constant_texture_is_flat():
    maps = decompose(np.full((32, 32, 3), 0.3, np.float32), quiet)
    assert np.allclose(maps.albedo, 0.3, atol=1e-5)
    assert np.allclose(maps.normal, (0, 0, 1), atol=1e-5)


def test_a_uniform_regions_material_has_no_map():
    material = constant(np.array([0.2, 1.4, 0.1]))
    assert material.albedo.tolist() == pytest.approx([0.2, 1.0, 0.1])
    assert material.height is None and material.normal.tolist() == [0, 0, 1]
