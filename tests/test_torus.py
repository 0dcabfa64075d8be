import numpy as np
import pytest
import torch
from material_palette.core.torus import (
    WRAP_GATE,
    blur,
    close_seam,
    gradient,
    integrate,
    normal_from_height,
    resize,
    wrap_ratio,
)
from textures import tileable_noise


def test_wrap_ratio_passes_what_tiles_and_fails_what_does_not():
    tile = tileable_noise(96, 128)
    assert wrap_ratio(tile) < WRAP_GATE
    ramp = np.linspace(0, 1, 128, dtype=np.float32)
    assert wrap_ratio(tile + ramp) > WRAP_GATE
    assert wrap_ratio(tile + ramp[:96, None]) > WRAP_GATE


def test_wrap_ratio_of_a_constant_is_zero():
    assert wrap_ratio(np.full((16, 16, 3), 0.3)) == 0


def test_bricks_whose_joint_is_on_the_border_pass():
    wall = np.ones((64, 64), np.float32)
    wall[::16] = 0
    assert wrap_ratio(wall) < WRAP_GATE


@pytest.mark.parametrize("shape", [(64, 96), (63, 81)])
def test_integrating_a_gradient_gives_the_height_back(shape):
    height = torch.from_numpy(tileable_noise(*shape))
    height = blur(height, 1.0)
    found = integrate(*gradient(height))
    assert torch.allclose(found, height - height.mean(), atol=2e-3)


def test_blur_keeps_the_mean_and_wraps():
    x = torch.zeros(32, 32)
    x[0, 0] = 1
    y = blur(x, 2.0)
    assert y.sum().item() == pytest.approx(1, abs=1e-5)
    assert torch.allclose(y, y.flip(0).roll(1, 0), atol=1e-6)


def test_normals_are_unit_and_point_away_from_the_slope_with_y_up():
    rows = torch.arange(64, dtype=torch.float32)
    # higher towards the top of the picture on the lower half: a surface facing down there
    height = (torch.cos(rows / 64 * 2 * torch.pi)[:, None] * 0.05).expand(64, 64)
    normal = normal_from_height(height)
    assert torch.allclose(normal.norm(dim=-1), torch.ones(64, 64), atol=1e-5)
    # at row 16 the height falls with the row: the slope descends towards the picture's lower edge
    assert normal[16, 0, 1] < -0.1
    assert normal[48, 0, 1] > 0.1
    assert normal[..., 0].abs().max() < 1e-4


def test_closing_a_seam_solves_the_screened_poisson_equation():
    """Of a ramp, whose two ends do not meet, the solution is known: away from the border u'' - f'' = (u - f) / reach^2,
    so that what is added is a hyperbolic sine about the middle; it leaves a share of 1 / (2 reach) of the step."""
    height, reach, jump = 256, 8.0, 0.2
    ramp = jump * (np.arange(height) + 0.5) / height
    pixels = torch.from_numpy(np.broadcast_to(ramp[:, None, None], (height, 16, 1)).copy())
    closed = close_seam(pixels, reach)[:, 3, 0].numpy()
    change = closed - ramp
    rate = 2 * np.arcsinh(0.5 / reach)  # of the discrete equation
    rows = np.arange(height) - (height - 1) / 2
    shape = np.sinh(rate * rows)
    assert np.allclose(change, change[0] / shape[0] * shape, atol=1e-6)
    slope = jump / height
    assert abs((closed[0] - closed[-1]) - slope) < 0.07 * jump


def test_a_seam_made_by_hand_is_closed_and_the_rest_kept():
    tile = np.stack([tileable_noise(160, 192, seed) for seed in (0, 1, 2)], -1) * 0.6 + 0.1
    ramp = np.linspace(0, 0.3, 192, dtype=np.float32)[:, None]
    assert wrap_ratio(tile) < WRAP_GATE
    seamed = (tile + ramp + np.linspace(0.2, 0, 160, dtype=np.float32)[:, None, None]).astype(np.float32)
    assert wrap_ratio(seamed) > 2 * WRAP_GATE
    closed = close_seam(torch.from_numpy(seamed)).numpy()
    assert wrap_ratio(closed) < WRAP_GATE
    assert np.abs(closed - seamed)[48:-48, 48:-48].max() < 1 / 255
    assert np.allclose(closed.mean((0, 1)), seamed.mean((0, 1)), atol=1e-4)


def test_resizing_wraps_and_keeps_the_picture():
    tile = np.stack([tileable_noise(96, 128, seed) for seed in (0, 1, 2)], -1)
    assert resize(tile, (96, 128)) is tile
    for size in ((100, 120), (48, 64), (200, 300)):
        resized = resize(tile, size)
        assert resized.shape == (*size, 3) and wrap_ratio(resized) < WRAP_GATE
        assert np.allclose(resized.mean((0, 1)), tile.mean((0, 1)), atol=0.01)
    # rolling by half the tile before is rolling by half after
    there = resize(np.roll(tile, (48, 64), (0, 1)), (48, 64))
    assert np.allclose(there, np.roll(resize(tile, (48, 64)), (24, 32), (0, 1)), atol=1e-4)
