import cv2
import numpy as np
import pytest
from material_palette.core.engines import patch
from material_palette.core.engines.lattice import find_periods
from material_palette.core.torus import WRAP_GATE, wrap_ratio
from textures import pebbles, quiet


def bricks(height, width, course, length, seed=0):
    """(H, W, 3) float32: courses of bricks of varied colour, every second one shifted by half a brick."""
    random = np.random.default_rng(seed)
    wall = np.full((height, width), 0.8, np.float32)
    for i in range(int(height / course) + 2):
        for j in range(int(width / length) + 2):
            top, left = round(i * course), round((j - i % 2 / 2) * length)
            bottom, right = round((i + 1) * course) - 3, round((j + 1 - i % 2 / 2) * length) - 3
            wall[max(0, top) : bottom, max(0, left) : max(0, right)] = random.uniform(0.25, 0.45)
    wall += 0.02 * random.standard_normal(wall.shape)
    return np.repeat(np.clip(cv2.GaussianBlur(wall, (0, 0), 0.7), 0, 1)[..., None], 3, -1)


def full(pixels):
    return np.ones(pixels.shape[:2], bool)


@pytest.mark.parametrize("course", [15.0, 18.4, 31.0])
def test_courses_are_found(course):
    wall = bricks(300, 300, course, 2.6 * course)
    down, across = find_periods(wall, full(wall))
    # a running bond repeats every second course, and within a course with the brick
    assert min(abs(down - course), abs(down - 2 * course)) < 0.3
    assert across is None or abs(across / (1.3 * course) - round(across / (1.3 * course))) < 0.05


def test_a_region_of_any_shape_shows_its_courses():
    wall = bricks(300, 300, 20, 50)
    mask = np.zeros((300, 300), np.uint8)
    cv2.circle(mask, (150, 150), 130, 1, -1)
    cv2.rectangle(mask, (120, 100), (170, 180), 0, -1)
    wall[mask == 0] = 0
    down, _ = find_periods(wall, mask.astype(bool))
    assert down % 20 < 0.5 or down % 20 > 19.5


@pytest.mark.parametrize("seed", range(4))
def test_what_does_not_repeat_has_no_period(seed):
    pixels = pebbles(240, 240, seed)
    assert find_periods(pixels, full(pixels)) == (None, None)


@pytest.mark.parametrize("size, seed", [(250, 0), (250, 3), (330, 1), (512, 2)])
def test_courses_stay_straight_and_even_and_close_at_the_border(size, seed):
    wall = bricks(240, 240, 20, 48)
    concept = patch.learn(wall, full(wall), quiet)
    # the size is no multiple of the courses: the tile holds a whole number of them all the same
    texture = patch.sample(concept, (size, size), seed, quiet, "balanced").pixels
    assert wrap_ratio(texture) <= WRAP_GATE
    # joints run through: their rows stand out as in the exemplar
    rows, joints = texture.mean((1, 2)), wall.mean((1, 2))
    assert np.ptp(rows) > 0.8 * np.ptp(joints)
    bright = rows > (rows.min() + rows.max()) / 2
    starts = np.flatnonzero(bright & ~np.roll(bright, 1))
    heights = np.diff(np.append(starts, starts[0] + size))
    assert np.abs(heights - 20).max() <= 3
