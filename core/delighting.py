"""Delighting: the illumination of a region, found in its own pixels and without training.

Claim: with x the logarithm of the pixels, light adds to the texture, and two kinds of it can be told from the texture:

    x(p) = texture(p) + slow(p) + s m(p)

slow is a polynomial of up to four degrees, each as far as it exceeds what the texture's own unevenness makes of one,
which the scatter of the means of blocks about the polynomial tells. Light is nearly grey: a change of colour has to be
clearer than one of brightness before it is taken for light. What no polynomial follows is taken out as far as it is
more than any texture has of slow changes. A cast shadow is a step s per channel under a matte m. Any texture has some
best division into a light and a dark class; it is a shadow when the step is the same all along their border (a stone or
a stain ends differently everywhere) and turns no colour but a little towards blue, since what lights a shadow is the
sky. The matte's slope is the border's mean profile; where the balance is unsure, it is said.

Sources: Oppenheim et al. 1968 (homomorphic filtering); James and Stein 1961 (shrinkage); Knutsson and Westin 1993
(normalised convolution); Finlayson et al. 2006 (log chromaticity of shadows); Guo, Dai and Hoiem 2011 (equal texture on
both sides); Merriman, Bence and Osher 1992 (threshold dynamics).
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # Rec.709
DARKEST = 1e-3  # linear; keeps the logarithm of black finite
SAMPLED = 250_000  # px that a mean is taken of, at least
GRID = 192  # px: longest side of the grid on which light is looked for
BLOCKS = 8  # along a side of the square with the region's area, whose means are compared
LEAST_BLOCK = 12.0  # px
OPPONENT = np.stack([LUMINANCE, np.float32([1, -1, 0]), np.float32([0, -1, 1])])  # luminance, two of colour
# F, the variance that a degree explains over what the blocks' scatter would; below these it is the texture's
LEAST_F = np.array([3.0, 10.0, 10.0])  # as OPPONENT
LEAST_F_HIGH = LEAST_F * 8 / 3  # of the third and fourth degree, such as a lamp's pool
# of a shadow; read off the training materials, shadows and two-tone surfaces
LEAST_STEP = 0.2  # of log luminance
SOFTEST = 0.032  # sides: sigma of a border; softer ones are slow changes
MOST_STEP = 2.3  # the same; one to ten
MOST_ADDED, MOST_TAKEN = 0.4, 1.4  # change of log contrast, from lit to shaded
NOISE = 0.01  # contrast of a cell that sensor and rounding make
LEAST_SCORE = 0.62
REACH = 0.06  # sides: how far beside its border the two sides are compared
STRETCH = 0.07  # sides: length of the border that is judged as one
LONGEST = 8.0  # sides; a longer border is that of the texture's own elements
LONGEST_PLAIN = 4.5  # sides: a longer border must be bluish to be that of a shadow
BLUISH = 0.05  # change of log R/B per log luminance
WARMEST = -0.12  # the same; a darker part that is warmer is a stain
GREENEST = 0.12
UNSURE = 1.5  # cells beside a border that may lie on its other side
# of the variance: what is left of slow changes, seen through a window of WIDE of the region's side. The most uneven of
# 89 photographed textures has 0.074; what exceeds it is light, such as that on a box's two sides
WIDE = 1 / 8
MOST_LEFT = 0.075
LEAST_WIDE = 84  # px: side of the square with the area of a region that shows enough of its texture to tell


@dataclass
class Light:
    """What falls on a region.

    shading (h, w, 3) float32 > 0; cast (h, w, 3): the cast shadow's part of it, 1 where it is lit; unsure (h, w) bool,
    the border of a shadow, where it isn't known well; shaded, the share of the region in a cast shadow.
    """

    shading: np.ndarray
    cast: np.ndarray
    unsure: np.ndarray
    shaded: float


def find_light(
    pixels: np.ndarray, mask: np.ndarray, progress: Callable[[float], None] = lambda fraction: None
) -> Light:
    """The illumination of pixels (h, w, 3) float32 linear within mask (h, w) bool, of geometric mean 1 over the region.

    That holds with a cast shadow, too: the lit side is above 1, for the photo was exposed for both.
    """
    h, w = mask.shape
    x = np.log(np.maximum(pixels, DARKEST))
    grid, inside, scale = reduce_to_grid(x, mask)
    progress(0.1)
    shadow = _find_shadow(grid, inside, lambda fraction: progress(0.1 + 0.7 * fraction))
    cast = (
        np.zeros_like(grid) if shadow is None else shadow.step * (_matte(shadow.distance, shadow.sigma) - 1)[..., None]
    )
    slow = _slow(grid - cast, inside, scale)
    # beyond a thin region its trend goes anywhere
    slow = np.clip(slow, slow[inside].min(0), slow[inside].max(0))
    rest = grid - cast - slow
    whole = cv2.resize(slow, (w, h), interpolation=cv2.INTER_LINEAR)
    cast_there = np.zeros_like(whole)
    unsure, shaded = np.zeros((h, w), bool), 0.0
    if shadow is not None:
        distance = cv2.resize(shadow.distance, (w, h), interpolation=cv2.INTER_LINEAR)
        cast_there = shadow.step * (_matte(distance, shadow.sigma) - 1)[..., None]
        unbalanced = _unbalanced(rest @ LUMINANCE, inside, shadow).astype(np.uint8)
        unsure = mask & ((np.abs(distance) < UNSURE) | (cv2.resize(unbalanced, (w, h)) > 0))
        shaded = float((distance[mask] < 0).mean())
    if np.sqrt(inside.sum()) * scale > LEAST_WIDE:
        texture = (x - whole - cast_there)[mask]
        left = _left(rest, inside, float(texture.var(0).sum()))
        whole += cv2.resize(left, (w, h), interpolation=cv2.INTER_LINEAR)
    whole += cast_there - cast_there[mask].mean(0)
    return Light(np.exp(whole), np.exp(cast_there), unsure, shaded)


def _unbalanced(rest: np.ndarray, inside: np.ndarray, shadow: "_Border") -> np.ndarray:
    """Cells near the border of a shadow (h, w) bool that are still brighter or darker than the texture makes them."""
    near = inside & (np.abs(shadow.distance) < 3 * shadow.sigma + 2 * UNSURE)
    mean = masked_blur(rest, inside, UNSURE)
    away = mean[inside & ~near]
    if len(away) < 100:
        return np.zeros_like(near)
    low, high = np.percentile(away, (1, 99))
    margin = 0.25 * (high - low) + 0.02
    return near & ((mean < low - margin) | (mean > high + margin))


def reduce_to_grid(x: np.ndarray, mask: np.ndarray, most: int = GRID) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean of x (h, w, C) over the mask on a grid of at most `most` px, the cells inside, and px per cell."""
    h, w = mask.shape
    scale = max(1.0, max(h, w) / most)
    size = max(1, round(w / scale)), max(1, round(h / scale))
    weight = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    value = cv2.resize(np.where(mask[..., None], x, 0), size, interpolation=cv2.INTER_AREA)
    inside = weight > min(0.5, 0.9 * float(weight.max()))
    return np.where(inside[..., None], value / np.maximum(weight, 1e-6)[..., None], 0), inside, scale


def log_mean(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(3,) mean logarithm of pixels (h, w, 3) linear over mask (h, w) bool, of a large one over every so many-th."""
    some = slice(None, None, max(1, int(np.sqrt(mask.sum() / SAMPLED))))
    return np.log(np.maximum(pixels[some, some][mask[some, some]], DARKEST)).mean(0)


def masked_blur(x: np.ndarray, inside: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian mean of x (h, w) or (h, w, C) over the pixels inside (normalised convolution)."""
    weight = inside.astype(np.float32)
    value = x * (weight if x.ndim == 2 else weight[..., None])
    weight = cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    value = cv2.GaussianBlur(value.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
    weight = np.maximum(weight, 1e-6)
    return value / (weight if x.ndim == 2 else weight[..., None])


def polynomial(shape: tuple[int, int], degree: int) -> np.ndarray:
    """(h, w, T) terms up to a degree: 1, 3, 6, 10 or 15."""
    h, w = shape
    v, u = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j].astype(np.float32)
    return np.stack([u ** (d - k) * v**k for d in range(degree + 1) for k in range(d + 1)], -1)


def fit(terms: np.ndarray, x: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Coefficients (T,) or (T, C) of x over the terms (h, w, T), least squares."""
    a = terms[inside].astype(np.float64)
    # few terms, all of order one: the normal equations are exact enough, and fast
    ridge = 1e-9 * len(a) * np.eye(a.shape[1])
    return np.linalg.solve(a.T @ a + ridge, a.T @ x[inside]).astype(np.float32)


def _slow(x: np.ndarray, inside: np.ndarray, scale: float) -> np.ndarray:
    """Slow changes (h, w, 3), of mean 0 inside, of x (h, w, 3) on cells of `scale` px."""
    area = int(inside.sum())
    blocks = int(np.clip(np.sqrt(area) * scale / LEAST_BLOCK, 2, BLOCKS))
    degree = 4 if blocks == BLOCKS else 2
    terms = polynomial(inside.shape, degree).astype(np.float64)
    # orthonormal over the region, the lower degrees first
    triangle = np.linalg.qr(terms[inside], mode="r")
    terms = terms @ np.linalg.pinv(triangle)
    y = x[inside] @ OPPONENT.T.astype(np.float64)
    weights = terms[inside].T @ y
    rest = y - terms[inside] @ weights
    # independent blocks of that scatter would give each coefficient this variance
    v, u = np.nonzero(inside)
    side = np.sqrt(area) / blocks
    _, block = np.unique((v // side).astype(int) * GRID + (u // side).astype(int), return_inverse=True)
    count = np.bincount(block)
    mean = np.stack([np.bincount(block, channel) for channel in rest.T], -1) / count[:, None]
    variance = (count[:, None] * mean**2).sum(0) / max(area / side**2 - terms.shape[-1], 1)
    slow = np.zeros(inside.shape + (3,))
    for d in range(1, degree + 1):
        own = slice(d * (d + 1) // 2, (d + 1) * (d + 2) // 2)
        f = (weights[own] ** 2).mean(0) / np.maximum(variance, 1e-12)
        kept = np.maximum(0, 1 - (LEAST_F if d < 3 else LEAST_F_HIGH) / np.maximum(f, 1e-12))
        slow += terms[..., own] @ (weights[own] * kept)
    return (slow @ np.linalg.inv(OPPONENT.astype(np.float64)).T).astype(np.float32)


def _left(rest: np.ndarray, inside: np.ndarray, variance: float) -> np.ndarray:
    """Slow changes (h, w, 3), of mean 0 inside, that `rest` (h, w, 3) has beyond any texture of that variance."""
    wide = masked_blur(rest, inside, WIDE * float(np.sqrt(inside.sum())))
    wide = np.where(inside[..., None], wide - wide[inside].mean(0), 0)
    share = float(wide[inside].var(0).sum()) / max(variance, 1e-9)
    return wide * max(0.0, 1 - MOST_LEFT / max(share, 1e-9))


# ---------------------------------------------------------------- cast shadows


def _find_shadow(x: np.ndarray, inside: np.ndarray, progress: Callable[[float], None]) -> "_Border | None":
    area = int(inside.sum())
    if area < 400:
        return None
    best, chosen = LEAST_SCORE, None
    divisions = _divisions(x @ LUMINANCE, inside)
    for i, lit in enumerate(divisions):
        progress((i + 1) / (len(divisions) + 1))
        lit = without_specks(sharpened(x, inside, lit), inside, max(6, area // 250))
        if not 0.05 < lit.sum() / area < 0.95:
            continue
        border = _border(x, inside, lit)
        if border is not None and border.score > best:
            best, chosen = border.score, border
    if chosen is None:
        return None
    # the step over the whole region: the border's own is exact only where no light spreads across it
    matte = _matte(chosen.distance, chosen.sigma)
    terms = np.concatenate([polynomial(inside.shape, 1), matte[..., None]], -1)
    step = fit(terms, x, inside & (np.abs(chosen.distance) > UNSURE))[-1]
    # a trend that is no plane leaks into it; the border's own step bounds how much
    limit = np.maximum(0.25 * np.abs(chosen.step), 0.06)
    chosen.step = np.clip(step, chosen.step - limit, chosen.step + limit)
    return chosen


def _divisions(y: np.ndarray, inside: np.ndarray) -> list[np.ndarray]:
    """Candidates for what is lit (h, w) bool: two levels on a trend, at several scales of the texture."""
    side = float(np.sqrt(inside.sum()))
    found = []
    for share in (0.02, 0.05):
        smooth = masked_blur(y, inside, share * side)
        for degree in (0, 1, 2):
            terms = polynomial(inside.shape, degree)
            rest = smooth - terms @ fit(terms, smooth, inside)
            lit = inside & (rest > _otsu(rest[inside]))
            for _ in range(4):
                both = np.concatenate([terms, lit[..., None].astype(np.float32)], -1)
                weights = fit(both, smooth, inside)
                lit = inside & (smooth - terms @ weights[:-1] > weights[-1] / 2)
            alike = (np.mean((lit == other)[inside]) for other in found)
            if 0.06 < lit.sum() / inside.sum() < 0.94 and all(share < 0.95 for share in alike):
                found.append(lit)
    return found


def _otsu(values: np.ndarray) -> float:
    low, high = np.percentile(values, (1, 99))
    steps = np.clip((values - low) / max(high - low, 1e-6) * 255, 0, 255).astype(np.uint8)
    threshold, _ = cv2.threshold(steps.reshape(-1, 1), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    return low + (threshold + 0.5) / 255 * (high - low)


def sharpened(x: np.ndarray, inside: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Two classes (h, w) bool by the likelihood of each log pixel of x (h, w, 3) within them, with a short border.

    The colours are histograms of log luminance and log R/B, learnt from the classes' insides; threshold dynamics
    shortens the border, from a coarse scale to a fine one.
    """
    side = float(np.sqrt(inside.sum()))
    bins = 24, 16
    features = x @ LUMINANCE, x[..., 0] - x[..., 2]
    for share in (0.03, 0.012):
        reach = share * side
        sure = masked_blur(lit.astype(np.float32), inside, reach)
        terms = np.concatenate([polynomial(inside.shape, 1), sure[..., None]], -1)
        cell = np.zeros(inside.shape, int)
        for feature, count in zip(features, bins, strict=True):
            rest = feature - terms[..., :-1] @ fit(terms, feature, inside)[:-1]
            low, high = np.percentile(rest[inside], (0.5, 99.5))
            step = (rest - low) / max(high - low, 1e-3) * count
            cell = cell * count + np.clip(step.astype(int), 0, count - 1)
        likelihood = []
        for members in (inside & (sure > 0.8), inside & (sure < 0.2)):
            counts = np.bincount(cell[members], minlength=bins[0] * bins[1]).astype(np.float32)
            counts = cv2.GaussianBlur(counts.reshape(bins), (0, 0), 1.0).ravel() + 0.5
            likelihood.append(np.log(counts / counts.sum()))
        evidence = np.clip(likelihood[0] - likelihood[1], -2, 2)[cell]
        evidence = masked_blur(evidence, inside, max(0.7, 0.5 * reach))
        for _ in range(5):
            lit = inside & (masked_blur(lit.astype(np.float32), inside, reach) - 0.5 + 0.25 * evidence > 0)
    return lit


def without_specks(lit: np.ndarray, inside: np.ndarray, least: int) -> np.ndarray:
    """The classes with components of fewer than `least` cells given to the other one."""
    for members in (lit, inside & ~lit):
        count, labels, sizes, _ = cv2.connectedComponentsWithStats(members.astype(np.uint8), connectivity=4)
        for k in range(1, count):
            if sizes[k, cv2.CC_STAT_AREA] < least:
                lit = lit ^ (labels == k)
    return lit & inside


@dataclass
class _Border:
    distance: np.ndarray  # (h, w) cells to the border, positive where it is lit
    sigma: float  # of the Gaussian that softens the step, cells
    step: np.ndarray  # (3,) of the log, lit less shaded
    score: float


def _border(x: np.ndarray, inside: np.ndarray, lit: np.ndarray) -> _Border | None:
    """The border between the classes and how much it is like that of a shadow; None when it isn't at all."""
    side = float(np.sqrt(inside.sum()))
    dark = inside & ~lit
    to_dark, nearest_dark = _nearest(dark)
    to_lit, nearest_lit = _nearest(lit)
    distance = np.where(lit, to_dark - 0.5, 0.5 - to_lit)
    reach = REACH * side + 2
    band = inside & (np.abs(distance) < reach)
    sigma = _softness(distance[band], (x @ LUMINANCE)[band], reach)
    gap = min(1.5 * sigma + 1, 0.5 * reach)

    # the border's stretches: pixels go with the cell of a coarse grid in which the nearest dark pixel lies
    cell = max(4, int(STRETCH * side))
    v, u = np.mgrid[: inside.shape[0], : inside.shape[1]]
    stretch = v // cell * (inside.shape[1] // cell + 1) + u // cell
    own = stretch.copy()
    own[lit] = stretch[dark][nearest_dark[lit]]
    own[dark] = stretch[lit][nearest_lit[dark]]
    beside = band & (np.abs(distance) > gap)
    steps, weights = [], []
    bright = distance > 0
    count = own.max() + 1
    sums = {}
    for key, members in (("lit", beside & bright), ("dark", beside & ~bright)):
        n = np.bincount(own[members], minlength=count)
        total = np.stack([np.bincount(own[members], x[..., c][members], minlength=count) for c in range(3)], -1)
        sums[key] = n, total / np.maximum(n, 1)[:, None]
    weights = np.minimum(sums["lit"][0], sums["dark"][0])
    enough = weights >= 0.25 * cell * (reach - gap)
    if enough.sum() < 2:
        return None
    steps, weights = (sums["lit"][1] - sums["dark"][1])[enough], weights[enough]
    step = np.median(steps, 0)
    height = float(step @ LUMINANCE)
    if height < LEAST_STEP:
        return None
    off = np.abs(steps @ LUMINANCE - height)
    same = float(weights[off < 0.4 * height].sum() / weights.sum())
    length = float((inside & (np.abs(distance) < 1)).sum() / 2 / side)
    blue = float(step[0] - step[2]) / height
    green = abs(float(step[1] - (step[0] + step[2]) / 2)) / height
    coloured = green > max(GREENEST, 0.06 / height) or blue < WARMEST
    if coloured or length > LONGEST or (length > LONGEST_PLAIN and blue < BLUISH):
        return None
    if sigma > SOFTEST * side or height > MOST_STEP or not _same_texture(x, inside, distance):
        return None
    score = same - 0.5 * float(np.median(off)) / height - 0.02 * length
    return _Border(distance.astype(np.float32), sigma, step.astype(np.float32), score)


def _same_texture(x: np.ndarray, inside: np.ndarray, distance: np.ndarray) -> bool:
    """Whether the two sides have about the same contrast: a shadow takes relief away, it adds nothing."""
    y = x @ LUMINANCE
    lit, shaded = inside & (distance > UNSURE), inside & (distance < -UNSURE)
    if min(lit.sum(), shaded.sum()) < 50:
        return False
    for sigma in (1.0, 3.0):
        detail = y - masked_blur(y, inside, sigma)
        change = np.log((detail[lit].std() + NOISE) / (detail[shaded].std() + NOISE))
        if not -MOST_ADDED < change < MOST_TAKEN:
            return False
    return True


def _nearest(members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (h, w) to the nearest member, and which it is, counted in reading order."""
    distance, label = cv2.distanceTransformWithLabels(
        (~members).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    order = np.zeros(label.max() + 1, int)
    order[label[members]] = np.arange(members.sum())
    return distance, order[label]


def _softness(distance: np.ndarray, y: np.ndarray, reach: float) -> float:
    """Sigma of the Gaussian whose integral has the rise from 16 to 84 % of the border's mean profile."""
    n = int(reach)
    place = np.clip(np.floor(distance).astype(int) + n, 0, 2 * n - 1)
    count = np.bincount(place, minlength=2 * n)
    mean = np.bincount(place, y, minlength=2 * n) / np.maximum(count, 1)
    ends = max(1, n // 4)
    low, high = mean[:ends].mean(), mean[-ends:].mean()
    rise = np.maximum.accumulate((mean - low) / max(high - low, 1e-6))
    at = np.arange(-n, n) + 0.5
    return max(0.5, float(np.interp(0.84, rise, at) - np.interp(0.16, rise, at)) / 2)


def _matte(distance: np.ndarray, sigma: float) -> np.ndarray:
    """Share of the light that a shadow's border lets through, 0 to 1: the logistic curve nearest to a Gaussian's."""
    return 1 / (1 + np.exp(np.clip(-1.702 * distance / sigma, -30, 30)))
