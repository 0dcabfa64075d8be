"""Edits of a region's mask: (H, W) bool in, (H, W) bool out. The photo's edge is not a border of the region."""

import cv2
import numpy as np

from .region import LEAST_AREA

STRAY, MOST_STRAYS = 0.05, 0.1  # share of the largest part's area that a stray piece has at most; of the region, all


def grow(mask: np.ndarray, distance: float) -> np.ndarray:
    """What lies within `distance` px of the mask; below 0 the mask without what lies that near to its border."""
    if distance >= 0:
        return _distance_to(mask) <= distance
    return _distance_to(~mask) > -distance


def smooth(mask: np.ndarray, radius: float) -> np.ndarray:
    """The mask with corners rounded at `radius` px; specks and holes much smaller than that go."""
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), max(radius, 0.1), borderType=cv2.BORDER_REPLICATE)
    return soft > 0.5


def islands(mask: np.ndarray, least: int = LEAST_AREA) -> list[np.ndarray]:
    """The connected parts of the mask, largest first; those of less than `least` px stay with the largest one."""
    count, labels, statistics, _centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count < 2:
        return []
    by_area = sorted(range(1, count), key=lambda label: -statistics[label, cv2.CC_STAT_AREA])
    large = [label for label in by_area if statistics[label, cv2.CC_STAT_AREA] >= least] or by_area[:1]
    parts = [labels == label for label in large]
    parts[0] |= np.isin(labels, [label for label in by_area if label not in large])
    return parts


def without_strays(mask: np.ndarray) -> np.ndarray:
    """The mask without pieces that a brush or a segmenter has left beside it: such as are tiny beside the largest part,
    and few; itself where there are none, or where it consists of them."""
    count, labels, statistics, _centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    area = statistics[:, cv2.CC_STAT_AREA].astype(np.int64)
    area[0] = 0
    stray = area < STRAY * area.max()
    if count < 3 or not 0 < area[stray].sum() <= MOST_STRAYS * area.sum():
        return mask
    return ~stray[labels]


def polygon(shape: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """The pixels of an image of `shape` (H, W) inside the closed polygon of `points` (n, 2): x, y in px from the upper
    left corner, which may lie outside the image."""
    inside = np.zeros(shape, np.uint8)
    fraction = 4  # bits below the pixel; pixel centres lie at .5
    fixed = np.round((np.asarray(points, np.float64) - 0.5) * 2**fraction).astype(np.int32)
    cv2.fillPoly(inside, [fixed], 1, shift=fraction)
    return inside.astype(bool)


def _distance_to(mask: np.ndarray) -> np.ndarray:
    """Distance in px of every pixel to the mask; infinite when it is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf, np.float32)
    return cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
