import math

import numpy as np
import pytest
import torch
from material_palette.core import brdf
from material_palette.core.material import SVBRDF

UP = torch.tensor([0.0, 0.0, 1.0])


def direction(angle):
    return torch.tensor([math.sin(angle), 0.0, math.cos(angle)])


def test_light_and_viewer_can_be_exchanged():
    albedo, light, view = torch.tensor([0.5, 0.3, 0.2]), direction(0.3), direction(-0.9)
    there = brdf.shade(albedo, UP, torch.tensor(0.4), light, view) / light[2]
    back = brdf.shade(albedo, UP, torch.tensor(0.4), view, light) / view[2]
    assert torch.allclose(there, back, rtol=1e-5)


@pytest.mark.parametrize("roughness", [0.2, 0.4, 0.6])
def test_the_highlight_of_ggx_at_normal_incidence(roughness):
    # D(0) = 1 / (pi alpha^2), G = 1, F = F0, hence pi * D F / 4
    light = brdf.shade(torch.zeros(3), UP, torch.tensor(roughness), UP, UP)
    assert light[0].item() == pytest.approx(brdf.F0 / (4 * roughness**4), rel=1e-4)


def test_no_more_light_leaves_than_arrives():
    n = 200
    cosines = (torch.arange(n) + 0.5) / n
    angles = (torch.arange(n) + 0.5) / n * 2 * math.pi
    z, phi = torch.meshgrid(cosines, angles, indexing="ij")
    r = torch.sqrt(1 - z**2)
    lights = torch.stack([r * torch.cos(phi), r * torch.sin(phi), z], -1)
    for roughness in (0.3, 0.7):
        out = brdf.shade(
            torch.zeros(3), UP.expand_as(lights), torch.full((n, n), roughness), lights, UP.expand_as(lights)
        )
        # mean over the hemisphere of f cos, times 2 pi; shade is pi f cos
        assert 0.02 < (out[..., 0].mean() * 2).item() < 0.06


def test_sphere_of_a_constant_material():
    picture = brdf.render_sphere(SVBRDF(np.array([0.5, 0.1, 0.1]), np.array([0, 0, 1]), 0.6), 64)
    assert picture.shape == (64, 64, 4) and picture.dtype == np.float32
    assert picture[0, 0, 3] == 0 and picture[32, 32, 3] == 1
    assert picture[32, 32, 0] > 2 * picture[32, 32, 1]
    # the key light comes from the upper left
    assert picture[20, 20, 0] > picture[44, 44, 0]
