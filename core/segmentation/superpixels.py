"""Segmentation "auto": superpixels merged by colour and texture into few materials.

1. SLIC superpixels (Achanta et al. 2012) in CIELAB on a reduced photo.
2. Each superpixel has histograms of lightness, a, b, the energy of two bands, and gradient orientation. The square
   roots of histograms are compared (Hellinger distance D), so that a wall of dark and light stones is one material and
   a merged region's signature is that of its pixels.
3. Merge neighbours, then any two regions, cheapest first:
       cost = D(A, B)^(1 - a) * D(along their border)^a * (|A| |B| / ((|A| + |B|) |photo|))^p
   The border term compares only superpixels that touch: light that falls off over a floor doesn't cut it in two. The
   size term is Ward's, tempered. Regions that don't touch have no border; they pay a penalty instead. Merging ends
   when few enough regions are left and none are alike.
"""

import heapq
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from ..errors import PaletteError
from ..image import srgb_from_linear
from ..region import Region, check_region

SEGMENTED_PIXELS = 400_000
SUPERPIXELS = 900
SLIC_RULER = 10.0  # weight of compactness against colour
SLIC_STEPS = 6
BAND_SCALES = (1, 2)  # px; more scales blur the textures of neighbours into each other
WEIGHTS = {"lightness": 1.0, "a": 1.0, "b": 1.0, "band": 0.5, "orientation": 1.5}
BORDER_SHARE = 0.65  # a
SIZE_POWER = 0.4  # p
TOUCHING_UNTIL = 30  # regions; from there on regions that don't touch may merge too
APART_PENALTY = 2.0
LEAST_CONTRAST = 1.0  # between two regions, without the size term; below it they are one material
LEAST_SHARE = 0.01  # of the photo; smaller regions don't count among the N and are left out


def segment_auto(pixels: np.ndarray, regions: int, seed: int, progress: Callable[[float, str], None]) -> list[Region]:
    """At most `regions` disjoint regions "region_1".. of a photo (H, W, 3) linear float32, by decreasing area.

    Nothing is drawn at random: `seed` is there for engines that draw. Regions under 1 % of the photo, or too small to
    hold a texture, are left out.
    """
    progress(0.0, "Segmenting")
    lab = _lab(pixels)
    labels = _superpixels(lab, lambda fraction: progress(0.05 + 0.45 * fraction, "Segmenting"))
    histograms, weights = _histograms(lab, labels, lambda fraction: progress(0.5 + 0.2 * fraction, "Segmenting"))
    merged = _merged(
        histograms, weights, labels, regions, lambda fraction: progress(0.7 + 0.2 * fraction, "Segmenting")
    )
    found = []
    for fraction, mask in _masks(merged[labels], pixels.shape[:2], progress):
        progress(0.94 + 0.05 * fraction, "Segmenting")
        try:
            check_region(Region("region", mask))
        except PaletteError:
            continue
        found.append(mask)
    found.sort(key=np.count_nonzero, reverse=True)
    progress(1.0, "Segmenting")
    return [Region(f"region_{number}", mask) for number, mask in enumerate(found[:regions], 1)]


def _lab(pixels: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 CIELAB, L in [0, 100], of the photo reduced to SEGMENTED_PIXELS."""
    height, width = pixels.shape[:2]
    scale = min(1.0, (SEGMENTED_PIXELS / (height * width)) ** 0.5)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    white = max(1.0, float(np.percentile(small, 99)))  # a photo in floats may be exposed beyond 1
    return cv2.cvtColor(np.clip(srgb_from_linear(small / white), 0, 1), cv2.COLOR_RGB2LAB)


def _superpixels(lab: np.ndarray, progress: Callable[[float], None]) -> np.ndarray:
    """(h, w) labels 0..n-1 of connected superpixels."""
    if not hasattr(cv2, "ximgproc"):
        raise PaletteError(
            "Segmentation 'auto' needs OpenCV with its contrib modules (opencv-contrib-python-headless). "
            "Install it or paint masks."
        )
    side = max(6, int((lab.shape[0] * lab.shape[1] / SUPERPIXELS) ** 0.5))
    smooth = cv2.GaussianBlur(lab, (0, 0), 1)
    slic = cv2.ximgproc.createSuperpixelSLIC(smooth, cv2.ximgproc.SLIC, side, SLIC_RULER)
    for step in range(SLIC_STEPS):
        slic.iterate(1)
        progress((step + 1) / SLIC_STEPS)
    slic.enforceLabelConnectivity(25)
    labels = slic.getLabels()
    return np.unique(labels, return_inverse=True)[1].reshape(labels.shape)


def _histograms(
    lab: np.ndarray, labels: np.ndarray, progress: Callable[[float], None]
) -> tuple[np.ndarray, np.ndarray]:
    """(n, bins) counts of pixels per superpixel, every feature's histogram beside the other, and (bins,) weights."""
    count = labels.max() + 1
    lightness = lab[..., 0]
    parts = [
        (_soft_histogram(lightness / 100, 12, labels, count), WEIGHTS["lightness"]),
        (_soft_histogram(lab[..., 1] / 100 + 0.5, 24, labels, count), WEIGHTS["a"]),
        (_soft_histogram(lab[..., 2] / 100 + 0.5, 24, labels, count), WEIGHTS["b"]),
    ]
    progress(0.3)
    for scale in BAND_SCALES:
        band = cv2.GaussianBlur(lightness, (0, 0), scale) - cv2.GaussianBlur(lightness, (0, 0), 2 * scale)
        energy = np.log(np.sqrt(cv2.GaussianBlur(band * band, (0, 0), 1.5 * scale)) + 0.3)  # 0.3 of L: noise
        parts.append((_soft_histogram((energy + 1.2) / 3.9, 10, labels, count), WEIGHTS["band"]))
        progress(0.3 + 0.5 * scale / sum(BAND_SCALES))
    dx, dy = cv2.Scharr(lightness, cv2.CV_32F, 1, 0), cv2.Scharr(lightness, cv2.CV_32F, 0, 1)
    xx, yy, xy = (cv2.GaussianBlur(product, (0, 0), 2) for product in (dx * dx, dy * dy, dx * dy))
    coherence = np.sqrt((xx - yy) ** 2 + 4 * xy**2) / (xx + yy + 50)
    turn = np.arctan2(2 * xy, xx - yy) / (2 * np.pi) % 1  # of the doubled angle: opposite directions are one
    orientation = _soft_histogram(turn, 8, labels, count, coherence, wraps=True)
    size = np.bincount(labels.ravel(), minlength=count)
    undirected = np.maximum(size - orientation.sum(1), 0)
    parts.append((np.column_stack([orientation, undirected]), WEIGHTS["orientation"]))
    weights = np.concatenate([np.full(part.shape[1], weight) for part, weight in parts])
    return np.concatenate([part for part, _ in parts], 1), weights


def _soft_histogram(
    values: np.ndarray, bins: int, labels: np.ndarray, count: int, amount: np.ndarray | float = 1.0, wraps: bool = False
) -> np.ndarray:
    """(count, bins) histogram of values in [0, 1] per label, each shared linearly by its two nearest bins."""
    place = np.clip(values, 0, 1) * (bins if wraps else bins - 1)
    lower = np.floor(place) if wraps else np.minimum(np.floor(place), bins - 2)
    upper_share = (place - lower) * amount
    lower = lower.astype(int)
    at = labels * bins
    total = np.bincount((at + lower % bins).ravel(), (amount - upper_share).ravel(), count * bins)
    total += np.bincount((at + (lower + 1) % bins).ravel(), upper_share.ravel(), count * bins)
    return np.maximum(total, 0).reshape(count, bins)


def _merged(
    histograms: np.ndarray, weights: np.ndarray, labels: np.ndarray, regions: int, progress: Callable[[float], None]
) -> np.ndarray:
    """(n,) region of every superpixel: merged until at most `regions` of them hold LEAST_SHARE of the photo."""
    count = len(histograms)
    share = np.bincount(labels.ravel(), minlength=count) / labels.size
    histograms = histograms / labels.size

    def signature(a):
        return np.sqrt(histograms[a] * weights / share[a])

    signatures = np.stack([signature(a) for a in range(count)])
    # borders[a][b] = [length, length x distance across it], the same list at borders[b][a]
    borders = [{} for _ in range(count)]
    for a, b, length in _touching(labels):
        difference = signatures[a] - signatures[b]
        borders[a][b] = borders[b][a] = (length, length * float(difference @ difference))
    alive = set(range(count))
    parent = np.arange(count)
    version = [0] * count

    def contrast(a, b):
        difference = signatures[a] - signatures[b]
        distance = float(difference @ difference)
        if b not in borders[a]:
            return APART_PENALTY * distance
        length, across = borders[a][b]
        return distance ** (1 - BORDER_SHARE) * (across / length) ** BORDER_SHARE

    def cost(a, b):
        return contrast(a, b) * (share[a] * share[b] / (share[a] + share[b])) ** SIZE_POWER

    def join(a, b):
        histograms[a] += histograms[b]
        share[a] += share[b]
        signatures[a] = signature(a)
        version[a] += 1
        parent[b] = a
        alive.remove(b)
        for other, (length, across) in borders[b].items():
            del borders[other][b]
            if other != a:
                before = borders[a].get(other, (0, 0.0))
                borders[a][other] = borders[other][a] = (before[0] + length, before[1] + across)

    queue = [(cost(a, b), a, b, 0, 0) for a in range(count) for b in borders[a] if a < b]
    heapq.heapify(queue)
    until = max(TOUCHING_UNTIL, regions)
    while len(alive) > until and queue:
        _, a, b, version_a, version_b = heapq.heappop(queue)
        if a not in alive or b not in alive or (version[a], version[b]) != (version_a, version_b):
            continue
        join(a, b)
        for other in borders[a]:
            heapq.heappush(queue, (cost(a, other), a, other, version[a], version[other]))
        if len(alive) % 32 == 0:
            progress((count - len(alive)) / count)
    while len(alive) > 1:
        pairs = [(a, b) for a in sorted(alive) for b in alive if a < b]
        if sum(share[a] >= LEAST_SHARE for a in alive) <= regions:
            pairs = [pair for pair in pairs if contrast(*pair) < LEAST_CONTRAST]
        if not pairs:
            break
        join(*min(pairs, key=lambda pair: (cost(*pair), pair)))
        progress((count - len(alive)) / count)
    while (parent[parent] != parent).any():
        parent = parent[parent]
    for a in alive:
        if share[a] < LEAST_SHARE:
            parent[parent == a] = -1
    return parent


def _touching(labels: np.ndarray) -> list[tuple[int, int, int]]:
    """(a, b, length of the border in px) for every two labels a < b that touch."""
    right = np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()])
    below = np.stack([labels[:-1].ravel(), labels[1:].ravel()])
    pairs = np.sort(np.concatenate([right, below], 1), 0)
    pairs, lengths = np.unique(pairs[:, pairs[0] != pairs[1]], axis=1, return_counts=True)
    return list(zip(*pairs.tolist(), lengths.tolist(), strict=True))


def _masks(
    regions: np.ndarray, shape: tuple[int, int], progress: Callable[[float, str], None]
) -> Iterator[tuple[float, np.ndarray]]:
    """(done of 1, (H, W) bool mask) of every region >= 0 in (h, w), borders drawn smoothly at the photo's size."""
    ids = np.unique(regions)
    best = np.full(shape, -1, np.float32)
    owner = np.zeros(shape, np.uint8)
    for index, region in enumerate(ids):
        soft = cv2.GaussianBlur((regions == region).astype(np.float32), (0, 0), 0.7)
        soft = cv2.resize(soft, shape[::-1], interpolation=cv2.INTER_LINEAR)
        owner[soft > best] = index
        np.maximum(best, soft, out=best)
        progress(0.9 + 0.04 * (index + 1) / len(ids), "Segmenting")
    for index, region in enumerate(ids):
        if region >= 0:
            yield index / len(ids), owner == index
