"""Outliers: the part of a painted region that shows another material, as when a brush goes over an edge.

The middle of a region is what was meant. From there the material is followed through the space of local colour and
texture, in steps about as large as those within the middle; what can't be reached that way, hangs together and touches
the region's border is foreign. Elements that recur inside the region, joints or flowers, are reached; gradual changes
too. What has little of the middle and is far from the rest of it doesn't count as meant.
"""

import cv2
import numpy as np

from .delighting import LUMINANCE, masked_blur, reduce_to_grid, sharpened, without_specks

MIDDLE = 0.6  # of the largest distance to the region's border: from there on it is the middle
SHARE = 0.08  # of the middle; what has less of it may be a stranger that reaches that far
WINDOW = 0.03  # sides: sigma of what is local
JUMP = 1.6  # a step this much larger than those within the middle leaves the material
FLOOR = np.array([0.1, 0.05, 0.05, 0.25, 0.25], np.float32)  # least spread of a feature that counts
CALM = 1.2  # of such a step, to the neighbours: a window over an edge changes faster
RECURS = 0.1  # of it away from the border: what is there too is an element of the material
MOST_ALIKE = 0.5  # common share of the colours of two materials
COLOURS = np.stack([LUMINANCE, np.float32([1, -1, 0]), np.float32([0, -1, 1])], -1)
SMALLEST, LARGEST = 0.01, 0.45  # of the region; beyond, it can't be told which of the two is meant


def find_foreign(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(h, w) bool: what of the mask (h, w) bool belongs to another material; pixels (h, w, 3) float32 linear, delit."""
    h, w = mask.shape
    x = np.log(np.maximum(pixels, 1e-3))
    fine = x @ LUMINANCE
    fine = (fine - cv2.GaussianBlur(fine, (0, 0), 1.5)) ** 2
    grid, inside, _ = reduce_to_grid(np.concatenate([x, fine[..., None]], -1), _shrunk(mask))
    nothing = np.zeros((h, w), bool)
    side = float(np.sqrt(inside.sum()))
    if side < 24:
        return nothing
    features = _features(grid, inside, WINDOW * side)
    lost = _touching(_unreached(features, inside, WINDOW * side), inside)
    if not SMALLEST < lost.sum() / inside.sum() < LARGEST:
        return nothing
    own = sharpened(grid[..., :3], inside, inside & ~lost)
    own = without_specks(own, inside, int(SMALLEST * inside.sum()))
    lost = _touching(inside & ~own, inside)
    if not SMALLEST < lost.sum() / inside.sum() < LARGEST:
        return nothing
    if _overlap(grid[..., :3] @ COLOURS, inside & ~lost, lost) > MOST_ALIKE:
        return nothing
    lost = cv2.dilate(lost.astype(np.uint8), np.ones((3, 3), np.uint8))
    return mask & (cv2.resize(lost, (w, h), interpolation=cv2.INTER_LINEAR) > 0)


def _overlap(x: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Least common share of the histograms of two sets of cells over the channels of x (h, w, C); 1 when they agree."""
    least = 1.0
    for channel in np.moveaxis(x, -1, 0):
        edges = np.quantile(channel[first | second], np.linspace(0, 1, 17))
        shares = [np.histogram(channel[cells], edges)[0] / cells.sum() for cells in (first, second)]
        least = min(least, float(np.minimum(*shares).sum()))
    return least


def _touching(lost: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The pieces of what is lost that touch the region's border; none where it is found inside too."""
    rim = inside & (cv2.erode(np.pad(inside, 1).astype(np.uint8), np.ones((3, 3)))[1:-1, 1:-1] == 0)
    _, labels = cv2.connectedComponents(lost.astype(np.uint8), connectivity=4)
    touching = lost & np.isin(labels, np.unique(labels[rim]))
    return touching if touching.sum() > (1 - RECURS) * lost.sum() else np.zeros_like(lost)


def _shrunk(mask: np.ndarray) -> np.ndarray:
    """Without the pixels whose detail sees over the border."""
    inner = cv2.erode(np.pad(mask, 1).astype(np.uint8), np.ones((7, 7), np.uint8))[1:-1, 1:-1] > 0
    return inner if inner.sum() > 0.5 * mask.sum() else mask


def _features(grid: np.ndarray, inside: np.ndarray, sigma: float) -> np.ndarray:
    """(h, w, 5): log luminance, two of chromaticity, log contrast of the pixels and of the cells."""
    y = grid[..., :3] @ LUMINANCE
    coarse = (y - masked_blur(y, inside, 0.7 * sigma)) ** 2
    parts = [y, grid[..., 0] - grid[..., 1], grid[..., 2] - grid[..., 1], grid[..., 3], coarse]
    local = masked_blur(np.stack(parts, -1), inside, sigma)
    local[..., 3:] = 0.5 * np.log(np.maximum(local[..., 3:], 0) + 1e-4)
    return local


def _unreached(features: np.ndarray, inside: np.ndarray, sigma: float) -> np.ndarray:
    """(h, w) bool: cells that no chain of small steps joins to the middle (single linkage)."""
    stride = max(1, round(sigma))
    v, u = np.mgrid[stride // 2 : inside.shape[0] : stride, stride // 2 : inside.shape[1] : stride]
    chosen = inside[v, u]
    v, u = v[chosen], u[chosen]
    depth = cv2.distanceTransform(np.pad(inside, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    middle = depth[v, u] >= MIDDLE * depth.max()
    if middle.sum() < 20:
        return np.zeros_like(inside)
    values = features[v, u]
    low, high = np.percentile(values[middle], (10, 90), axis=0)
    values = values / np.maximum((high - low) / 2.56, FLOOR)
    apart = np.sqrt(np.maximum(((values[:, None] - values[None]) ** 2).sum(-1), 0))
    # neighbours share pixels: only others show how far apart places of one material are
    other = np.hypot(v[:, None] - v, u[:, None] - u) > 3 * sigma
    nearest = np.sort(np.where(other[middle][:, middle], apart[middle][:, middle], np.inf), 1)[:, 1]
    nearest = nearest[np.isfinite(nearest)]
    if len(nearest) < 10:
        return np.zeros_like(inside)
    most = JUMP * float(np.percentile(nearest, 95))
    near = apart < most
    # a window over an edge holds a mixture of both sides, and would be a bridge from one to the other
    beside = np.hypot(v[:, None] - v, u[:, None] - u) < 1.5 * stride
    change = np.where(beside, apart, 0).max(1)
    calm = change < max(CALM * most, np.percentile(change[middle], 85))
    reached, left = np.zeros(len(v), bool), middle.copy()
    while left.any():
        family = _linked(near, np.arange(len(v)) == left.argmax(), middle) & middle
        if family.sum() >= SHARE * middle.sum():
            reached |= family
        left &= ~family
    reached = _linked(near, reached, calm)
    small = np.zeros((inside.shape[0] // stride + 1, inside.shape[1] // stride + 1), np.float32)
    small[v // stride, u // stride] = ~reached
    size = small.shape[1] * stride, small.shape[0] * stride
    return inside & (
        cv2.resize(small, size, interpolation=cv2.INTER_LINEAR)[: inside.shape[0], : inside.shape[1]] > 0.5
    )


def _linked(near: np.ndarray, start: np.ndarray, bridges: np.ndarray) -> np.ndarray:
    """Everything that chains of near places lead to from the start, by way of bridges."""
    reached, front = start.copy(), start
    while front.any():
        more = near[front].any(0) & ~reached
        reached |= more
        front = more & bridges
    return reached
