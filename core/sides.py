"""The sides of what a region covers: a box, a step or the corner of a house has several, each seen under its own slant.

Claim: where a surface bends, its brightness steps along a straight line, and stays there. A texture's own edges
(courses, planks, joints) are short, come in series, or what lies beyond them is no brighter or darker than the texture
is within. So the region is cut along the lines on which the mean beside them steps evenly, and of the parts the largest
is kept, with those that do not differ from it. A straight shadow, a plinth and a band of another paint are cut off by
the same rule.

Sources: Canny 1986 (crests of the gradient), Duda and Hart 1972 (lines by their angle and place).
"""

import cv2
import numpy as np

from .delighting import DARKEST, LEAST_WIDE, LUMINANCE, fit, log_mean, masked_blur, polynomial, reduce_to_grid
from .exemplar import PATCH, white

CELLS = 112  # longest side of the grid on which is looked
SEEN = 9  # px of a cell's side, at least, that are looked at in a large photo
TURNS = 60  # directions of lines, over half a turn
LEAST_STEP = 0.12  # of log luminance
MOST_USUAL = 3.0  # times the median over all lines: a step that stands out
# in sides of the square with the region's area
REACH, STRETCH = 0.07, 0.1  # what is averaged on each side of a line, across and along
SHORTEST = 0.22  # length of a line
EVEN, LEAST_EVEN = 0.4, 0.8  # share of a line's own step by which most of its stretches differ at most
MOST_LINES = 8
# as many lines of about one direction (degrees) are those of planks, courses or steps
SERIES, PARALLEL = 3, 12.0
LONGER = 0.6  # of its length, that a line may go on at each end until it meets another or leaves the region
APART = 3.0  # deviations of the slow changes within the side that is kept, by which another one differs
LEAST_SHARE = 0.25  # of the region, that is kept; what falls into smaller parts is one surface
MOST_HUE = 0.3  # of log R/G and log B/G, that two lights make
LEAST_LOST = 0.02  # of the region; less harms nobody


def same_hue(pixels: np.ndarray, first: np.ndarray, second: np.ndarray) -> bool:
    """Whether two parts (H, W) bool of a photo (H, W, 3) float32 linear may be one paint in two lights."""
    change = log_mean(pixels, first) - log_mean(pixels, second)
    return float(np.hypot(change[0] - change[1], change[2] - change[1])) < MOST_HUE


def largest_side(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The mask (H, W) bool without what lies on other sides than most of it does; itself where nothing does so.

    pixels (H, W, 3) float32 linear; mask with at least one pixel.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    cut = pixels[box]
    h, w = cut.shape[:2]
    # a highlight is no side
    clear = mask[box] & (cut < white(cut, mask[box])).all(-1)
    if np.sqrt(clear.sum()) < LEAST_WIDE:
        return mask
    # every so many-th pixel is enough for a cell's mean, and bounds the memory
    some = slice(None, None, max(1, max(h, w) // (SEEN * CELLS)))
    grid, inside, _ = reduce_to_grid(np.log(np.maximum(cut[some, some], DARKEST)), clear[some, some], CELLS)
    y = (grid @ LUMINANCE).astype(np.float32)
    side = float(np.sqrt(inside.sum()))
    walls = _walls(_lines(np.where(inside, y - y[inside].mean(), 0), inside, side), inside, side)
    if not walls.any():
        return mask
    count, parts = cv2.connectedComponents((inside & ~walls).astype(np.uint8), connectivity=4)
    if count < 3:
        return mask
    # the largest by what can be learnt from: a patch with a clipped pixel can't
    sound = cv2.erode(clear.astype(np.uint8), np.ones((PATCH, PATCH), np.uint8)).astype(np.float32)
    sound = cv2.resize(sound, inside.shape[::-1], interpolation=cv2.INTER_AREA)
    kept = parts == 1 + np.bincount(parts.ravel(), sound.ravel(), count)[1:].argmax()
    if kept.sum() < LEAST_SHARE * inside.sum():
        return mask
    terms = polynomial(inside.shape, 1)
    rest = y - terms @ fit(terms, y, kept)
    rest -= np.median(rest[kept])
    margin = max(LEAST_STEP, APART * float(masked_blur(rest, kept, max(1.0, REACH * side / 2))[kept].std()))
    beside = cv2.dilate(walls.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    other = np.zeros_like(inside)
    for part in range(1, count):
        own = parts == part
        # what no line cuts off was painted apart from the rest
        if own[beside].any() and abs(float(np.median(rest[own]))) >= margin:
            other |= own
    if other.sum() < LEAST_LOST * inside.sum():
        return mask
    # with the line, which lies within three cells of the edge
    other = cv2.dilate(other.astype(np.uint8), np.ones((7, 7), np.uint8))
    left = mask.copy()
    left[box] &= cv2.resize(other, (w, h), interpolation=cv2.INTER_NEAREST) == 0
    return left


def _lines(y: np.ndarray, inside: np.ndarray, side: float) -> list[np.ndarray]:
    """Ends (2, 2), cells (x, y), of straight lines along which y (h, w), 0 outside, steps evenly; greatest first."""
    h, w = inside.shape
    n = int(np.ceil(np.hypot(h, w))) + 4
    reach, stretch = max(3, round(REACH * side)), max(4, round(STRETCH * side))
    above = np.zeros((2 * reach + 3, stretch), np.float32)
    above[:reach] = 1
    turns = []
    for k in range(TURNS):
        # lines of this direction are rows of the turned picture
        matrix = cv2.getRotationMatrix2D((w / 2 - 0.5, h / 2 - 0.5), 180 * k / TURNS, 1)
        matrix[:, 2] += (n - w) / 2, (n - h) / 2
        turned, within = (cv2.warpAffine(x, matrix, (n, n)) for x in (y, inside.astype(np.float32)))
        sums, counts = (
            [cv2.filter2D(x, -1, kernel, borderType=cv2.BORDER_CONSTANT) for kernel in (above, above[::-1].copy())]
            for x in (turned, within)
        )
        step = sums[0] / np.maximum(counts[0], 1e-3) - sums[1] / np.maximum(counts[1], 1e-3)
        known = (np.minimum(*counts) > 0.3 * reach * stretch) & (within > 0.5)
        turns.append((cv2.invertAffineTransform(matrix), np.where(known, step, 0)))
    steps = np.concatenate([np.abs(step[step != 0]) for _, step in turns])
    if not len(steps):
        return []
    least = max(LEAST_STEP, MOST_USUAL * float(np.median(steps)))
    found = []
    for back, step in turns:
        for signed in (step, -step):
            strong = signed >= least
            for row in np.flatnonzero(strong.sum(1) >= SHORTEST * side):
                found += _stretches(signed, strong, int(row), SHORTEST * side, back)
    return [ends for _, ends in sorted(found, key=lambda line: -line[0])]


def _stretches(step: np.ndarray, strong: np.ndarray, row: int, shortest: float, back: np.ndarray) -> list[tuple]:
    """Step times length, and ends, of a row's even stretches that are steeper than the same of the rows beside it."""
    found = []
    ends = np.flatnonzero(np.diff(np.concatenate([[0], strong[row], [0]]).astype(np.int8)))
    for first, last in zip(ends[::2], ends[1::2], strict=True):
        if last - first < shortest:
            continue
        values = step[row, first:last]
        height = float(np.median(values))
        beside = step[max(row - 1, 0) : row + 2, first:last]
        if height < np.median(beside, 1).max() or np.mean(np.abs(values - height) < EVEN * height) < LEAST_EVEN:
            continue
        found.append((height * (last - first), np.array([back @ (x, row, 1.0) for x in (first, last - 1)])))
    return found


def _walls(lines: list[np.ndarray], inside: np.ndarray, side: float) -> np.ndarray:
    """Cells (h, w) bool on the lines, the same step drawn once, each going on until it meets another or the border."""
    kept: list[tuple[np.ndarray, np.ndarray]] = []  # ends and cells of each
    near = np.zeros(inside.shape, bool)
    width = 2 * max(2, round(0.05 * side)) + 1
    for ends in lines:
        own = _drawn(inside.shape, ends)
        if near[own].mean() > 0.5:
            continue
        kept.append((ends, own))
        near |= cv2.dilate(own.astype(np.uint8), np.ones((width, width), np.uint8)) > 0
        if len(kept) == MOST_LINES:
            break
    slopes = np.array([np.degrees(np.arctan2(*(ends[1] - ends[0])[::-1])) for ends, _ in kept])
    apart = np.abs((slopes[:, None] - slopes + 90) % 180 - 90)
    kept = [line for line, alike in zip(kept, (apart < PARALLEL).sum(1), strict=True) if alike < SERIES]
    times = sum((own.astype(np.uint8) for _, own in kept), np.zeros(inside.shape, np.uint8))
    walls = times > 0
    for ends, own in kept:
        others = cv2.dilate(((times - own) > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        length = float(np.linalg.norm(ends[1] - ends[0]))
        for end, along in ((ends[0], (ends[0] - ends[1]) / length), (ends[1], (ends[1] - ends[0]) / length)):
            for t in np.arange(0, LONGER * length + 1, 0.5):
                x, y = np.rint(end + along * t).astype(int)
                there = 0 <= x < inside.shape[1] and 0 <= y < inside.shape[0] and inside[y, x]
                if not there or others[y, x]:
                    walls |= _drawn(inside.shape, np.array([end, end + along * (t + 1.5)]))
                    break
    # so thick that no path of four neighbours leads through
    return cv2.dilate(walls.astype(np.uint8), np.ones((2, 2), np.uint8)) > 0


def _drawn(shape: tuple[int, int], ends: np.ndarray) -> np.ndarray:
    cells = np.zeros(shape, np.uint8)
    (x0, y0), (x1, y1) = np.rint(ends).astype(int).tolist()
    cv2.line(cells, (x0, y0), (x1, y1), 1)
    return cells > 0
