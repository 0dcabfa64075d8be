"""Segmentation "auto": superpixels merged by what they are made of into few materials.

1. `features.describe`: superpixels with a vector each, near for one material and far for two.
2. Merge neighbours, cheapest first, until few are left. Here histograms of lightness, a, b, the energy of two bands and
   gradient orientation are compared by their square roots (Hellinger distance D), so that a wall of dark and light
   stones is one, and borders stay sharp:
       cost = D(A, B)^(1 - a) * D(along their border)^a * (|A| |B| / ((|A| + |B|) |photo|))^p
   The border term compares only superpixels that touch: light that falls off over a floor doesn't cut it in two. The
   size term is Ward's, tempered.
3. Merge any two, wherever they lie, by the squared distance of their mean vectors and the same size term, so that
   islands of one material become one region. It goes on below the user's bound while two are as near as parts of one
   material are: vectors have deviation 1 along each direction within a material, so that limit is one number.
4. What holds no texture of a surface is left out and said: too thin, blue sky, overexposed.
"""

import heapq
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from ..errors import PaletteError
from ..region import Region, check_region
from .features import BAND_COLUMNS, Features, describe

BAND_SCALES = (1, 2)  # px; more scales blur the textures of neighbours into each other
WEIGHTS = {"lightness": 1.0, "a": 1.0, "b": 1.0, "band": 0.5, "orientation": 1.5}
BORDER_SHARE = 0.65  # a
SIZE_POWER = 0.4  # p
TOUCHING_UNTIL = 40  # regions; from there on regions that don't touch may merge too
ONE_MATERIAL = 16.0  # squared distance of two regions' vectors; below it they are one material
LEAST_SHARE = 0.01  # of the photo; smaller regions don't count among the N and are left out
CLIPPED = 99.5  # of L: white, all three channels at their end
CLIPPED_SHARE = 0.75  # of a region; what has more than a quarter of its pixels left holds a texture
SKY_BLUE = 8.0  # -b
SMOOTH = -3.6  # logarithm of a band's contrast; below it there is nothing but the camera's noise


def segment_auto(
    pixels: np.ndarray,
    regions: int,
    seed: int,
    progress: Callable[[float, str], None],
    warn: Callable[[str], None] = lambda text: None,
    weights: str | None = None,
) -> list[Region]:
    """At most `regions` disjoint regions "region_1".. of a photo (H, W, 3) linear float32, by decreasing area.

    Nothing is drawn at random: `seed` and `weights` are there for other engines. Left out are regions under 1 % of the
    photo, and, with a word to `warn`, those too thin to hold a texture and those that are no surface.
    """
    features = describe(pixels, lambda fraction, message: progress(0.6 * fraction, "Segmenting"))
    owner = merged(features, regions, lambda fraction: progress(0.6 + 0.29 * fraction, "Segmenting"))
    reasons = {region: _no_surface(features, owner == region) for region in range(owner.max() + 1)}
    found = []
    for fraction, region, mask in _masks(owner[features.labels], pixels.shape[:2], progress):
        progress(0.94 + 0.05 * fraction, "Segmenting")
        reason = reasons[region]
        try:
            check_region(Region("region", mask))
        except PaletteError:
            reason = "is too thin to hold a texture"
        found.append((mask, reason))
    surfaces = [mask for mask, reason in found if reason is None]
    if not surfaces:  # a photo of nothing else: the user asked for its regions all the same
        surfaces = [mask for mask, reason in found if reason != "is too thin to hold a texture"]
    else:
        for mask, reason in found:
            if reason:
                rows, columns = np.nonzero(mask)
                where = f"around ({np.median(columns):.0f}, {np.median(rows):.0f}) px, {mask.mean():.0%} of the photo,"
                warn(f"A region {where} {reason} and is left out. Paint it to have it.")
    surfaces.sort(key=np.count_nonzero, reverse=True)
    progress(1.0, "Segmenting")
    return [Region(f"region_{number}", mask) for number, mask in enumerate(surfaces[:regions], 1)]


def merged(features: Features, regions: int, progress: Callable[[float], None]) -> np.ndarray:
    """(n,) region of every superpixel, 0.. or -1: merged until at most `regions` hold LEAST_SHARE of the photo."""
    histograms, weights = _histograms(features.lab, features.labels, lambda fraction: progress(0.3 * fraction))
    owner = _merged_neighbours(
        histograms,
        weights,
        features,
        max(TOUCHING_UNTIL, regions),
        lambda fraction: progress(0.3 + 0.6 * fraction),
    )
    count = owner.max() + 1
    share = np.bincount(owner, features.size) / features.size.sum()
    weighted = features.vectors * features.size[:, None]
    mean = np.stack([np.bincount(owner, column) for column in weighted.T], 1) / features.size.sum() / share[:, None]
    alive = np.ones(count, bool)
    while alive.sum() > 1:
        a, b = np.triu_indices(count, 1)
        both = alive[a] & alive[b]
        a, b = a[both], b[both]
        distance = np.square(mean[a] - mean[b]).sum(1)
        cost = distance * (share[a] * share[b] / (share[a] + share[b])) ** SIZE_POWER
        if np.count_nonzero(share[alive] >= LEAST_SHARE) <= regions:
            cost[distance >= ONE_MATERIAL] = np.inf
        best = int(cost.argmin())
        if not np.isfinite(cost[best]):
            break
        a, b = a[best], b[best]
        mean[a] = (share[a] * mean[a] + share[b] * mean[b]) / (share[a] + share[b])
        share[a] += share[b]
        alive[b] = False
        owner[owner == b] = a
        progress(1 - 0.1 * alive.sum() / count)
    kept = np.full(count, -1)
    large = np.flatnonzero(alive & (share >= LEAST_SHARE))
    kept[large] = np.arange(len(large))
    return kept[owner]


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


def _merged_neighbours(
    histograms: np.ndarray,
    weights: np.ndarray,
    features: Features,
    until: int,
    progress: Callable[[float], None],
) -> np.ndarray:
    """(n,) region 0.. of every superpixel, at most about `until` of them, each connected."""
    count = len(features.size)
    share = features.size / features.size.sum()
    histograms = histograms / features.size.sum()

    def signature(a):
        return np.sqrt(histograms[a] * weights / share[a])

    signatures = np.stack([signature(a) for a in range(count)])
    # borders[a][b] = (length, length x distance across it), the same at borders[b][a]
    borders = [{} for _ in range(count)]
    for a, b, length in features.borders.tolist():
        difference = signatures[a] - signatures[b]
        borders[a][b] = borders[b][a] = (length, length * float(difference @ difference))
    parent = np.arange(count)
    version = [0] * count

    def entry(a, b):
        difference = signatures[a] - signatures[b]
        length, across = borders[a][b]
        contrast = float(difference @ difference) ** (1 - BORDER_SHARE) * (across / length) ** BORDER_SHARE
        cost = contrast * (share[a] * share[b] / (share[a] + share[b])) ** SIZE_POWER
        return cost, a, b, version[a], version[b]

    queue = [entry(a, b) for a in range(count) for b in borders[a] if a < b]
    heapq.heapify(queue)
    left = count
    while left > until and queue:
        _, a, b, version_a, version_b = heapq.heappop(queue)
        if (version[a], version[b]) != (version_a, version_b):
            continue
        histograms[a] += histograms[b]
        share[a] += share[b]
        signatures[a] = signature(a)
        version[a] += 1
        version[b] = -1  # gone
        parent[b] = a
        left -= 1
        for other, (length, across) in borders[b].items():
            del borders[other][b]
            if other != a:
                before = borders[a].get(other, (0, 0.0))
                borders[a][other] = borders[other][a] = (before[0] + length, before[1] + across)
        for other in borders[a]:
            heapq.heappush(queue, entry(a, other))
        if left % 32 == 0:
            progress((count - left) / count)
    while (parent[parent] != parent).any():
        parent = parent[parent]
    return np.unique(parent, return_inverse=True)[1]


def _no_surface(features: Features, inside: np.ndarray) -> str | None:
    """Why superpixels (n,) bool hold no texture of a surface, None when they do."""
    size = features.size[inside]
    pixels = features.lab[inside[features.labels]]
    clipped = np.mean(pixels[:, 0] >= CLIPPED)
    if clipped > CLIPPED_SHARE:
        return f"is overexposed ({clipped:.0%} of it is plain white)"
    bands = np.average(features.statistics[inside][:, BAND_COLUMNS], axis=0, weights=size)
    top = inside[features.labels[0]].mean()
    lightness, blueness = np.median(pixels[:, 0]), -np.median(pixels[:, 2])
    if bands[0] < SMOOTH and top > 0.2 and blueness > SKY_BLUE and lightness > 50:  # a bright wall is no sky
        return "looks like sky"
    return None


def _masks(
    regions: np.ndarray, shape: tuple[int, int], progress: Callable[[float, str], None]
) -> Iterator[tuple[float, int, np.ndarray]]:
    """(done of 1, region, (H, W) bool mask) of every region >= 0 in (h, w), with smooth borders at the photo's size."""
    ids = np.unique(regions)
    best = np.full(shape, -1, np.float32)
    owner = np.zeros(shape, np.uint8)
    for index, region in enumerate(ids):
        soft = cv2.GaussianBlur((regions == region).astype(np.float32), (0, 0), 0.7)
        soft = cv2.resize(soft, shape[::-1], interpolation=cv2.INTER_LINEAR)
        owner[soft > best] = index
        np.maximum(best, soft, out=best)
        progress(0.9 + 0.039 * (index + 1) / len(ids), "Segmenting")
    for index, region in enumerate(ids):
        if region >= 0:
            yield index / len(ids), int(region), owner == index
