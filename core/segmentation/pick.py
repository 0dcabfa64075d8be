"""One-click selection: what is made of the material that was clicked on, wherever it lies in the photo.

A superpixel's distance is that of its vector to the nearest clicked one's. It is selected when that is within the
tolerance, and no negative click's is nearer. The tolerance counts in the square root of the mean distance over the
photo: between an absolute one, right for a photo of one material, and a relative one, right for many. The border is
then moved to the photo's own edges by a guided filter (He et al. 2010) over the superpixels' margins.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from .features import Features, describe

DEFAULT_TOLERANCE = 0.5
REACH = 8.0  # at tolerance 1; at 0.5 it is a quarter, the best on training collages
SNAP_RADIUS = 4  # px of the reduced photo
SNAP_CONTRAST = 4.0  # of L; weaker edges don't hold the border


@dataclass(frozen=True)
class Click:
    """A place in the photo, in px from its left and upper edge, that belongs to the region or, negative, does not."""

    x: float
    y: float
    positive: bool = True


class Pick:
    """The embedded selection as an object: `look(pixels)`, then `select` as often as wanted."""

    takes_box = False

    def look(self, pixels: np.ndarray, progress: Callable[[float, str], None] = lambda fraction, message: None) -> None:
        """Describe a photo (H, W, 3) linear float32; the slow part, once per photo."""
        self.features = describe(pixels, progress)
        self.shape = self.features.shape

    def select(self, clicks: list[Click], tolerance: float = DEFAULT_TOLERANCE) -> np.ndarray:
        """See the function `select`."""
        return select(self.features, clicks, tolerance)


def select(features: Features, clicks: list[Click], tolerance: float = DEFAULT_TOLERANCE) -> np.ndarray:
    """(H, W) bool: the region of the clicks at a tolerance from 0 (the superpixel clicked on) to 1 (nearly all).

    `features` are `describe(photo)`'s, made once per photo. Without a positive click nothing is selected. Clicks
    outside the photo count at its edge.
    """
    if not any(click.positive for click in clicks):
        return np.zeros(features.shape, bool)
    margin = np.clip(margins(features, clicks, tolerance), -1, 1)
    return _snapped(margin[features.labels], features)


def margins(features: Features, clicks: list[Click], tolerance: float) -> np.ndarray:
    """(n,) float32 per superpixel: above 0 within the selection."""
    height, width = features.shape
    rows, columns = features.labels.shape
    at = [
        features.labels[
            int(np.clip(click.y / height * rows, 0, rows - 1)), int(np.clip(click.x / width * columns, 0, columns - 1))
        ]
        for click in clicks
    ]
    distance = np.linalg.norm(features.vectors[:, None] - features.vectors[at], axis=2)
    positive = np.array([click.positive for click in clicks])
    near = distance[:, positive].min(1)
    mean = float(np.average(distance[:, positive].mean(1), weights=features.size))
    margin = REACH * tolerance**2 * max(mean, 1e-6) ** 0.5 - near
    if not positive.all():
        margin = np.minimum(margin, distance[:, ~positive].min(1) - near)
    for superpixel, click in zip(at, clicks, strict=True):  # whatever the tolerance, a click holds where it is
        margin[superpixel] = 1.0 if click.positive else -1.0
    return margin


def _snapped(margin: np.ndarray, features: Features) -> np.ndarray:
    guide = features.lab[..., 0]
    soft = cv2.ximgproc.guidedFilter(guide, margin.astype(np.float32), SNAP_RADIUS, SNAP_CONTRAST**2)
    return cv2.resize(soft, features.shape[::-1], interpolation=cv2.INTER_LINEAR) > 0
