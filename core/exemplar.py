"""From a photo's region to an exemplar: crop, leave out what has no colour, flatten the illumination, find out whether
it is of one colour."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from .delighting import LUMINANCE as LUMINANCE
from .delighting import find_light, log_mean, masked_blur
from .errors import PaletteError
from .image import srgb_from_linear
from .outliers import find_foreign

LARGEST = 1536  # px: side of what is cut at most; bounds the memory of learning
NOISE_FLOOR = 2.5 / 255  # sRGB-encoded contrast below which a surface has one colour
GREY = 0.46  # sRGB-encoded luminance of a photo's middle; where it is darker, so is all contrast
GRAIN = 2.5  # times what white noise leaves after blurring is more than noise
WHITE_BALANCES = ("off", "region", "card")
GREY_CARD = 0.18  # reflectance of what photographers hold into the light
UNEVEN = 0.3  # deviation over mean of a card's luminance; what varies more shows something else too
BRIGHTEST = 0.99  # share of a region's pixels that its level must not bring above white
CLIPPED = 0.98  # linear; above it the camera saw white
PLAIN = 0.8  # linear: of a channel's least in plain white, where another one is clipped
GLARE = 2.0  # times what is around it: a speck that is brighter is light or noise, no texture
BLACK = 4e-4  # linear; below it the camera saw black: 1 of 255 encoded
PATCH = 7  # px: what an engine learns from at least
LEAST_PATCHES = 400
LEAST_LEFT = 0.2  # of the patches; with fewer left the exemplar would no longer stand for the region
# px, and share of the side of the square with the region's area, that are left out at a region's borders; share of its
# patches that this may cost
RIM, RIM_SHARE, RIM_COST = 2, 0.005, 0.2
SPECK, HOLE = 5, 9  # px: side of the least square of white or black that is left out; smaller ones belong to a texture
CROWDED = 0.5  # of what is within HOLE px or so: where more are specks, there is no texture to fill them from
LINE = 40  # px: what is bright over such a length is a line, no specks
LEAST_SAID = 0.01  # of the region
# of `_sharpness`: 1 % of 89 photographed textures lie below it, and half of them after a blur of 2 px, all of 4 px
SOFT = 0.58
DARK = 0.006  # linear: seven stops below white


@dataclass
class Exemplar:
    """The region cut out of the photo.

    pixels (h, w, 3) float32 linear, evenly lit; mask (h, w) bool, what of the region is fit to learn from; shading
    (h, w, 3) float32 > 0, the illumination that was divided out: pixels * shading is the photo. Where no grey card or
    balance tells the light its geometric mean is 1 over the whole surface. uniform: the median (3,) of a region of one
    colour, else None.
    """

    pixels: np.ndarray
    mask: np.ndarray
    shading: np.ndarray
    uniform: np.ndarray | None
    warnings: list[str]

    def picture(self) -> np.ndarray:
        """The exemplar to look at (h, w, 3) uint8, sRGB-encoded; what is not learnt from is dark."""
        encoded = srgb_from_linear(np.clip(self.pixels, 0, 1))
        return np.rint(np.where(self.mask[..., None], encoded, 0.1) * 255).astype(np.uint8)


def cut_exemplar(
    pixels: np.ndarray,
    mask: np.ndarray,
    flatten: bool = True,
    white_balance: str | np.ndarray = "off",
    progress: Callable[[float, str], None] = lambda fraction, message: None,
    level: float = 1.0,
) -> Exemplar:
    """Cut a region out of a photo, leave out what isn't fit to learn from, and flatten its illumination.

    pixels (H, W, 3) float32 linear; mask (H, W) bool with at least one pixel. Left out are pixels without colour (too
    bright or too dark for the camera), another material at the region's border and the borders of cast shadows. Of a
    region that spreads wider than LARGEST the fullest part is cut. With white_balance "region" the colour of the light
    is taken from the region, whose mean is taken to be grey: for plaster, concrete, snow. White_balance (3,) is what
    the photo shows of a grey card: then brightness and colour of the light are known. level: how many times as bright
    as these pixels the surface is of which they are a part, such as a box's one side, in the geometric mean:
    without a grey card that is the best guess of the light.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    warnings = []
    h, w = len(mask[box]), len(mask[box][0])
    if max(h, w) > LARGEST:
        box = _fullest(mask, box)
        warnings.append(f"the region spreads over {w} x {h} px; the fullest {LARGEST} x {LARGEST} px of it are used")
    pixels, mask = np.ascontiguousarray(pixels[box]), np.ascontiguousarray(mask[box])
    seen = mask & (pixels > BLACK).any(-1)
    whole, inside = pixels, mask
    pixels, mask = _without_colourless(pixels, mask, warnings)
    if (seen & mask).any():
        # what the camera saw as white is as bright as that at least; of black nothing is known
        level *= float(np.exp((log_mean(whole, seen) - log_mean(pixels, seen & mask)) @ LUMINANCE))
    shading = np.ones_like(pixels)
    if flatten:
        light = find_light(pixels, mask, lambda fraction: progress(0.4 * fraction, "evening the light"))
        foreign = find_foreign(pixels / light.cast, mask)  # a slow change of light may be another material
        left = _less(mask, foreign)
        if foreign.any() and left is not mask:
            share = (mask.sum() - left.sum()) / mask.sum()
            warnings.append(f"{share:.0%} of the region looks like another material and is left out")
            mask = left
            light = find_light(pixels, mask, lambda fraction: progress(0.5 + 0.4 * fraction, "evening the light"))
        shading = light.shading
        if light.shaded:
            warnings.append(f"{light.shaded:.0%} of the region lies in a cast shadow; it was balanced with the rest")
            mask = _less(mask, light.unsure)
    if isinstance(white_balance, np.ndarray):
        shading = shading * (white_balance / GREY_CARD)
        beyond = float(((pixels / shading)[mask] > 1).any(-1).mean())
        if beyond > LEAST_SAID:
            warnings.append(f"{beyond:.0%} of the region is brighter than white beside the grey card, and cut there")
    else:
        if flatten and level != 1:
            # nothing reflects more light than falls on it
            brightest = float(np.quantile((pixels / shading)[mask].max(-1), BRIGHTEST))
            shading = shading / np.float32(min(level, max(1.0, 1 / max(brightest, 1e-6))))
        if white_balance == "region":
            mean = (pixels / shading)[mask].mean(0)
            shading = shading * (mean / max(float(mean @ LUMINANCE), 1e-6)).clip(1e-3)
        beyond = float(((pixels / shading)[mask] > 1).any(-1).mean()) if white(whole, inside) > 1 else 0.0
        if beyond > LEAST_SAID:
            warnings.append(
                f"{beyond:.0%} of the region is brighter than 1 and cut there; darken the photo so that white is 1"
            )
    pixels = pixels / shading
    progress(1.0, "evening the light")
    uniform = _uniform_colour(pixels, mask)
    if uniform is None and _sharpness(pixels, mask) < SOFT:
        warnings.append("the region is out of focus or enlarged: its material will have no fine detail either")
    if float((pixels @ LUMINANCE)[mask].mean()) < DARK:
        warnings.append("the region is very dark; brighten the photo if its material is not that dark")
    return Exemplar(pixels, mask, shading, uniform, warnings)


def card_colour(pixels: np.ndarray, first: np.ndarray, second: np.ndarray) -> tuple[float, float, float]:
    """What a photo (H, W, 3) float32 linear shows of a grey card: the mean of the rectangle between two points (x, y).

    Raises PaletteError where the rectangle is empty, leaves the photo or holds no evenly lit card.
    """
    (left, top), (right, bottom) = np.minimum(first, second).astype(int), np.ceil(np.maximum(first, second)).astype(int)
    h, w = pixels.shape[:2]
    if left < 0 or top < 0 or right > w or bottom > h or left >= right or top >= bottom:
        raise PaletteError(f"grey card: {left},{top} {right},{bottom} is no rectangle inside the photo's {w} x {h} px")
    card = pixels[top:bottom, left:right].reshape(-1, 3)
    luminance = card @ LUMINANCE
    if (card >= CLIPPED).any(-1).mean() > LEAST_SAID:
        raise PaletteError("grey card: it is over-exposed in the photo, which tells nothing; expose for the card")
    if luminance.mean() < DARK:
        raise PaletteError("grey card: it is too dark in the photo to tell the light; expose for the card")
    if luminance.std() > UNEVEN * luminance.mean():
        raise PaletteError("grey card: the rectangle shows more than an evenly lit card; choose a smaller one")
    return tuple(float(x) for x in card.mean(0))


def _sharpness(pixels: np.ndarray, mask: np.ndarray) -> float:
    """Contrast of details of 1 to 2 px over that of details of 2 to 4 px; about 1 in textures, 0.4 in blurred ones."""
    y = srgb_from_linear(np.clip(pixels, 0, 1)) @ LUMINANCE
    fine, middle, coarse = (masked_blur(y, mask, sigma)[mask] for sigma in (1.0, 2.0, 4.0))
    return float((fine - middle).std() / max((middle - coarse).std(), 1e-6))


def white(pixels: np.ndarray, mask: np.ndarray) -> float:
    """The value from which on the camera saw white within the mask; none in a photo in floats, which go on beyond 1."""
    return CLIPPED if pixels.max(where=mask[..., None], initial=0) <= 1.001 else np.inf


def without_white(pixels: np.ndarray, mask: np.ndarray, warnings: list[str]) -> np.ndarray:
    """The mask (H, W) bool without areas where a channel of the photo (H, W, 3) is at its end; itself where too little
    would be left, of which `cut_exemplar` tells. Appends to warnings."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    cut, inside, said = pixels[box], mask[box], []
    area = _squares(inside & (cut >= white(cut, inside)).any(-1), SPECK)
    part = _left(inside, area, "over-exposed", said)
    if part is inside:
        return mask
    warnings += said
    left = mask.copy()
    left[box] = part
    return left


def _without_colourless(pixels: np.ndarray, mask: np.ndarray, warnings: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and mask without what the camera saw as white or as black; appends to warnings.

    An area is left out where one channel is at its end, for its hue is wrong. Specks of plain white or of GLARE, unless
    they are lines or lie close together, are filled from around them: left out they would take every patch that holds
    one with them; in others with a channel at its end there is texture yet. A joint or a hole may be black; a black
    area is a failure.
    """
    ends, black = pixels >= white(pixels, mask), (pixels <= BLACK).all(-1)
    clipped = ends.any(-1)
    area = _squares(mask & clipped, SPECK)
    mask = _left(mask, area, "over-exposed", warnings)
    specks = mask & clipped & ~_widened(area)
    if specks.any():
        glare = (pixels > GLARE * masked_blur(pixels, mask & ~clipped, SPECK)).any(-1)
        specks &= glare | (pixels.min(-1) > PLAIN)
        specks &= ~_long(mask & glare)
        lost = mask & _widened(specks)
        crowded = mask & (masked_blur(lost.astype(np.float32), mask, HOLE / 2) > CROWDED)
        mask = _left(mask, crowded, "lost in over-exposed specks", warnings)
        share = (specks & mask).sum() / mask.sum()
        if share > LEAST_SAID:
            warnings.append(f"over-exposed specks, {share:.0%} of the region, are filled from around them")
        pixels = _filled(pixels, mask, lost & mask)
    return pixels, _left(mask, _squares(mask & black, HOLE), "under-exposed", warnings)


def _squares(lost: np.ndarray, side: int) -> np.ndarray:
    """Of what is lost (h, w) bool the squares of `side` px."""
    return cv2.morphologyEx(lost.astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) > 0


def _left(mask: np.ndarray, area: np.ndarray, what: str, warnings: list[str]) -> np.ndarray:
    """The mask without an area (h, w) bool of it, where enough is left; appends to warnings."""
    share = area.sum() / mask.sum()
    left = _less(mask, _widened(area)) if share else mask
    if share and left is mask:
        warnings.append(f"{share:.0%} of the region is {what}; too little would be left without it: it is kept")
    elif share > LEAST_SAID:
        warnings.append(f"{share:.0%} of the region is {what} and left out")
    return left


def _long(bright: np.ndarray) -> np.ndarray:
    """Those of what is bright (h, w) bool that go on like lines: white paint, joints; glare comes in specks."""
    _, parts, facts, _ = cv2.connectedComponentsWithStats(bright.astype(np.uint8), connectivity=8)
    sides = facts[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(1)
    return bright & (sides >= LINE)[parts]


def _filled(pixels: np.ndarray, mask: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Pixels (h, w, 3) where those lost (h, w) bool are the mean of the others of the mask beside them, inwards."""
    known = mask & ~lost
    while known.any() and lost.any():
        # farther away nothing would be left of the others' weight
        near = lost & (cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5) <= SPECK)
        if not near.any():
            break
        pixels = np.where(near[..., None], masked_blur(pixels, known, SPECK / 2), pixels)
        known, lost = known | near, lost & ~near
    return pixels


def without_rim(mask: np.ndarray) -> np.ndarray:
    """The mask (H, W) bool without what lies at its borders, where lens and hand have mixed it with what is beside it;
    itself where that would cost more than RIM_COST of its patches. The photo's edge is no border."""
    reach = max(RIM, round(RIM_SHARE * float(np.sqrt(mask.sum()))))
    left = cv2.erode(mask.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0
    before, after = (_patches(m) for m in (mask, left))
    return left if after > (1 - RIM_COST) * before else mask


def _patches(mask: np.ndarray) -> int:
    """How many patches lie in a mask, whose edge bounds them."""
    return int(cv2.erode(np.pad(mask, 1).astype(np.uint8), np.ones((PATCH, PATCH), np.uint8)).sum())


def _widened(lost: np.ndarray) -> np.ndarray:
    """With what is next to it, which has been mixed with it by the lens and the file's compression."""
    return cv2.dilate(lost.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _less(mask: np.ndarray, dropped: np.ndarray) -> np.ndarray:
    """The mask without what is dropped; the mask itself where too few patches would be left to learn from."""
    left = mask & ~dropped
    return left if _patches(left) >= max(LEAST_PATCHES, LEAST_LEFT * _patches(mask)) else mask


def _fullest(mask: np.ndarray, box: tuple[slice, slice]) -> tuple[slice, slice]:
    """The part of the box, at most LARGEST x LARGEST px, that holds most of the mask."""
    h, w = (min(LARGEST, side.stop - side.start) for side in box)
    total = cv2.integral(mask[box].astype(np.uint8))
    count = total[h:, w:] - total[:-h, w:] - total[h:, :-w] + total[:-h, :-w]
    top, left = np.unravel_index(count.argmax(), count.shape)
    top, left = box[0].start + int(top), box[1].start + int(left)
    return slice(top, top + h), slice(left, left + w)


def _uniform_colour(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray | None:
    """The median colour (3,) where what is left of contrast is noise, else None."""
    encoded = srgb_from_linear(np.clip(pixels, 0, 1))
    weight = mask.astype(np.float32)
    weight = cv2.GaussianBlur(weight, (0, 0), 1.5)
    # blurring averages sensor noise and JPEG's grain out, a texture's contrast survives it
    smooth = cv2.GaussianBlur(encoded * mask[..., None], (0, 0), 1.5) / np.maximum(weight, 1e-6)[..., None]
    values = smooth[mask]
    median = np.median(values, 0)
    contrast = 1.4826 * np.median(np.abs(values - median), 0)
    tail = np.percentile(np.abs(values - median), 98, 0)
    # less is more than noise only in a dark region, and only if it is not noise by its grain either
    grain = 1.4826 * np.median(np.abs(encoded[mask] - values), 0) / (2 * np.sqrt(np.pi) * 1.5)
    dark = np.maximum(NOISE_FLOOR * float(median @ LUMINANCE) / GREY, GRAIN * grain)
    floor = np.minimum(NOISE_FLOOR, dark)
    if (contrast > floor).any() or (tail > 4 * floor).any():
        return None
    return np.median(pixels[mask], 0).astype(np.float32)
