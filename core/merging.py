"""Which regions of a photo show one material, so that it is extracted once.

Distance of two regions: the shift-tolerant LPIPS from the crops of each to the nearest of the other, the larger of the
two ways, plus the difference of their colours' mean and spread in CIELAB, of which COLOUR counts as 1. Groups are
joined as long as the farthest two regions of a group are at most MOST apart (complete linkage), so the number of
materials is that of the groups which are left. Regions too small for a crop stay alone.

MOST was chosen on 46 photographed textures, each as two halves of which one is up to 12 % brighter or darker, against
the three textures nearest in colour.
"""

import cv2
import numpy as np

from .image import srgb_from_linear
from .perceptual import Crops
from .region import Region

COLOUR = 50.0  # units of CIELAB
MOST = 0.2
LONGEST = 512  # px: regions are looked at within so many


def find_alike(
    pixels: np.ndarray, regions: list[Region], most: float = MOST
) -> tuple[list[list[int]], dict[tuple[int, int], float]]:
    """Groups of indices of regions of a photo (H, W, 3) linear, each in order, and the distances of pairs (i < j)."""
    seen = [_look(pixels, region.mask) for region in regions]
    distances = {}
    for j, second in enumerate(seen):
        for i, first in enumerate(seen[:j]):
            if first is not None and second is not None:
                distances[i, j] = _distance(first, second)
    groups = [[i] for i in range(len(regions))]

    def apart(a: list[int], b: list[int]) -> float:
        return max(distances.get((min(i, j), max(i, j)), np.inf) for i in a for j in b)

    while len(groups) > 1:
        nearest = min((apart(a, b), i, j) for j, b in enumerate(groups) for i, a in enumerate(groups[:j]))
        if nearest[0] > most:
            break
        _, i, j = nearest
        groups[i] = sorted(groups[i] + groups.pop(j))
    return groups, distances


def merge(regions: list[Region], groups: list[list[int]]) -> list[Region]:
    """A region per group, named and measured as its largest."""
    merged = []
    for group in groups:
        largest = max((regions[i] for i in group), key=lambda region: int(region.mask.sum()))
        mask = np.logical_or.reduce([regions[i].mask for i in group])
        merged.append(Region(largest.name, mask, largest.corners, largest.measure))
    return merged


def _look(pixels: np.ndarray, mask: np.ndarray):
    if not mask.any():
        return None
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    window = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    cut, inside = srgb_from_linear(np.clip(pixels[window], 0, 1)), mask[window]
    scale = LONGEST / max(inside.shape)
    if scale < 1:
        size = tuple(max(1, round(n * scale)) for n in inside.shape[::-1])
        cut = cv2.resize(cut, size, interpolation=cv2.INTER_AREA)
        inside = cv2.resize(inside.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    crops = Crops(cut, inside)
    if not crops.found:
        return None
    lab = cv2.cvtColor(np.ascontiguousarray(cut, np.float32), cv2.COLOR_RGB2Lab)[inside]
    return crops, np.concatenate([lab.mean(0), lab.std(0)])


def _distance(first, second) -> float:
    texture = max(first[0].apart(second[0]), second[0].apart(first[0]))
    return texture + float(np.linalg.norm(first[1] - second[1])) / COLOUR
