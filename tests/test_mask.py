"""Edits of masks do to a shape what its geometry says."""

import numpy as np
import pytest
from material_palette.core import mask as edit

ROWS, COLUMNS = np.mgrid[:120, :160]


def disc(x, y, radius):
    return np.hypot(COLUMNS - x, ROWS - y) <= radius


@pytest.mark.parametrize("distance", [-12, -1, 0, 1, 17])
def test_a_disc_grows_to_a_disc(distance):
    grown = edit.grow(disc(80, 60, 30), distance)
    assert grown.sum() == pytest.approx(np.pi * (30 + distance) ** 2, rel=0.04)
    assert not (grown ^ disc(80, 60, 30 + distance))[~(disc(80, 60, 31 + distance) ^ disc(80, 60, 29 + distance))].any()


def test_shrinking_leaves_the_photos_edge():
    mask = COLUMNS < 50
    assert (edit.grow(mask, -10) == (COLUMNS < 40)).all()


def test_growing_nothing_gives_nothing_and_shrinking_all_gives_all():
    assert not edit.grow(np.zeros((9, 9), bool), 5).any()
    assert edit.grow(np.ones((9, 9), bool), -5).all()


def test_smoothing_takes_specks_and_holes_and_keeps_the_disc():
    rough = disc(80, 60, 30) | disc(10, 10, 1)
    rough[58:61, 78:81] = False
    difference = edit.smooth(rough, 4) ^ disc(80, 60, 30)
    assert difference.sum() < 0.03 * disc(80, 60, 30).sum()
    assert not difference[disc(10, 10, 5) | disc(80, 60, 10)].any()


def test_islands_are_disjoint_by_size_and_lose_nothing():
    small, large, speck = disc(30, 30, 20), disc(110, 70, 35), disc(5, 110, 2)
    parts = edit.islands(small | large | speck)
    assert len(parts) == 2
    assert (parts[0] == (large | speck)).all() and (parts[1] == small).all()
    assert edit.islands(np.zeros((9, 9), bool)) == []
    assert len(edit.islands(speck)) == 1


def test_polygon_fills_what_is_inside_even_beyond_the_photo():
    square = edit.polygon((120, 160), [(10, 20), (50, 20), (50, 80), (10, 80)])
    assert square.sum() == pytest.approx(40 * 60, rel=0.05)
    assert square[21:79, 11:49].all() and not square[:19].any() and not square[:, 52:].any()
    assert edit.polygon((120, 160), [(-500, -500), (900, -500), (900, 900), (-500, 900)]).all()


def test_pieces_that_are_tiny_and_few_are_strays():
    region = np.zeros((200, 200), bool)
    region[20:120, 20:120] = True
    strays = region.copy()
    strays[180:183, 180:190] = True
    strays[5, 190] = True
    assert np.array_equal(edit.without_strays(strays), region)
    for kept in (region, np.zeros_like(region)):
        assert edit.without_strays(kept) is kept
    two = region.copy()
    two[150:190, 20:60] = True
    assert edit.without_strays(two) is two
    leaves = np.zeros((200, 200), bool)
    leaves[:40, :40] = True
    leaves[60::10, 60::10] = True
    leaves[61::10, 60::10] = True
    assert edit.without_strays(leaves) is leaves  # so many pieces that the region consists of them
