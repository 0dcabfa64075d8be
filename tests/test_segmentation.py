"""Automatic regions follow materials: by colour or by texture alone, not by light, and wherever their parts lie."""

import re
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from material_palette.core.errors import Cancelled, PaletteError
from material_palette.core.image import linear_from_srgb, read_mask, read_photo, srgb_from_linear
from material_palette.core.region import check_region
from material_palette.core.segmentation import segment

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def iou(mask, other):
    return np.count_nonzero(mask & other) / np.count_nonzero(mask | other)


def best_iou(regions, mask):
    return max(iou(region.mask, mask) for region in regions)


def plain_slic_kmeans(pixels, count):
    """The opponent: superpixels clustered by their mean colour."""
    lab = cv2.cvtColor(np.clip(pixels, 0, 1) ** np.float32(1 / 2.2), cv2.COLOR_RGB2LAB)
    slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLIC, 20, 15.0)
    slic.iterate(10)
    labels = slic.getLabels()
    size = np.bincount(labels.ravel())
    means = [np.bincount(labels.ravel(), lab[..., c].ravel()) / np.maximum(size, 1) for c in range(3)]
    cv2.setRNGSeed(0)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.01)
    owner = cv2.kmeans(np.stack(means, 1).astype(np.float32), count, None, stop, 5, cv2.KMEANS_PP_CENTERS)[1]
    return [(owner.ravel() == index)[labels] for index in range(count)]


def noise(seed, height=360, width=480, scale=(1, 1)):
    """Grey noise in [0, 1] of mean 0.5, blurred by `scale` px in y and x."""
    field = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    field = cv2.GaussianBlur(field, (0, 0), sigmaX=scale[1], sigmaY=scale[0])
    return 0.5 + 0.12 * field / field.std()


def coloured(grey, colour):
    return (grey[..., None] * np.array(colour, np.float32)).clip(0, 1).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    """A photo of three materials and its true masks: gravel, planks in two places, plaster."""
    gravel, planks, plaster = noise(0), noise(1, scale=(1, 9)), noise(2, scale=(6, 6)) * 0.2 + 0.5
    pixels = coloured(gravel, (0.5, 0.5, 0.5))
    masks = {name: np.zeros((360, 480), bool) for name in ("planks", "plaster")}
    masks["planks"][20:150, 30:200] = masks["planks"][200:340, 300:450] = True
    cv2.circle(circle := np.zeros((360, 480), np.uint8), (120, 260), 70, 1, -1)
    masks["plaster"] = circle > 0
    pixels[masks["planks"]] = coloured(planks, (0.6, 0.4, 0.25))[masks["planks"]]
    pixels[masks["plaster"]] = coloured(plaster, (0.6, 0.65, 0.8))[masks["plaster"]]
    masks["gravel"] = ~(masks["planks"] | masks["plaster"])
    return pixels, masks


def test_each_material_is_one_region_even_in_two_places(scene):
    pixels, masks = scene
    regions = segment(pixels, regions=3)
    for name, mask in masks.items():
        assert best_iou(regions, mask) > 0.9, name


def test_light_that_falls_off_does_not_cut_a_material(scene):
    pixels, masks = scene
    falloff = np.linspace(1.3, 0.35, 480, dtype=np.float32)[:, None]
    regions = segment(pixels * falloff, regions=3)
    assert best_iou(regions, masks["gravel"]) > 0.8


def test_textures_of_one_colour_are_told_apart():
    pixels = coloured(noise(0, scale=(1, 1)), (0.5, 0.45, 0.4))
    pixels[:, 240:] = coloured(noise(1, scale=(6, 3)), (0.5, 0.45, 0.4))[:, 240:]
    left = np.zeros((360, 480), bool)
    left[:, :240] = True
    assert best_iou(segment(pixels, regions=2), left) > 0.9


def test_one_material_is_one_region_however_many_are_asked_for():
    pixels = coloured(noise(0, scale=(2, 2)), (0.5, 0.45, 0.4)) * np.linspace(1.2, 0.6, 480, dtype=np.float32)[:, None]
    (region,) = segment(pixels, regions=6)
    assert region.mask.mean() > 0.95


def test_a_painted_wall_of_a_real_photo_is_found_better_than_by_colour():
    pixels = read_photo(EXAMPLES / "facade" / "photo.jpg").pixels
    wall = read_mask(EXAMPLES / "facade" / "masks" / "stone_wall.png", pixels.shape[:2])
    opponent = max(iou(mask, wall) for mask in plain_slic_kmeans(pixels, 6))
    assert best_iou(segment(pixels), wall) > opponent + 0.1


def sky():
    """Blue, brighter below, with a soft white cloud."""
    blue = np.array((0.13, 0.32, 0.72), np.float32) * np.linspace(0.8, 1.2, 140, dtype=np.float32)[:, None, None]
    cloud = np.zeros((140, 480), np.float32)
    cv2.ellipse(cloud, (240, 70), (90, 30), 0, 0, 360, 1.0, -1)
    cloud = cv2.GaussianBlur(cloud, (0, 0), 12)[..., None]
    return blue * (1 - cloud) + 0.8 * cloud


def soft():
    """Something green far out of focus."""
    y, x = np.mgrid[:140, :480].astype(np.float32) / 6.5
    return coloured(0.5 + 0.3 * np.sin(x) * np.sin(y) + 0.1 * np.sin(0.7 * x + y), (0.2, 0.7, 0.3))


WHITE = np.ones((140, 480, 3), np.float32)


@pytest.mark.parametrize(("other", "word"), [(sky(), "sky"), (WHITE, "overexposed"), (soft(), "out of focus")])
def test_what_is_no_surface_is_said_and_takes_none_of_the_number(scene, other, word):
    pixels, masks = scene
    words = []
    regions = segment(np.concatenate([other, pixels]), regions=3, warn=words.append)
    (text,) = words
    assert word in text and "28%" in text
    for name, mask in masks.items():
        assert best_iou(regions, np.pad(mask, ((140, 0), (0, 0)))) > 0.85, name


def test_how_many_materials_are_too_small_is_said(scene):
    pixels = scene[0].copy()
    for left, colour in ((60, (0.8, 0.05, 0.05)), (240, (0.05, 0.6, 0.1)), (400, (0.9, 0.8, 0.1))):
        pixels[30:60, left : left + 30] = coloured(noise(3)[:30, :30], colour)
    words = []
    segment(pixels, regions=6, warn=words.append)
    (text,) = words
    count, share = re.match(r"(\d) parts of the photo, ([\d.]+)% of it together, are too small", text).groups()
    assert int(count) >= 3 and float(share) == pytest.approx(100 * 3 * 900 / 360 / 480, rel=0.4)


def test_regions_that_are_mixed_for_want_of_number_are_named(scene):
    pixels, masks = scene
    words = []
    regions = segment(pixels, regions=1, warn=words.append)
    assert len(regions) == 1 and "region_1." in words[-1] and "more regions" in words[-1]
    words.clear()
    segment(pixels, regions=len(masks), warn=words.append)
    assert not words


def test_a_photo_of_sky_or_of_blur_alone_is_a_region_all_the_same(scene):
    for pixels in (sky()[:, :120], soft(), cv2.GaussianBlur(scene[0], (0, 0), 4)):
        words = []
        regions = segment(pixels, warn=words.append)
        assert sum(region.mask.mean() for region in regions) > 0.8 and not words


@pytest.mark.parametrize("count", [1, 2, 4])
def test_regions_are_few_disjoint_ordered_and_large_enough(scene, count):
    regions = segment(scene[0], regions=count)
    assert 1 <= len(regions) <= count
    assert [region.name for region in regions] == [f"region_{n}" for n in range(1, len(regions) + 1)]
    areas = [np.count_nonzero(region.mask) for region in regions]
    assert areas == sorted(areas, reverse=True)
    assert np.sum([region.mask for region in regions], 0).max() == 1
    for region in regions:
        assert region.mask.shape == scene[0].shape[:2] and region.mask.dtype == bool
        check_region(region)


def test_segmentation_is_the_same_again_and_at_any_exposure(scene):
    first, again, bright = segment(scene[0]), segment(scene[0].copy()), segment(scene[0] * 2.0**12)
    assert all((a.mask == b.mask).all() for a, b in zip(first, again, strict=True))
    levels = 255 * srgb_from_linear(scene[0] * np.float32(2.0**-4))
    dark = segment(linear_from_srgb(np.round(levels) / np.float32(255)))  # as a file of 8 bits has it
    for region in first:
        assert best_iou(bright, region.mask) > 0.8
        assert best_iou(dark, region.mask) > 0.8


def test_two_megapixels_take_at_most_four_seconds_and_stop_at_once(scene):
    pixels = cv2.resize(scene[0], (1632, 1224), interpolation=cv2.INTER_CUBIC).clip(0)
    whole, gaps = [], []
    for _ in range(2):  # the better of two: processor time, since other programs run too
        calls = [(time.process_time(), 0.0)]
        segment(pixels, progress=lambda fraction, message, calls=calls: calls.append((time.process_time(), fraction)))
        times, fractions = zip(*calls, strict=True)
        whole.append(times[-1] - times[0])
        gaps.append(np.diff(times).max())
        assert fractions[-1] == 1 and (np.diff(fractions) >= 0).all()
    assert min(whole) < 4
    assert min(gaps) < 0.5  # the longest that a stop can take

    def stop(fraction, message):
        if fraction > 0.3:
            raise Cancelled

    with pytest.raises(Cancelled):
        segment(pixels, progress=stop)


def test_wrong_settings_are_named():
    pixels = np.full((64, 64, 3), 0.5, np.float32)
    with pytest.raises(PaletteError, match="no segmentation 'knife'; there is: auto, materialistic, sam"):
        segment(pixels, engine="knife")
    for count in (0, -1, 33):
        with pytest.raises(PaletteError, match=f"number of regions is {count}; it must be from 1 to 32"):
            segment(pixels, regions=count)


def test_least_and_uniform_photos(scene):
    (region,) = segment(np.full((64, 64, 3), 0.5, np.float32))
    assert region.mask.all()
    (region,) = segment(np.zeros((32, 32, 3), np.float32))
    assert region.mask.all()
    assert segment(scene[0][:32, :200])
    assert segment(scene[0][:32, :32])
