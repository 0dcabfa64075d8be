"""A few strokes become the whole region; what was brushed is kept whatever the photo says."""

import cv2
import numpy as np
import pytest
from material_palette.core.errors import PaletteError
from material_palette.core.segmentation.scribbles import region_from_scribbles


@pytest.fixture(scope="module")
def scene():
    """A reddish disc of noise on grey noise, and its mask."""
    random = np.random.default_rng(0)
    pixels = (0.4 + 0.05 * random.standard_normal((200, 300, 1)) * np.ones(3)).astype(np.float32)
    disc = np.zeros((200, 300), np.uint8)
    cv2.circle(disc, (150, 100), 60, 1, -1)
    pixels[disc > 0] *= (1.2, 0.7, 0.6)
    return pixels, disc > 0


def stroke(start, end):
    mask = np.zeros((200, 300), np.uint8)
    cv2.line(mask, start, end, 1, 5)
    return mask > 0


def iou(a, b):
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


@pytest.mark.parametrize("scale", [1, 4])
def test_a_stroke_inside_and_one_outside_give_the_region(scene, scale):
    pixels, disc = scene
    size = 300 * scale, 200 * scale
    inside, outside = stroke((120, 100), (180, 100)), stroke((20, 20), (280, 20))
    pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST)
    disc, inside, outside = (
        cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for mask in (disc, inside, outside)
    )
    assert iou(region_from_scribbles(pixels, inside, outside), disc) > 0.95


def test_without_a_stroke_outside_the_edge_of_the_photo_is_outside(scene):
    pixels, disc = scene
    region = region_from_scribbles(pixels, stroke((120, 100), (180, 100)), np.zeros_like(disc))
    assert iou(region, disc) > 0.95


def test_what_was_brushed_is_kept(scene):
    pixels, disc = scene
    inside, outside = stroke((120, 100), (180, 100)) | stroke((20, 180), (60, 180)), stroke((150, 60), (150, 80))
    region = region_from_scribbles(pixels, inside, outside)
    assert region[inside].all()
    assert not region[outside & ~inside].any()


def test_the_same_strokes_give_the_same_region(scene):
    pixels, disc = scene
    inside, outside = stroke((120, 100), (180, 100)), stroke((20, 20), (280, 20))
    first, again = (region_from_scribbles(pixels, inside, outside) for _ in range(2))
    assert (first == again).all()


def test_nothing_brushed_and_wrong_sizes_are_said(scene):
    pixels, disc = scene
    nothing = np.zeros_like(disc)
    with pytest.raises(PaletteError, match="Nothing is brushed inside"):
        region_from_scribbles(pixels, nothing, disc)
    with pytest.raises(PaletteError, match="not of the photo's size"):
        region_from_scribbles(pixels, disc[:10], disc)
    assert region_from_scribbles(pixels, np.ones_like(disc), nothing).all()
