import sys

import numpy as np
import pytest
import torch
from conftest import ROOT
from material_palette.core.torus import WRAP_GATE, normal_from_height

sys.path.insert(0, str(ROOT / "training"))
import procedural  # noqa: E402

SIZE = 96


@pytest.fixture(scope="module")
def materials():
    return {name: procedural.material(7, SIZE, name) for name in procedural.FAMILIES}


def test_a_seed_is_one_material():
    first, again, other = (procedural.material(seed, SIZE) for seed in (3, 3, 4))
    for name in ("albedo", "normal", "roughness", "height", "metallic"):
        assert np.array_equal(getattr(first, name), getattr(again, name)), name
    assert not np.array_equal(first.albedo, other.albedo)


def test_every_family_has_maps_of_the_stated_ranges(materials):
    for family, m in materials.items():
        for name in ("albedo", "roughness", "metallic"):
            value = getattr(m, name)
            assert value.dtype == np.float32 and value.shape[:2] == (SIZE, SIZE), (family, name)
            assert 0 <= value.min() and value.max() <= 1, (family, name)
        assert abs(m.height.mean()) < 1e-5, family
        assert np.array_equal(m.normal, normal_from_height(torch.from_numpy(m.height)).numpy()), family
        assert m.albedo.min() > 0.001 and m.roughness.min() > 0.029, family


def test_every_family_tiles(materials):
    for family, m in materials.items():
        for name in ("albedo", "normal", "roughness", "height"):
            lines = np.moveaxis(getattr(m, name), 1, 0)
            for value in (getattr(m, name), lines):
                steps = np.abs(value - np.roll(value, 1, 0)).reshape(SIZE, -1).mean(1)
                # a joint of bricks may fall on the border, and then it is as strong as any joint inside
                assert steps[0] <= max(WRAP_GATE * np.percentile(steps[1:], 98), 1.05 * steps[1:].max()), (family, name)


def test_relief_and_colour_vary_without_each_other():
    drawn = [procedural.material(seed, 48) for seed in range(120)]
    slope = np.array([np.sqrt(np.mean((m.normal[..., :2] / m.normal[..., 2:]) ** 2)) for m in drawn])
    contrast = np.array([np.log(m.albedo.mean(-1) + 0.02).std() for m in drawn])
    assert ((slope > 0.1) & (contrast < 0.02)).any()
    assert ((slope < 0.01) & (contrast > 0.2)).any()
    assert np.quantile(slope, 0.1) < 0.02 and np.quantile(slope, 0.9) > 0.25
    assert np.quantile([m.roughness.mean() for m in drawn], 0.9) > 0.8
    assert np.quantile([m.roughness.mean() for m in drawn], 0.05) < 0.35
