import cv2
import numpy as np
import pytest
from material_palette.core.exemplar import cut_exemplar
from material_palette.core.image import linear_from_srgb
from material_palette.core.outliers import find_foreign
from textures import pebbles

SIDE = 320


def material():
    return linear_from_srgb(0.2 + 0.5 * pebbles(SIDE, SIDE))


def grass():
    return material()[..., [1, 0, 2]] * np.float32([0.25, 1.1, 0.3])


def painted_over(share):
    """The photo, the region, and what of it is grass: a wavy strip on the left."""
    v, u = np.mgrid[:SIDE, :SIDE]
    foreign = u + 8 * np.sin(v / 20) < share * SIDE
    return np.where(foreign[..., None], grass(), material()).astype(np.float32), np.ones((SIDE, SIDE), bool), foreign


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_what_is_painted_over_the_edge_is_left_out_and_said(share):
    photo, mask, foreign = painted_over(share)
    exemplar = cut_exemplar(photo, mask)
    assert exemplar.mask[foreign].mean() < 0.1
    assert exemplar.mask[~foreign].mean() > 0.93
    assert any("looks like another material and is left out" in warning for warning in exemplar.warnings)


def test_a_clean_region_is_kept_whole():
    assert not find_foreign(material(), np.ones((SIDE, SIDE), bool)).any()


def test_elements_that_are_found_inside_too_are_kept_at_the_border():
    photo = material()
    flowers = np.zeros((SIDE, SIDE), np.uint8)
    for y, x in np.random.default_rng(2).integers(0, SIDE, (40, 2)):
        cv2.circle(flowers, (int(x), int(y)), 9, 1, -1)
    photo[flowers > 0] = (0.6, 0.5, 0.05)
    assert not find_foreign(photo, np.ones((SIDE, SIDE), bool)).any()


def test_chequers_are_kept():
    v, u = np.mgrid[:SIDE, :SIDE]
    photo = material() * np.where((v // 40 + u // 40) % 2, 1.0, 0.2)[..., None].astype(np.float32)
    assert not find_foreign(photo, np.ones((SIDE, SIDE), bool)).any()


def test_what_lies_outside_the_region_plays_no_part():
    photo, mask, foreign = painted_over(0.2)
    mask[:, -60:] = False
    other = photo.copy()
    other[~mask] = 3.0
    assert np.array_equal(find_foreign(photo, mask), find_foreign(other, mask))
