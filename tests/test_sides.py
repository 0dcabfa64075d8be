"""Of a region on several sides of a solid the largest is kept; what lies flat is kept whole."""

import cv2
import numpy as np
import pytest
from material_palette.core import palette
from material_palette.core.exemplar import RIM
from material_palette.core.image import linear_from_srgb
from material_palette.core.region import Region
from material_palette.core.sides import largest_side
from textures import pebbles, quiet, tileable_noise

SIZE = 320
BOX = {
    "top": ([(60, 90), (170, 40), (290, 80), (180, 140)], 1.0),
    "left": ([(60, 90), (180, 140), (185, 290), (70, 230)], 0.62),
    "right": ([(180, 140), (290, 80), (280, 220), (185, 290)], 0.35),
}


def drawn(corners):
    cells = np.zeros((SIZE, SIZE), np.uint8)
    cv2.fillPoly(cells, [np.array(corners)], 1)
    return cells > 0


def textured(contrast, seed=0):
    noise = tileable_noise(SIZE, SIZE, seed).astype(np.float32)
    return np.repeat(0.3 * np.exp(contrast * (noise - noise.mean()) / noise.std())[..., None], 3, 2).astype(np.float32)


@pytest.mark.parametrize(("contrast", "times"), [(0.0, 1), (0.1, 1), (0.2, 1), (0.1, 8)])
def test_one_side_of_a_box_is_kept(contrast, times):
    pixels, mask = textured(contrast), np.zeros((SIZE, SIZE), bool)
    sides = {}
    for name, (corners, light) in BOX.items():
        sides[name] = drawn(corners) & ~mask
        pixels[sides[name]] *= light
        mask |= sides[name]
    kept = largest_side(
        np.kron(pixels, np.ones((times, times, 1), np.float32)), np.kron(mask, np.ones((times,) * 2)) > 0
    )
    kept = kept[::times, ::times]
    shares = {name: (kept & side).sum() / kept.sum() for name, side in sides.items()}
    largest = max(sides, key=lambda name: sides[name].sum())
    assert shares[largest] > 0.97 and kept.sum() > 0.7 * sides[largest].sum()


def planks():
    random = np.random.default_rng(3)
    tones = np.repeat(np.exp(random.normal(0, 0.25, 16)), SIZE // 16)
    return np.ascontiguousarray(textured(0.05) * tones[None, :, None], np.float32)


def lamp():
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    return textured(0.15) * np.exp(-2 * ((x - 0.3) ** 2 + (y - 0.4) ** 2)).astype(np.float32)[..., None]


def masonry():
    pixels = textured(0.1)
    for row in range(8):
        for column in range(-1, 5):
            left = column * 80 + 40 * (row % 2)
            pixels[40 * row + 3 : 40 * row + 40, max(0, left + 3) : max(0, left + 80)] *= np.exp(
                np.random.default_rng(10 * row + column + 50).normal(0, 0.15)
            )
    return pixels


@pytest.mark.parametrize("surface", [lambda: textured(0.4), planks, lamp, masonry, lambda: textured(0.0)])
def test_what_lies_flat_is_kept_whole(surface):
    mask = drawn([(20, 20), (300, 30), (290, 300), (15, 290)])
    assert largest_side(surface(), mask) is mask


def test_pebbles_are_kept_whole():
    assert largest_side(pebbles(SIZE, SIZE, 0), mask := np.ones((SIZE, SIZE), bool)) is mask


def test_what_was_painted_apart_is_kept():
    pixels, mask = textured(0.1), np.zeros((SIZE, SIZE), bool)
    mask[20:300, 20:140] = mask[20:300, 180:300] = True
    pixels[:, 160:] *= 0.4
    assert largest_side(pixels, mask) is mask


def test_a_highlight_is_no_side():
    pixels, mask = textured(0.1), np.ones((SIZE, SIZE), bool)
    pixels[:, :190] = 1.0
    kept = largest_side(pixels, mask)
    assert kept[:, 230:].all()


def test_of_two_sides_the_one_that_the_camera_did_not_clip_is_kept():
    pixels, mask = textured(0.25), np.ones((SIZE, SIZE), bool)
    pixels[:, :180] = np.clip(pixels[:, :180] * 2.6, 0, 1)
    assert 0.1 < (pixels[:, :180] == 1).mean() < 0.4
    kept = largest_side(pixels, mask)
    assert not kept[:, :160].any() and kept[:, 200:].all()


def test_a_small_region_is_kept_whole():
    pixels, mask = textured(0.05), np.zeros((SIZE, SIZE), bool)
    mask[:70, :70] = True
    pixels[:, 35:] *= 0.4
    assert largest_side(pixels, mask) is mask


def test_the_corner_of_a_house_is_said_and_can_be_kept():
    pixels, mask = textured(0.15), np.zeros((SIZE, SIZE), bool)
    mask[20:300, 20:300] = True
    pixels[:, 190:] *= 0.45
    region = Region("house", mask)

    def preview(**settings):
        settings = palette.Settings(rectify="off", **settings)
        return palette.preview_exemplar(pixels, region, settings, quiet)

    picture, warnings = preview()
    assert len(warnings) == 1 and "on another side" in warnings[0] and 38 <= int(warnings[0].split("%")[0]) <= 42
    assert abs(picture.shape[1] - 168) < 6
    # as bright as both sides together
    assert np.log(linear_from_srgb(picture / 255)).mean() == pytest.approx(np.log(pixels[mask]).mean(), abs=0.02)
    picture, warnings = preview(flatten=False)
    assert picture.shape[1] == 280 - 2 * RIM and not any("another side" in warning for warning in warnings)


def test_a_side_in_the_dark_takes_the_level_only_so_far():
    pixels, mask = textured(0.05), np.zeros((SIZE, SIZE), bool)
    mask[20:300, 20:300] = True
    pixels[:, 190:] *= 0.03
    picture, _ = palette.preview_exemplar(pixels, Region("house", mask), palette.Settings(rectify="off"), quiet)
    change = np.log(linear_from_srgb(picture[8:-8, 8:120] / 255)).mean() - np.log(pixels[28:292, 28:140]).mean()
    assert change == pytest.approx(-palette.MOST_LEVEL, abs=0.03)


def test_a_side_in_other_light_leaves_the_hue_as_it_is():
    pixels, mask = textured(0.05), np.zeros((SIZE, SIZE), bool)
    mask[20:300, 20:300] = True
    pixels[:, 190:] *= np.float32([0.5, 0.55, 0.6])
    picture, warnings = palette.preview_exemplar(pixels, Region("house", mask), palette.Settings(rectify="off"), quiet)
    assert any("on another side" in warning for warning in warnings)
    red, green, blue = linear_from_srgb(picture[8:-8, 8:120] / 255).mean((0, 1))
    assert red == pytest.approx(green, rel=0.01) and blue == pytest.approx(green, rel=0.01)


def test_a_dado_of_another_paint_leaves_the_level_of_the_wall():
    pixels, mask = textured(0.05), np.zeros((SIZE, SIZE), bool)
    mask[20:300, 20:300] = True
    kept = mask & (np.arange(SIZE)[:, None] < 200)
    pixels[200:] *= np.float32([1.5, 2.5, 3.5])
    settings = palette.Settings(rectify="off")
    picture, warnings = palette.preview_exemplar(pixels, Region("wall", mask), settings, quiet)
    assert any("on another side" in warning for warning in warnings)
    inside = picture[4:150, 4:-4]
    assert np.log(linear_from_srgb(inside / 255)).mean() == pytest.approx(np.log(pixels[kept]).mean(), abs=0.05)


def test_of_a_texture_that_is_dark_with_few_bright_spots_the_side_is_kept_too():
    noise = cv2.GaussianBlur(np.random.default_rng(0).standard_normal((SIZE, SIZE)), (0, 0), 2).astype(np.float32)
    pixels = np.where(noise > np.quantile(noise, 0.85), 0.9, 0.06)  # its mean is far from its median
    pixels = np.repeat(pixels[..., None], 3, 2).astype(np.float32)
    pixels[:, 285:] = 0.45
    kept = largest_side(pixels, np.ones((SIZE, SIZE), bool))
    assert kept[:, :265].all() and not kept[:, 295:].any()
