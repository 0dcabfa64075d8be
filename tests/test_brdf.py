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


def random_unit(*shape, generator):
    v = torch.randn(*shape, 3, generator=generator, dtype=torch.float64)
    return torch.nn.functional.normalize(torch.cat([v[..., :2] * 0.5, v[..., 2:].abs() + 0.3], -1), dim=-1)


def test_gradients_are_those_of_finite_differences():
    generator = torch.Generator().manual_seed(0)
    shape = (2, 3)  # a batch
    normal, light, view = (random_unit(*shape, generator=generator) for _ in range(3))
    albedo = torch.rand(*shape, 3, generator=generator, dtype=torch.float64)
    roughness, metallic = 0.2 + 0.7 * torch.rand(2, *shape, generator=generator, dtype=torch.float64)
    inputs = [x.requires_grad_() for x in (albedo, normal, roughness, light, view, metallic)]
    assert torch.autograd.gradcheck(brdf.shade, inputs)


def test_gradients_are_finite_at_grazing_angles_and_behind_the_light():
    normal = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 0.6, 0.8]]).requires_grad_()
    roughness = torch.tensor([0.0, 0.5, 1.0]).requires_grad_()
    light = torch.tensor([0.0, 0, 1]).expand(3, 3)
    brdf.shade(torch.full((3, 3), 0.5), normal, roughness, light, light).sum().backward()
    assert torch.isfinite(normal.grad).all() and torch.isfinite(roughness.grad).all()


def test_the_highlight_of_a_mirror_is_bright_not_infinite():
    normal = random_unit(20_000, generator=torch.Generator().manual_seed(2)).float()
    light = brdf.shade(torch.zeros(20_000, 3), normal, torch.zeros(20_000), normal, normal)
    assert torch.isfinite(light).all() and light.min() > 1e3


def test_a_lamp_far_away_is_a_sun():
    generator = torch.Generator().manual_seed(1)
    albedo, normal = torch.rand(2, 8, 8, 3, generator=generator), random_unit(2, 8, 8, generator=generator).float()
    roughness, sun = torch.rand(2, 8, 8, generator=generator), direction(0.6)
    far, falloff = brdf.towards(sun * 1e4, brdf.plane(8, 8))
    there = brdf.render(albedo, normal, roughness, far[None], falloff[None], UP)
    assert torch.allclose(there, brdf.shade(albedo, normal, roughness, sun, UP), atol=2e-3)


def test_a_lamp_overhead_is_brightest_below_and_falls_off_with_the_third_power_of_the_cosine():
    places = brdf.plane(32, 64)
    light, falloff = brdf.towards(torch.tensor([0.0, 0.0, 0.5]), places)
    matt = brdf.render(torch.ones(32, 64, 3), UP, torch.ones(32, 64), light[None], falloff[None], UP)
    cosine = 0.5 / torch.sqrt(0.25 + places.square().sum(-1))
    assert places[0, 0].tolist() == pytest.approx([-0.5 + 0.5 / 64, 0.25 - 0.5 / 64, 0])
    assert torch.allclose(matt[..., 0] / cosine**3, torch.ones(32, 64), atol=0.06)


def test_an_environment_is_the_sum_of_its_lights():
    lights = brdf.sky(256)
    assert lights.norm(dim=-1).sub(1).abs().max() < 1e-5
    material = torch.full((1, 1, 3), 0.5), UP.expand(1, 1, 3), torch.full((1, 1), 0.8)
    seen = brdf.render(*material, lights[:, None, None], torch.full((256, 1), 2 / 256), UP)
    # half of what gets in, and about 4 % reflected
    assert seen[0, 0, 0].item() == pytest.approx(0.5 * 0.96 + 0.04, abs=0.02)
    mean = brdf.render(*material, lights[:, None, None], (lights[:, 2:] > 0.5) * 2.0 / 256, UP)
    assert mean[0, 0, 0] < seen[0, 0, 0]


def test_pypbr_renders_the_same(monkeypatch):
    """PyPBR means alpha where we mean the square root of it, and takes Schlick's fit for Smith's masking."""
    import sys
    import types

    # its materials read images by torchvision, which this does not need
    for name in ("torchvision", "torchvision.transforms", "torchvision.transforms.functional"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setattr(sys.modules["torchvision.transforms"], "functional", None, raising=False)
    models = pytest.importorskip("pypbr.models")
    generator = torch.Generator().manual_seed(2)
    normal = random_unit(16, 16, generator=generator).float()
    albedo, metallic = torch.rand(16, 16, 3, generator=generator), torch.rand(16, 16, generator=generator).round()
    roughness = 0.4 + 0.5 * torch.rand(16, 16, generator=generator)
    sun = torch.nn.functional.normalize(torch.tensor([0.3, -0.4, 0.8]), dim=0)
    material = types.SimpleNamespace(
        device="cpu",
        roughness=roughness[None] ** 2,
        normal=normal.movedim(-1, 0),
        linear_albedo=albedo.movedim(-1, 0),
        metallic=metallic[None],
    )
    theirs = models.CookTorranceBRDF("directional")(material, UP, sun, torch.full((3,), 1.0), return_srgb=False)
    ours = brdf.shade(albedo, normal, roughness, sun, UP, metallic) / math.pi
    lit = ours.mean(-1) > 0.01
    ratio = theirs.movedim(0, -1).mean(-1)[lit] / ours.mean(-1)[lit]
    print("pypbr", ratio.min(), ratio.median(), ratio.max())
    assert ratio.median().item() == pytest.approx(1, abs=0.05)
