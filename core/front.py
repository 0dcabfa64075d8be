"""The cheapest preset that is predicted to meet an error, from a front that was measured (`training/front.py`).

The error of a texture is the shift-tolerant LPIPS of its crops to the nearest of its region. What a region allows shows
in the region itself: `spread`, the same distance between its own crops. A preset's error is taken as linear in it.
"""

import json
from functools import cache
from pathlib import Path

import numpy as np

from .errors import PaletteError
from .perceptual import Crops


@cache
def _front() -> dict:
    return json.loads(Path(__file__).with_name("front.json").read_text(encoding="utf-8"))


def spread(pixels: np.ndarray, mask: np.ndarray) -> float | None:
    """How different crops of a region (h, w, 3), mask (h, w), are: the mean over crops in one half of the region of the
    distance to the nearest in the other. None where no crops fit."""
    # halved across its longer side, so that crops of the two don't share pixels
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    if not len(rows):
        return None
    first, second = mask.copy(), mask.copy()
    if np.ptp(columns) >= np.ptp(rows):
        middle = int(np.median(np.nonzero(mask)[1]))
        first[:, middle:], second[:, :middle] = False, False
    else:
        middle = int(np.median(np.nonzero(mask)[0]))
        first[middle:], second[:middle] = False, False
    one, other = Crops(pixels, first), Crops(pixels, second)
    return one.apart(other) if one.found and other.found else None


def predict(of_region: float | None) -> dict[str, float]:
    """The error expected of each preset, the cheapest first; that of a usual region where its spread is not known."""
    front = _front()
    s = front["usual_spread"] if of_region is None else of_region
    return {name: max(0.0, p["offset"] + p["slope"] * s) for name, p in front["presets"].items()}


def choose(of_region: float | None, most: float) -> tuple[str, float, bool]:
    """(preset, its predicted error, whether that is at most `most`): the cheapest that meets it, else the best."""
    expected = predict(of_region)
    for name, error in expected.items():
        if error <= most:
            return name, error, True
    best = min(expected, key=expected.get)
    return best, expected[best], False


def check(most: float) -> None:
    if not 0 < most <= 1:
        raise PaletteError(f"target error {most:g} is out of range; choose 0 to 1, such as 0.1")
