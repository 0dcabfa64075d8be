import numpy as np
import pytest
import torch
from material_palette.core.torus import (
    WRAP_GATE,
    blur,
    gradient,
    integrate,
    normal_from_height,
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
