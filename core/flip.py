"""FLIP: how different two pictures look to somebody who flips between them, 0 to 1 per pixel.

Source: Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images" (the LDR one). Colours are
filtered as the eye does at a viewing distance and compared in a perceptually uniform space; edges and points that one
picture has and the other lacks raise the difference. Constants are the paper's.
"""

import math

import cv2
import numpy as np

from .image import linear_from_srgb

PIXELS_PER_DEGREE = 67.0  # the paper's: 0.7 m from a screen 0.7 m and 3840 px wide
_EXPONENT, _KNEE, _AT_KNEE = 0.7, 0.4, 0.95  # of the colour difference: qc, pc, pt
_FEATURE = 0.082  # degrees, width of the edge and point detectors
# sums of Gaussians (a1, b1, a2, b2) of the contrast sensitivity, in achromatic, red-green, blue-yellow
_SENSITIVITY = ((1, 0.0047, 0, 1e-5), (1, 0.0053, 0, 1e-5), (34.1, 0.04, 13.5, 0.025))
_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
_WHITE = _XYZ.sum(1)
# linearised L*a*b*: achromatic (116 Y - 16), red-green, blue-yellow, less the constant
_OPPONENT = np.array([[0, 116, 0], [500, -500, 0], [0, 200, -200]]) @ (_XYZ / _WHITE[:, None])


def flip(reference: np.ndarray, test: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE) -> np.ndarray:
    """The difference (H, W) float32 in [0, 1] of two pictures (H, W, 3), sRGB-encoded in [0, 1]."""
    pictures = [linear_from_srgb(np.clip(np.asarray(p, np.float32), 0, 1)) for p in (reference, test)]
    opponent = [_linear(p, _OPPONENT) for p in pictures]
    first, second = (_perceived(p, pixels_per_degree) for p in opponent)
    colour = _hyab(first, second) ** _EXPONENT
    green, blue = (_hunt_lab(np.array(c, np.float32)[None, None]) for c in ((0, 1, 0), (0, 0, 1)))
    most = float(_hyab(green, blue)[0, 0]) ** _EXPONENT
    knee = _KNEE * most
    above = _AT_KNEE + (colour - knee) / (most - knee) * (1 - _AT_KNEE)
    colour = np.where(colour < knee, colour * (_AT_KNEE / knee), above)
    return np.clip(colour, 0, 1) ** (1 - _features(*(p[..., 0] / 116 for p in opponent), pixels_per_degree))


def _linear(pixels: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    return cv2.transform(pixels, matrix.astype(np.float32))


def _perceived(opponent: np.ndarray, ppd: float) -> np.ndarray:
    """What the eye resolves of a picture, in L*a*b* with Hunt's weakening of dark colours."""
    radius = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * ppd)
    x2 = (np.arange(-radius, radius + 1) / ppd) ** 2
    channels = []
    for channel, (a1, b1, a2, b2) in zip(cv2.split(opponent), _SENSITIVITY, strict=True):
        # a Gaussian in two axes is the product of two; the factor of each in the sum stays with the sum
        parts = [(a * math.pi / b, np.exp(-(math.pi**2) / b * x2)) for a, b in ((a1, b1), (a2, b2)) if a]
        total = sum(factor * kernel.sum() ** 2 for factor, kernel in parts)
        channels.append(sum(_filtered(channel, k, k) * np.float32(factor / total) for factor, k in parts))
    return _hunt_lab(np.clip(_linear(cv2.merge(channels), np.linalg.inv(_OPPONENT)), 0, 1))


def _filtered(x: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(x, cv2.CV_32F, columns, rows, borderType=cv2.BORDER_REPLICATE)


def _hunt_lab(linear: np.ndarray) -> np.ndarray:
    xyz = _linear(linear, _XYZ / _WHITE[:, None])
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    lightness = 116 * f[..., 1] - 16
    a, b = 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])
    return np.stack([lightness, 0.01 * lightness * a, 0.01 * lightness * b], -1)


def _hyab(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    d = np.abs(first - second)
    return d[..., 0] + np.sqrt(d[..., 1] ** 2 + d[..., 2] ** 2)


def _features(first: np.ndarray, second: np.ndarray, ppd: float) -> np.ndarray:
    """How much edges and points of two lightnesses (H, W) differ, in [0, 1]."""
    sigma = 0.5 * _FEATURE * ppd
    radius = math.ceil(3 * sigma)
    x = np.arange(-radius, radius + 1)
    bell = np.exp(-(x**2) / (2 * sigma**2))
    edge = -x * bell
    point = (x**2 / sigma**2 - 1) * bell
    bell = bell / bell.sum()
    edge = edge / edge[edge > 0].sum()
    point = np.where(point > 0, point / point[point > 0].sum(), point / -point[point < 0].sum())
    difference = 0
    for kernel in (edge, point):
        strengths = [np.hypot(_filtered(p, kernel, bell), _filtered(p, bell, kernel)) for p in (first, second)]
        difference = np.maximum(difference, np.abs(strengths[0] - strengths[1]))
    return np.sqrt(np.clip(difference / math.sqrt(2), 0, 1))
