"""How well regions are found: measures, and the opponents of `core/segmentation`."""

import cv2
import numpy as np

TOLERANCE = 0.0075  # of the diagonal: how far a border may lie from the true one, as in the Berkeley benchmark
PURE, ENOUGH = 0.9, 0.25  # of a region, and of the material, that makes a region an exemplar of it
LEAST_SHARE = 0.01  # of the photo; smaller regions of an opponent don't count, as ours
GRABCUT_PIXELS = 160_000


def lab_of(pixels: np.ndarray) -> np.ndarray:
    """(H, W, 3) float32 CIELAB of linear pixels."""
    encoded = np.clip(pixels, 0, 1) ** np.float32(1 / 2.2)
    return cv2.cvtColor(encoded.astype(np.float32), cv2.COLOR_RGB2LAB)


# ---------------------------------------------------------------- measures


def iou(mask: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks; of two empty ones 1."""
    union = np.count_nonzero(mask | other)
    return np.count_nonzero(mask & other) / union if union else 1.0


def mean_iou(labels: np.ndarray, truth: np.ndarray, scored: int | None = None) -> float:
    """Mean over the true materials of the IoU with the region given to each; no region is given to two.

    labels, truth (H, W) int, -1: none. Pixels of unknown material don't count. The assignment is the best there is.
    scored: the first so many materials count in the mean (all); the others only as what should not be in a region.
    """
    overlap = _overlap(labels, truth)
    scored = overlap.shape[1] if scored is None else scored
    sizes = overlap.sum(1, keepdims=True)
    scores = (overlap / np.maximum(sizes + overlap.sum(0) - overlap, 1))[1:, :scored]
    best = {0: 0.0}  # bit set of materials that have a region -> sum of IoU
    for row in scores:
        for chosen, total in list(best.items()):
            for material in range(scored):
                if not chosen >> material & 1 and row[material] > 0:
                    key = chosen | 1 << material
                    best[key] = max(best.get(key, 0.0), total + row[material])
    return max(best.values()) / scored


def pure(labels: np.ndarray, truth: np.ndarray, scored: int | None = None) -> float:
    """Share of the true materials of which a region holds ENOUGH while it is PURE; arguments as of `mean_iou`."""
    overlap = _overlap(labels, truth)[1:]
    share = overlap / np.maximum(overlap.sum(1, keepdims=True), 1)
    total = np.bincount(truth[truth >= 0])
    return float(((share >= PURE) & (overlap >= ENOUGH * total)).any(0)[:scored].mean())


def _overlap(labels: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(1 + regions, materials) px that they share, of known materials only; row 0: in no region."""
    known = truth >= 0
    found = labels[known] + 1
    overlap = np.zeros((found.max(initial=0) + 1, truth.max() + 1))
    np.add.at(overlap, (found, truth[known]), 1)
    return overlap


def boundary_f(labels: np.ndarray, truth: np.ndarray) -> float:
    """F measure of border pixels (Martin et al. 2004), matched within TOLERANCE of the diagonal."""
    reach = TOLERANCE * np.hypot(*truth.shape)
    ours, true = _borders(labels), _borders(truth)
    if not ours.any() or not true.any():
        return float(ours.any() == true.any())
    precision, recall = (
        float((cv2.distanceTransform((~there).astype(np.uint8), cv2.DIST_L2, 5)[here] <= reach).mean())
        for here, there in ((ours, true), (true, ours))
    )
    return 2 * precision * recall / max(precision + recall, 1e-9)


def _borders(labels: np.ndarray) -> np.ndarray:
    borders = np.zeros(labels.shape, bool)
    borders[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    borders[1:] |= labels[1:] != labels[:-1]
    return borders


# ---------------------------------------------------------------- opponents: the whole photo


def slic_kmeans(pixels: np.ndarray, count: int) -> np.ndarray:
    """(H, W) labels: SLIC superpixels, k-means on their mean colour, k the true number of materials."""
    lab = lab_of(pixels)
    slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLIC, 20, 15.0)
    slic.iterate(10)
    labels = slic.getLabels()
    size = np.maximum(np.bincount(labels.ravel()), 1)
    means = [np.bincount(labels.ravel(), lab[..., c].ravel()) / size for c in range(3)]
    cv2.setRNGSeed(0)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.01)
    owner = cv2.kmeans(np.stack(means, 1).astype(np.float32), count, None, stop, 5, cv2.KMEANS_PP_CENTERS)[1]
    return _large(owner.ravel()[labels])


def felzenszwalb(pixels: np.ndarray, count: int, k: float = 1000.0) -> np.ndarray:
    """(H, W) labels: graph segmentation (Felzenszwalb and Huttenlocher 2004); `k`: of 100 to 6000, best on six
    training collages (IoU 0.58; 600: 0.56, 2000: 0.42)."""
    encoded = np.round(255 * np.clip(pixels, 0, 1) ** np.float32(1 / 2.2)).astype(np.uint8)
    least = int(LEAST_SHARE * encoded[..., 0].size)
    return cv2.ximgproc.segmentation.createGraphSegmentation(0.8, k, least).processImage(encoded)


def grabcut(pixels: np.ndarray, count: int) -> np.ndarray:
    """(H, W) labels: each cluster of `slic_kmeans` as the foreground of a grabCut (Rother et al. 2004), the others its
    background; in what several claim, the cluster decides."""
    start = slic_kmeans(pixels, count)
    small, shape = _small(pixels), start.shape
    start = cv2.resize(start.astype(np.int16), small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    labels = np.full(start.shape, -1)
    for index in range(start.max() + 1):
        mask = np.where(start == index, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
        mask = _grabcut(small, mask)
        labels[mask & ((labels < 0) | (start == index))] = index
    labels = cv2.resize(labels.astype(np.int16), shape[::-1], interpolation=cv2.INTER_NEAREST)
    return _large(labels.astype(int))


WHOLE = {"SLIC + k-means, true number": slic_kmeans, "Felzenszwalb": felzenszwalb, "grabCut on k-means": grabcut}


# ---------------------------------------------------------------- opponents: clicks (x, y, positive)


def flood_fill(pixels: np.ndarray, clicks: list[tuple[int, int, bool]], tolerance: float = 12.0) -> np.ndarray:
    """(H, W) bool: pixels connected to a positive click, of a colour within `tolerance` (CIELAB) of the clicked one's.

    The photo is smoothed by a median of 5 px. `tolerance`: of 8, 12, 16, 20 and 26, best over three clicks on
    six training collages (IoU 0.42; 8: 0.35, 16: 0.36).
    """
    lab = np.dstack([cv2.medianBlur(channel, 5) for channel in cv2.split(lab_of(pixels))])
    masks = {True: np.zeros(lab.shape[:2], bool), False: np.zeros(lab.shape[:2], bool)}
    for x, y, positive in clicks:
        filled = np.zeros((lab.shape[0] + 2, lab.shape[1] + 2), np.uint8)
        # OpenCV bounds each channel by itself
        flags = 4 | cv2.FLOODFILL_FIXED_RANGE | cv2.FLOODFILL_MASK_ONLY | 255 << 8
        cv2.floodFill(lab, filled, (x, y), 0, (tolerance,) * 3, (tolerance,) * 3, flags)
        masks[positive] |= filled[1:-1, 1:-1] > 0
    return masks[True] & ~masks[False]


def colour_range(pixels: np.ndarray, clicks: list[tuple[int, int, bool]], tolerance: float = 16.0) -> np.ndarray:
    """(H, W) bool: pixels anywhere whose colour is within `tolerance` of a positive click's and not nearer to a
    negative one's. `tolerance`: of 8, 12, 16 and 20, over three
    clicks on six training collages IoU is 0.38, 0.44, 0.44 and 0.43."""
    lab = cv2.GaussianBlur(lab_of(pixels), (0, 0), 2)
    distance = {
        wanted: np.min(
            [np.linalg.norm(lab - lab[y, x], axis=2) for x, y, positive in clicks if positive == wanted] or [[[1e9]]], 0
        )
        for wanted in (True, False)
    }
    return (distance[True] <= tolerance) & (distance[True] < distance[False])


def grabcut_clicks(pixels: np.ndarray, clicks: list[tuple[int, int, bool]], radius: float = 0.12) -> np.ndarray:
    """(H, W) bool: grabCut seeded by discs around the clicks; `radius` of the photo's width, not tuned."""
    small = _small(pixels)
    scale = small.shape[1] / pixels.shape[1]
    mask = np.full(small.shape[:2], cv2.GC_PR_BGD, np.uint8)
    for sure in (False, True):
        for x, y, positive in clicks:
            at = int(x * scale), int(y * scale)
            if sure:
                cv2.circle(mask, at, 6, cv2.GC_FGD if positive else cv2.GC_BGD, -1)
            else:
                cv2.circle(mask, at, int(radius * small.shape[1]), cv2.GC_PR_FGD if positive else cv2.GC_PR_BGD, -1)
    found = _grabcut(small, mask)
    return cv2.resize(found.astype(np.uint8), pixels.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0


CLICKED = {"flood fill": flood_fill, "colour range": colour_range, "grabCut": grabcut_clicks}


def next_click(truth: np.ndarray, mask: np.ndarray) -> tuple[int, int, bool] | None:
    """(x, y, positive) in the depth of the largest error, as a user would click; None without an error."""
    best, click = 0.0, None
    for wrong, positive in ((truth & ~mask, True), (mask & ~truth, False)):
        count, labels, statistics, _ = cv2.connectedComponentsWithStats(wrong.astype(np.uint8), connectivity=4)
        if count < 2:
            continue
        largest = 1 + int(statistics[1:, cv2.CC_STAT_AREA].argmax())
        if statistics[largest, cv2.CC_STAT_AREA] > best:
            best = statistics[largest, cv2.CC_STAT_AREA]
            depth = cv2.distanceTransform(np.pad(labels == largest, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
            y, x = np.unravel_index(depth.argmax(), depth.shape)
            click = int(x), int(y), positive
    return click


def first_click(truth: np.ndarray, random: np.random.Generator) -> tuple[int, int, bool]:
    """A random place in the material, not at its border: in the deeper half."""
    depth = cv2.distanceTransform(np.pad(truth, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    rows, columns = np.nonzero(depth >= 0.5 * np.quantile(depth[truth], 0.9))
    index = random.integers(len(rows))
    return int(columns[index]), int(rows[index]), True


def _small(pixels: np.ndarray) -> np.ndarray:
    scale = min(1.0, (GRABCUT_PIXELS / (pixels.shape[0] * pixels.shape[1])) ** 0.5)
    small = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.round(255 * np.clip(small, 0, 1) ** np.float32(1 / 2.2)).astype(np.uint8)


def _grabcut(small: np.ndarray, mask: np.ndarray) -> np.ndarray:
    if not np.isin(mask, (cv2.GC_FGD, cv2.GC_PR_FGD)).any() or not np.isin(mask, (cv2.GC_BGD, cv2.GC_PR_BGD)).any():
        return np.isin(mask, (cv2.GC_FGD, cv2.GC_PR_FGD))
    cv2.setRNGSeed(0)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(small, mask, None, *models, 4, cv2.GC_INIT_WITH_MASK)
    return np.isin(mask, (cv2.GC_FGD, cv2.GC_PR_FGD))


def _large(labels: np.ndarray) -> np.ndarray:
    """Labels of at least LEAST_SHARE of the photo, numbered anew; the others become -1."""
    share = np.bincount(labels.ravel() + 1)[1:] / labels.size
    number = np.full(len(share) + 1, -1)
    number[:-1][share >= LEAST_SHARE] = np.arange(np.count_nonzero(share >= LEAST_SHARE))
    return number[labels]
