"""From a photo's region to an exemplar: crop, flatten the illumination, find out whether it is of one colour."""

from dataclasses import dataclass

import cv2
import numpy as np

from .image import srgb_from_linear

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # Rec.709
LARGEST = 1536  # px: side of what is cut at most; bounds the memory of learning
SMOOTHNESS = 0.3  # sigma of what counts as illumination, in sides of the square with the region's area
LEAST_SIGMA = 12.0  # px
NOISE_FLOOR = 2.5 / 255  # sRGB-encoded contrast below which a surface has one colour
DARKEST = 1e-3  # linear; keeps the logarithm of black finite
CLIPPED = 0.98  # linear; above it the camera saw white


@dataclass
class Exemplar:
    """The region cut out of the photo.

    pixels (h, w, 3) float32 linear, evenly lit; mask (h, w) bool; shading (h, w, 3) float32 > 0, the illumination that
    was divided out, geometric mean 1 over the region; uniform: the median (3,) of a region of one colour, else None.
    """

    pixels: np.ndarray
    mask: np.ndarray
    shading: np.ndarray
    uniform: np.ndarray | None
    warnings: list[str]


def cut_exemplar(pixels: np.ndarray, mask: np.ndarray, flatten: bool = True) -> Exemplar:
    """Cut a region out of a photo and flatten its illumination.

    pixels (H, W, 3) float32 linear; mask (H, W) bool with at least one pixel. Illumination is what is smooth in the
    logarithm of each channel over a third of the region's size (homomorphic filtering: a quadratic trend, then a
    normalised convolution within the mask). Of a region that spreads wider than LARGEST the fullest part is cut.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    warnings = []
    h, w = len(mask[box]), len(mask[box][0])
    if max(h, w) > LARGEST:
        box = _fullest(mask, box)
        warnings.append(f"the region spreads over {w} x {h} px; the fullest {LARGEST} x {LARGEST} px of it are used")
    pixels, mask = np.ascontiguousarray(pixels[box]), np.ascontiguousarray(mask[box])
    clipped = float((pixels[mask] >= CLIPPED).any(-1).mean())
    if clipped > 0.05:
        warnings.append(f"{clipped:.0%} of the region is over-exposed; its colour there is lost")
    shading = _illumination(pixels, mask) if flatten else np.ones_like(pixels)
    pixels = pixels / shading
    return Exemplar(pixels, mask, shading, _uniform_colour(pixels, mask), warnings)


def _fullest(mask: np.ndarray, box: tuple[slice, slice]) -> tuple[slice, slice]:
    """The part of the box, at most LARGEST x LARGEST px, that holds most of the mask."""
    h, w = (min(LARGEST, side.stop - side.start) for side in box)
    total = cv2.integral(mask[box].astype(np.uint8))
    count = total[h:, w:] - total[:-h, w:] - total[h:, :-w] + total[:-h, :-w]
    top, left = np.unravel_index(count.argmax(), count.shape)
    top, left = box[0].start + int(top), box[1].start + int(left)
    return slice(top, top + h), slice(left, left + w)


def _illumination(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(h, w, 3): per channel, since the sun and the sky that light a surface differ in colour."""
    shading = np.empty_like(pixels)
    sigma = max(LEAST_SIGMA, SMOOTHNESS * np.sqrt(mask.sum()))
    for channel in range(3):
        x = np.log(pixels[..., channel] + DARKEST)
        trend = _trend(x, mask)
        # the darkest and brightest pixels are joints, holes and highlights, not illumination
        rest = np.clip(x - trend, *np.percentile((x - trend)[mask], (5, 95)))
        smooth = trend + _masked_blur(rest, mask, sigma)
        shading[..., channel] = np.exp(smooth - smooth[mask].mean())
    return shading


def _trend(x: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Quadratic fit of x (h, w) over the mask, least squares. A blur alone would flatten ramps towards the border."""
    h, w = mask.shape
    v, u = np.mgrid[-1 : 1 : h * 1j, -1 : 1 : w * 1j].astype(np.float32)
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1)
    some = np.flatnonzero(mask)[:: max(1, int(mask.sum()) // 20_000)]
    coefficients, *_ = np.linalg.lstsq(terms.reshape(-1, 6)[some], x.ravel()[some], rcond=None)
    return terms @ coefficients


def _masked_blur(x: np.ndarray, mask: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian mean of x (H, W) over the mask's pixels only (normalised convolution, Knutsson and Westin 1993)."""
    # a blur of many pixels is as good on a coarser grid
    scale = max(1, int(sigma / 6))
    size = (max(1, -(-x.shape[1] // scale)), max(1, -(-x.shape[0] // scale)))
    weight = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    value = cv2.resize(np.where(mask, x, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    weight = cv2.GaussianBlur(weight, (0, 0), sigma / scale, borderType=cv2.BORDER_CONSTANT)
    value = cv2.GaussianBlur(value, (0, 0), sigma / scale, borderType=cv2.BORDER_CONSTANT)
    mean = value / np.maximum(weight, 1e-6)
    return cv2.resize(mean, x.shape[::-1], interpolation=cv2.INTER_LINEAR)


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
    if (contrast > NOISE_FLOOR).any() or (tail > 4 * NOISE_FLOOR).any():
        return None
    return np.median(pixels[mask], 0).astype(np.float32)
