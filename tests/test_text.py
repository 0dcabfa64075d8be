"""Lines of lettering on a plain ground are found where they are; masonry, gravel, weave and grass are none."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from material_palette.core.image import read_photo
from material_palette.core.segmentation import segment
from material_palette.core.segmentation.text import text_mask

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
SIGN = (slice(100, 260), slice(120, 500))  # of a photo of 480 x 640


def grain(seed, scale=1.0, deviation=1.0, shape=(480, 640)):
    field = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=shape).astype(np.float32), (0, 0), scale)
    return deviation * field / field.std()


def bricks():
    wall = np.full((480, 640), 70, np.float32)
    for row, y in enumerate(range(0, 480, 24)):
        for x in range(-30 * (row % 2), 640, 60):
            shade = 40 + 8 * np.random.default_rng([row, x + 60]).random()
            cv2.rectangle(wall, (x + 2, y + 2), (x + 57, y + 21), float(shade), -1)
    return wall + grain(1)


def weave():
    y, x = np.mgrid[:480, :640]
    over = (x // 12 + y // 12) % 2
    return (50 + 20 * np.where(over, np.cos(x % 12 - 6), np.cos(y % 12 - 6))).astype(np.float32) + grain(2)


def gravel():
    return 50 + 25 * np.sign(grain(3, 4.0)).astype(np.float32) + grain(4, 1, 4)


def railing():
    bars = np.full((480, 640), 80, np.float32)
    for x in range(20, 620, 16):
        cv2.rectangle(bars, (x, 150), (x + 4, 210), 20.0, -1)
    return bars + grain(5)


def sign(ink, ground, size=1.6, slope=0.0):
    """A brick wall with a board of two lines, in L."""
    board = bricks()
    board[SIGN] = ground
    for line, text in enumerate(("Joiner & Glazier", "Alfred Huber 1928")):
        cv2.putText(
            board, text, (130, 165 + 60 * line), cv2.FONT_HERSHEY_DUPLEX, 0.8 * size, float(ink), 3, cv2.LINE_AA
        )
    turn = cv2.getRotationMatrix2D((310, 180), slope, 1)
    return cv2.warpAffine(board, turn, (640, 480), borderMode=cv2.BORDER_REPLICATE) + grain(6)


@pytest.mark.parametrize(("ink", "ground", "slope"), [(15, 85, 0), (90, 25, 0), (20, 70, 6)])
def test_lines_on_a_sign_are_found(ink, ground, slope):
    found = text_mask(sign(ink, ground, slope=slope))
    assert min(found[138:170, 150:440].mean(), found[198:230, 150:440].mean()) > 0.9
    assert found[:80].mean() < 0.01 and found[290:].mean() < 0.01


@pytest.mark.parametrize("picture", [bricks, weave, gravel, railing])
def test_what_repeats_or_is_rough_is_no_text(picture):
    assert not text_mask(picture()).any()


@pytest.mark.parametrize("photo", sorted(EXAMPLES.glob("*/photo.jpg")), ids=lambda path: path.parent.name)
def test_bundled_photos_hold_no_text(photo):
    lab = cv2.cvtColor(read_photo(photo).pixels ** np.float32(1 / 2.2), cv2.COLOR_RGB2LAB)
    scale = min(1.0, (400_000 / lab[..., 0].size) ** 0.5)
    assert not text_mask(cv2.resize(lab[..., 0], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)).any()


def test_text_is_said_and_in_no_region():
    lightness = sign(15, 85)
    pixels = np.repeat((lightness[..., None] / 100).clip(0, 1) ** 2.2, 3, 2).astype(np.float32) * (1, 0.8, 0.6)
    words = []
    regions = segment(pixels.astype(np.float32), warn=words.append)
    assert sum("looks like text" in text for text in words) >= 1
    covered = np.any([region.mask for region in regions], 0)
    assert covered[120:240, 150:470].mean() < 0.2 and covered[290:].mean() > 0.9
