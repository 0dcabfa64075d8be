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
4. What holds no texture of a surface is left out and said, and takes none of the N: blue sky with its clouds, before 3,
   so that no wall merges with a cloud, and lines of text; overexposed or out of focus, after it; at last what is too
   thin or too small. A region of surfaces that are not alike, where there are more than regions asked for, is said too.
"""

import heapq
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from ..region import Region, holds_texture, too_small
from .features import BAND_COLUMNS, Features, describe
from .text import text_mask

BAND_SCALES = (1, 2)  # px; more scales blur the textures of neighbours into each other
WEIGHTS = {"lightness": 1.0, "a": 1.0, "b": 1.0, "band": 0.5, "orientation": 1.5}
BORDER_SHARE = 0.65  # a
SIZE_POWER = 0.4  # p
TOUCHING_UNTIL = 40  # regions; from there on regions that don't touch may merge too
ONE_MATERIAL = 16.0  # squared distance of two regions' vectors; below it they are one material
# mean square of a region's vectors about their mean, from which on it is said to be mixed; at most 19 in scenes and
# collages of known materials
UNLIKE = 30.0
LEAST_SHARE = 0.01  # of the photo; smaller regions don't count among the N and are left out
CLIPPED = 98.5  # of L, smoothed: white, all three channels at their end
CLIPPED_SHARE = 0.75  # of a region; what has more than a quarter of its pixels left holds a texture
SKY_BLUE = 8.0  # -b
SKY_LIGHTNESS = 40.0  # of L
SKY_EDGE = 0.15  # of the photo's upper edge
SMOOTH, CLOUDY = -4.2, -3.6  # logarithm of the finest band's contrast; there is little but the camera's noise
CONTRAST, CONTRAST_SHARE = -3.5, 0.15  # of the band of 4 px; the share of a region that must have it to tell its focus
BLURRED = -1.4  # logarithm of the finest band's contrast over that of 4 px, in the upper quartile of those


def segment_auto(
    pixels: np.ndarray,
    regions: int,
    seed: int,
    progress: Callable[[float, str], None],
    warn: Callable[[str], None] = lambda text: None,
    weights: str | None = None,
) -> list[Region]:
    """At most `regions` disjoint regions "region_1".. of a photo (H, W, 3) linear float32, by decreasing area.

    Nothing is drawn at random: `seed` and `weights` are there for other engines. Left out, with a word to `warn`, are
    regions under 1 % of the photo (one word for all), those too thin to hold a texture and those that are no surface.
    """
    features = describe(pixels, lambda fraction, message: progress(0.6 * fraction, "Segmenting"))
    parts = _connected(
        features, max(TOUCHING_UNTIL, regions), lambda fraction: progress(0.6 + 0.27 * fraction, "Segmenting")
    )
    parts, text = _text(features, parts)
    owner, left_out = surfaces_of(features, parts, text, regions)
    count = owner.max() + 1
    for number, inside in enumerate(left_out.values(), count):
        owner[inside[parts]] = number
    small = [np.average(owner == material, weights=features.size) for material in np.unique(owner[owner < 0])]
    owner = np.maximum(owner, -1)
    found = []
    for fraction, region, mask in _masks(owner[features.labels], pixels.shape[:2], progress):
        progress(0.94 + 0.05 * fraction, "Segmenting")
        reason = None
        if region >= count:
            reason = list(left_out)[region - count]
        elif holds_texture(mask):
            found.append((mask, _unlike(features, owner == region)))
        else:
            reason = "is too thin to hold a texture"
        if reason and mask.mean() < LEAST_SHARE:
            small.append(mask.mean())
        elif reason:
            rows, columns = np.nonzero(mask)
            where = f"around ({np.median(columns):.0f}, {np.median(rows):.0f}) px, {mask.mean():.0%} of the photo,"
            warn(f"A region {where} {reason} and is left out. Paint it to have it.")
    if small:
        warn(too_small(len(small), sum(small)))
    found.sort(key=lambda pair: np.count_nonzero(pair[0]), reverse=True)
    mixed = [f"region_{number}" for number, (_, unlike) in enumerate(found, 1) if unlike > UNLIKE]
    if mixed:
        warn(
            f"Surfaces that are not alike share a region: {', '.join(mixed)}. "
            "Ask for more regions or paint the material you want."
        )
    progress(1.0, "Segmenting")
    return [Region(f"region_{number}", mask) for number, (mask, _) in enumerate(found, 1)]


def surfaces_of(
    features: Features, parts: np.ndarray, text: np.ndarray, regions: int
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """(n,) as from `merged`, and by reason the (parts,) bool that are left out. text (parts,) bool: what is text."""
    left_out = {"looks like sky": _sky(features, parts) & ~text, "looks like text": text}
    surfaces = ~np.any(list(left_out.values()), 0)
    if features.size[surfaces[parts]].sum() < LEAST_SHARE * features.size.sum():
        left_out, surfaces = {}, np.ones_like(surfaces)  # there is nothing else, and the user asked for regions
    while True:
        owner = merged(features, parts, surfaces, regions)
        bad = _no_textures(features, parts, owner)
        kept = surfaces & ~np.any(list(bad.values()), 0)
        if not bad or features.size[kept[parts]].sum() < LEAST_SHARE * features.size.sum():
            return owner, left_out
        for reason, inside in bad.items():
            left_out[reason] = left_out.get(reason, False) | inside
        surfaces = kept


def merged(features: Features, parts: np.ndarray, surfaces: np.ndarray, regions: int) -> np.ndarray:
    """(n,) region of every superpixel: parts merged until at most `regions` hold LEAST_SHARE of the photo.

    Regions are 0.., materials too small for one below 0, each its own number. parts (n,) int: of every superpixel;
    surfaces (parts,) bool: the other parts are in no region; they are -1 too.
    """
    owner, count = parts.copy(), len(surfaces)
    share = np.bincount(owner, features.size) / features.size.sum()
    weighted = features.vectors * features.size[:, None]
    mean = np.stack([np.bincount(owner, column) for column in weighted.T], 1) / features.size.sum() / share[:, None]
    alive = surfaces.copy()
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
    kept = np.full(count, -1)
    large, small = alive & (share >= LEAST_SHARE), alive & (share < LEAST_SHARE)
    kept[large] = np.arange(large.sum())
    kept[small] = -1 - np.arange(small.sum())
    return kept[owner]


def _unlike(features: Features, inside: np.ndarray) -> float:
    """How far the vectors of the superpixels inside (n,) bool lie from their mean: mean square."""
    vectors, size = features.vectors[inside], features.size[inside]
    return float(np.average(np.square(vectors - np.average(vectors, 0, size)).sum(1), weights=size))


def _connected(features: Features, until: int, progress: Callable[[float], None]) -> np.ndarray:
    """(n,) part 0.. of every superpixel: neighbours merged until about `until` parts are left."""
    histograms, weights = _histograms(features.lab, features.labels, lambda fraction: progress(0.3 * fraction))
    return _merged_neighbours(histograms, weights, features, until, lambda fraction: progress(0.3 + 0.7 * fraction))


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


def _text(features: Features, parts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) parts of which text is one of its own, and (parts,) bool where it is."""
    mask = text_mask(features.lab[..., 0])
    written = np.bincount(features.labels.ravel(), mask.ravel()) > 0.5 * features.size
    parts = np.unique(np.where(written, parts.max() + 1, parts), return_inverse=True)[1]
    text = np.zeros(parts.max() + 1, bool)
    text[parts[written]] = True
    return parts, text


def _sky(features: Features, parts: np.ndarray) -> np.ndarray:
    """(parts,) bool: blue, bright and smooth up to the photo's upper edge, and what is smooth and lies within it."""
    count = parts.max() + 1
    size = np.bincount(parts, features.size)
    columns = [
        features.statistics[:, 0] * 100,
        features.statistics[:, 2] * 50,
        features.statistics[:, BAND_COLUMNS][:, 0],
    ]
    lightness, b, detail = (np.bincount(parts, features.size * column) / size for column in columns)
    edge = np.bincount(parts[features.labels[0]], minlength=count)
    touching = np.zeros((count, count))
    for one, other in ((0, 1), (1, 0)):
        ends = parts[features.borders[:, one]], parts[features.borders[:, other]]
        np.add.at(touching, ends, features.borders[:, 2])
    np.fill_diagonal(touching, 0)
    blue = (lightness > SKY_LIGHTNESS) & (b < -SKY_BLUE)
    sky = blue & (detail < SMOOTH) & (edge > SKY_EDGE * edge.sum())
    while sky.any():
        beside = touching[:, sky].sum(1)
        within = beside + edge > 0.5 * (touching.sum(1) + edge)
        more = ~sky & (detail < CLOUDY) & (lightness > SKY_LIGHTNESS) & (beside > 0) & (blue | within)
        if not more.any():
            break
        sky |= more
    return sky


def _no_textures(features: Features, parts: np.ndarray, owner: np.ndarray) -> dict[str, np.ndarray]:
    """By reason the (parts,) bool that are of a region of owner (n,) without texture."""
    count = owner.max() + 1
    smooth = cv2.GaussianBlur(features.lab[..., 0], (0, 0), 1.5)  # noise and JPEG take single pixels off the end
    clipped = np.bincount(features.labels.ravel(), (smooth >= CLIPPED).ravel()) / features.size
    bands = features.statistics[:, BAND_COLUMNS]
    contrast = bands[:, 2] > CONTRAST
    blown, sharpness = np.zeros(len(owner), bool), np.full(count, np.nan)
    for region in range(count):
        inside = owner == region
        if np.average(clipped[inside], weights=features.size[inside]) > CLIPPED_SHARE:
            blown |= inside
        if np.average(contrast[inside], weights=features.size[inside]) > CONTRAST_SHARE:
            sharpness[region] = np.quantile((bands[:, 0] - bands[:, 2])[inside & contrast], 0.75)
    soft = np.flatnonzero(sharpness < min(BLURRED, np.nanmax(sharpness, initial=-9) + BLURRED / 2))
    white = np.bincount(parts, features.size * clipped) > 0.5 * np.bincount(parts, features.size)
    found = {
        "is overexposed (plain white)": white & (np.bincount(parts, blown) > 0),
        "is out of focus": np.bincount(parts, np.isin(owner, soft)) > 0,
    }
    return {reason: inside for reason, inside in found.items() if inside.any()}


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
