from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch
from material_palette.core.engines import patch
from material_palette.core.errors import Cancelled, PaletteError
from material_palette.core.torus import WRAP_GATE, wrap_ratio
from textures import pebbles, quiet


def synthesise(pixels, mask=None, size=(192, 192), seed=0, quality="draft"):
    mask = np.ones(pixels.shape[:2], bool) if mask is None else mask
    return patch.sample(patch.learn(pixels, mask, quiet), size, seed, quiet, quality)


@pytest.mark.parametrize("quality", patch.PRESETS)
def test_texture_tiles_where_the_exemplar_does_not(quality):
    # the noise is as it is, the ramp makes the exemplar's own border a step
    exemplar = np.clip(pebbles(120, 120) * 0.6 + np.linspace(0, 0.4, 120, dtype=np.float32)[:, None, None], 0, 1)
    assert wrap_ratio(exemplar) > WRAP_GATE
    assert wrap_ratio(synthesise(exemplar, quality=quality).pixels) <= WRAP_GATE


def test_same_seed_same_texture_and_another_seed_another():
    exemplar = pebbles(100, 100)
    first, again, other = (synthesise(exemplar, seed=s).pixels for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert np.abs(first - other).mean() > 0.05


def test_the_number_of_cores_and_their_timing_do_not_show(monkeypatch):
    exemplar = pebbles(100, 100)
    # bands of a few rows: many are searched side by side
    monkeypatch.setattr(patch, "BAND", 1500)
    monkeypatch.setattr(patch.os, "cpu_count", lambda: 1)
    alone = synthesise(exemplar, quality="balanced").coordinates
    monkeypatch.setattr(patch.os, "cpu_count", lambda: 4)
    for _ in range(3):
        assert np.array_equal(synthesise(exemplar, quality="balanced").coordinates, alone)


@pytest.mark.parametrize("size", [(64, 64), (67, 130), (300, 90)])
def test_any_size(size):
    texture = synthesise(pebbles(80, 110), size=size)
    assert texture.pixels.shape == (*size, 3)
    assert texture.coordinates.shape == (*size, 2)
    assert wrap_ratio(texture.pixels) <= WRAP_GATE


def test_nothing_outside_the_region_is_used():
    exemplar = pebbles(120, 120)
    mask = np.zeros((120, 120), bool)
    cv2.circle(mask.view(np.uint8), (55, 60), 45, 1, -1)
    exemplar[~mask] = (0, 0, 1)
    texture = synthesise(exemplar, mask)
    # blue would show as more blue than red, which no pebble has
    assert (texture.pixels[..., 2] <= texture.pixels[..., 0] + 0.1).all()
    rows, columns = texture.coordinates[..., 0], texture.coordinates[..., 1]
    assert mask[rows, columns].all()


def test_coordinates_carry_the_colour():
    exemplar = pebbles(100, 100)
    texture = synthesise(exemplar)
    carried = exemplar[texture.coordinates[..., 0], texture.coordinates[..., 1]]
    # blended at the seams only
    assert np.median(np.abs(carried - texture.pixels)) < 0.01


def test_the_texture_has_the_exemplars_colours_and_sharpness():
    exemplar = pebbles(140, 140)
    texture = synthesise(exemplar, quality="balanced", size=(256, 256)).pixels
    assert np.abs(texture.mean((0, 1)) - exemplar.mean((0, 1))).max() < 0.05
    assert np.abs(texture.std((0, 1)) / exemplar.std((0, 1)) - 1).max() < 0.15

    def sharpness(x):
        return np.abs(cv2.Laplacian(x.mean(-1), cv2.CV_32F)).mean()

    assert 0.8 < sharpness(texture) / sharpness(exemplar) < 1.1


def test_patches_are_matched_to_the_exemplars_on_the_torus():
    exemplar = pebbles(96, 96)
    level = patch.learn(exemplar, np.ones((96, 96), bool), quiet).levels[0]
    dull = torch.from_numpy(pebbles(64, 80, seed=5) * 0.6 + 0.1)

    def match(image):
        with ThreadPoolExecutor(2) as pool:
            return patch._match(level, image, 4, torch.Generator().manual_seed(0), pool, lambda fraction: None)

    matched = match(dull)
    for statistic in (torch.mean, torch.std):
        wanted = statistic(level.pixels)
        assert abs(statistic(matched) - wanted) < 0.2 * abs(statistic(dull) - wanted)
    rolled = match(dull.roll((30, 40), (0, 1))).roll((-30, -40), (0, 1))
    # the ranks are of patches drawn at random
    assert (rolled - matched).abs().mean() < 0.01


def test_enlarging_wraps():
    def enlarged(image, size):
        large = torch.zeros(*size, 3)
        with ThreadPoolExecutor(2) as pool:
            patch._add_enlarged(large, image, pool, lambda fraction: None)
        return large

    image = torch.rand(6, 9, 3)
    large = enlarged(image, (18, 27))
    assert torch.allclose(enlarged(image.roll((2, 1), (0, 1)), (18, 27)), large.roll((6, 3), (0, 1)), atol=1e-6)
    assert torch.allclose(enlarged(torch.full((6, 9, 3), 0.3), (13, 20)), torch.full((13, 20, 3), 0.3))


def test_the_sample_most_alike_is_kept():
    exemplar = pebbles(160, 160)
    level = patch.learn(exemplar, np.ones((160, 160), bool), quiet).levels[0]
    garbage = level.valid.nonzero()[:, 0][torch.randint(int(level.valid.sum()), (128, 128))]
    verbatim = (torch.arange(128)[:, None] + 8) * 160 + torch.arange(128) + 8
    assert patch._most_alike(level, [garbage, verbatim]) is verbatim
    assert patch._most_alike(level, [verbatim, garbage]) is verbatim


def test_the_whole_region_is_used():
    texture = synthesise(pebbles(96, 96), size=(256, 256), quality="balanced")
    used = np.zeros((96, 96), np.float32)
    np.add.at(used, (texture.coordinates[..., 0], texture.coordinates[..., 1]), 1)
    blocks = cv2.resize(used[:96, :96], (8, 8), interpolation=cv2.INTER_AREA)
    assert (blocks > 0).mean() > 0.95
    assert blocks.max() < 6 * blocks.mean()


@pytest.mark.parametrize("kind", ["band", "islands", "ring"])
def test_regions_of_any_shape(kind):
    exemplar, mask = pebbles(160, 160), np.zeros((160, 160), np.uint8)
    if kind == "band":
        cv2.line(mask, (5, 10), (150, 120), 1, 14)
    elif kind == "ring":
        cv2.circle(mask, (80, 80), 60, 1, 16)
    else:
        for x, y in np.random.default_rng(0).integers(15, 145, (20, 2)).tolist():
            cv2.circle(mask, (x, y), 10, 1, -1)
    texture = synthesise(exemplar, mask.astype(bool))
    assert wrap_ratio(texture.pixels) <= WRAP_GATE
    assert texture.pixels.std() > 0.5 * exemplar[mask > 0].std()


@pytest.mark.parametrize("seed", range(3))
def test_no_line_stands_out_in_what_is_made_of_thin_strips(seed):
    v, u = np.mgrid[:150, :150]
    grain = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((150, 150)), (0, 0), 1.0)
    tone = np.where(u > 110, 0.75, 0.45 + 0.1 * np.sin(u / 9)) + 0.06 * grain
    pixels = (tone[..., None] * [1, 0.5, 0.4]).clip(0, 1).astype(np.float32)
    texture = synthesise(pixels, (u + v) % 40 < 20, (320, 320), seed)
    small = cv2.resize(texture.pixels, (160, 160), interpolation=cv2.INTER_AREA)
    for axis in (0, 1):
        steps = np.abs(small - np.roll(small, 1, axis)).mean((1 - axis, 2))
        assert steps.max() < 2.3 * np.median(steps)  # a quilt's end and beginning: 3 to 8 times


def test_a_region_without_a_patch_is_refused():
    mask = np.zeros((100, 100), bool)
    mask[50:54] = True
    with pytest.raises(PaletteError, match=r"7 x 7 px"):
        patch.learn(pebbles(100, 100), mask, quiet)


def test_progress_rises_and_cancel_ends_the_sampling():
    concept = patch.learn(pebbles(100, 100), np.ones((100, 100), bool), quiet)
    seen = []
    patch.sample(concept, (200, 200), 0, lambda fraction, message: seen.append(fraction))
    assert seen == sorted(seen)
    assert 0 <= seen[0] and seen[-1] <= 1 and len(seen) > 20

    def cancel(fraction, message):
        raise Cancelled

    with pytest.raises(Cancelled):
        patch.sample(concept, (200, 200), 0, cancel)
