"""Lettering in a photo: lines of glyphs on a plain ground, without any model.

1. Connected components of what is lighter, or darker, than its surroundings, of one stroke width and one lightness.
2. Components beside each other, of about one height, stroke, lightness and base line, make a line; of at least
   LEAST_GLYPHS, which differ in shape as letters do and bricks don't.
3. The ground between the glyphs is plain against their contrast, as a sign's is and that of grass or gravel isn't.

Letters on a rough wall, and lone or joined ones, are missed.
"""

import cv2
import numpy as np

SURROUNDINGS = 41  # px
CONTRAST = 8.0  # of L, of a glyph's pixels against the surroundings' mean
GLYPH_HEIGHT = (8, 0.25)  # px; share of the photo's height
STROKE = (0.05, 0.45)  # of a glyph's height
LEAST_GLYPHS = 5
LEAST_CONTRAST = 15.0  # of L, glyphs against the ground between them
PLAIN = 0.45  # of that contrast: how far apart the ground's 10 and 90 percent may be


def text_mask(lightness: np.ndarray) -> np.ndarray:
    """(h, w) bool: lines of text and a little around them, in CIELAB's L (h, w), 0 to 100, of at most about 1 MP."""
    found = np.zeros(lightness.shape, np.uint8)
    for light in (lightness, 100 - lightness):
        glyphs, ink = _glyphs(light)
        for line in _lines(glyphs):
            height = np.median(line[:, 3])
            box, level = _boxes(line, height, lightness.shape), np.median(line[:, 5])
            ground = light[(box > 0) & (cv2.dilate(ink, np.ones((3, 3), np.uint8)) == 0)]
            if not ground.size:
                continue
            low, middle, high = np.percentile(ground, (10, 50, 90))
            if level - middle >= LEAST_CONTRAST and high - low <= PLAIN * (level - middle):
                found |= box
    return found > 0


def _glyphs(light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 7) left, top, width, height, stroke, lightness, area of what may be a light glyph; (h, w) uint8 of all."""
    around = cv2.blur(light, (SURROUNDINGS, SURROUNDINGS))
    ink = (light > around + CONTRAST).astype(np.uint8)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(ink, connectivity=8)
    left, top, width, height, area = boxes.T.astype(np.float64)

    def mean(values, inside=labels, size=area):
        return np.bincount(inside.ravel(), values.ravel(), count) / np.maximum(size, 1)

    depth = cv2.distanceTransform(ink, cv2.DIST_L2, 5)
    ridge = (ink > 0) & (depth >= cv2.dilate(depth, np.ones((3, 3), np.uint8)))
    along = labels[ridge], np.bincount(labels[ridge], minlength=count)
    half = mean(depth[ridge], *along)
    varies = np.sqrt(np.maximum(mean(depth[ridge] ** 2, *along) - half**2, 0))
    level, stands_out = mean(light), mean(light - around)
    uneven = np.sqrt(np.maximum(mean(light**2) - level**2, 0))
    fill, stroke = area / (width * height), 2 * half / height
    rows, columns = light.shape
    good = (height >= GLYPH_HEIGHT[0]) & (height <= GLYPH_HEIGHT[1] * rows) & (0.12 * height <= width)
    good &= (width <= 2.5 * height) & (0.12 <= fill) & (fill <= 0.85) & (STROKE[0] < stroke) & (stroke < STROKE[1])
    good &= (varies < 0.5 * half) & (uneven < 0.5 * stands_out)
    good &= (left > 0) & (top > 0) & (left + width < columns) & (top + height < rows)
    good[0] = False
    return np.stack([left, top, width, height, 2 * half, level, area], 1)[good], ink


def _lines(glyphs: np.ndarray):
    """Rows of `glyphs`, line by line."""
    left, top, width, height, stroke, level, area = glyphs.T
    middle, bottom = left + width / 2, top + height
    taller = np.maximum(height[:, None], height)
    gap = np.abs(middle[:, None] - middle) - (width[:, None] + width) / 2
    off = np.minimum(*(np.abs(y[:, None] - y) for y in (top + height / 2, bottom)))
    near = (gap < 0.9 * taller) & (gap > -0.25 * taller) & (off < 0.25 * taller)
    near &= (taller < 1.8 * np.minimum(height[:, None], height)) & (np.abs(level[:, None] - level) < 12)
    near &= np.maximum(stroke[:, None], stroke) < 1.7 * np.minimum(stroke[:, None], stroke)
    count, owner = len(glyphs), np.arange(len(glyphs))
    while count:
        least = np.minimum(owner, np.where(near, owner, count).min(1))
        if (least == owner).all():
            break
        owner = least
    for line in np.unique(owner):
        inside = owner == line
        if np.count_nonzero(inside) < LEAST_GLYPHS:
            continue
        size, slope = np.median(height[inside]), np.polyfit(middle[inside], bottom[inside], 1)
        off = np.abs(bottom[inside] - np.polyval(slope, middle[inside]))
        fill, shape = area[inside] / (width * height)[inside], (width / height)[inside]
        straight = np.median(off) <= 0.12 * size and abs(slope[0]) <= 0.5
        differ = shape.std() >= 0.1 and fill.std() >= 0.04 and np.median(fill) <= 0.65 and np.median(shape) >= 0.25
        if straight and differ and stroke[inside].std() <= 0.3 * stroke[inside].mean():
            yield glyphs[inside]


def _boxes(line: np.ndarray, height: float, shape: tuple[int, int]) -> np.ndarray:
    """(h, w) uint8 of a line's glyphs and half a `height` of theirs around them."""
    box = np.zeros(shape, np.uint8)
    for left, top, width, tall in line[:, :4]:
        corners = (left - 0.5 * height, top - 0.4 * height), (left + width + 0.5 * height, top + tall + 0.4 * height)
        cv2.rectangle(box, *((int(x), int(y)) for x, y in corners), 1, -1)
    return box
