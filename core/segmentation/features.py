"""What a photo's superpixels are made of: vectors that are near for one material and far for two.

1. SLIC superpixels (Achanta et al. 2012) in CIELAB on a reduced photo.
2. Mean and deviation per superpixel of colour, of ratios of colours, which light leaves alone, and of texture: energy
   in bands, direction and coherence of edges, skewness, all of the logarithm of lightness.
3. Smoothing over neighbouring superpixels, projection by a linear discriminant (fitted by training/segmentation.py:
   within a material, over light, tilt and place, each direction has deviation 1), smoothing again over neighbours that
   are alike.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from ..errors import PaletteError
from ..image import srgb_from_linear
from ..tensors import read_tensors

DISCRIMINANT = Path(__file__).resolve().parent.parent.parent / "models" / "segmentation.safetensors"
DESCRIBED_PIXELS = 400_000
BRIGHT = 0.5  # linear; a darker photo is exposed so that its brightest hundredth begins here
MOST_GAIN = 64.0  # beyond it there is nothing but the camera's noise
SUPERPIXELS = 1600
SLIC_RULER = 10.0  # weight of compactness against colour
SLIC_STEPS = 6
BANDS = (1, 2, 4, 8)  # px
BAND_COLUMNS = slice(6, 10)  # of the statistics: the logarithm of each band's contrast
EDGE_SCALES = (1, 3)  # px
DARKEST = 8.0  # of L; below it contrast is the camera's noise
PLAIN_ROUNDS, ALIKE_ROUNDS = 2, 8  # of smoothing over the graph of superpixels


@dataclass
class Features:
    """A photo's superpixels. shape: (H, W) of the photo; labels (h, w) int, 0..n-1, of the reduced photo; lab (h, w, 3)
    float32 CIELAB of it; size (n,) px; borders (m, 3) int: a < b that touch, length in px; statistics (n, s) float32;
    vectors (n, d) float32."""

    shape: tuple[int, int]
    labels: np.ndarray
    lab: np.ndarray
    size: np.ndarray
    borders: np.ndarray
    statistics: np.ndarray
    vectors: np.ndarray


def describe(pixels: np.ndarray, progress: Callable[[float, str], None] = lambda fraction, message: None) -> Features:
    """Features of a photo (H, W, 3) linear float32."""
    progress(0.0, "Looking at the photo")
    features = measure(pixels, progress)
    discriminant = _discriminant()
    vectors = (features.statistics - discriminant["mean"]) @ discriminant["projection"]
    features.vectors = smoothed(smoothed_plainly(vectors, features), features)
    progress(1.0, "Looking at the photo")
    return features


def measure(pixels: np.ndarray, progress: Callable[[float, str], None]) -> Features:
    """Features of a photo without vectors."""
    rgb = _reduced(pixels)
    lab = cv2.cvtColor(np.clip(srgb_from_linear(rgb), 0, 1), cv2.COLOR_RGB2LAB)
    labels = _superpixels(lab, lambda fraction: progress(0.1 + 0.4 * fraction, "Looking at the photo"))
    size = np.bincount(labels.ravel())
    columns, deviations = [], []
    flat = labels.ravel()
    for index, channel in enumerate(_channels(lab, rgb)):
        mean = np.bincount(flat, channel.ravel()) / size
        square = np.bincount(flat, np.square(channel, dtype=np.float64).ravel()) / size
        columns.append(mean)
        deviations.append(np.sqrt(np.maximum(square - mean**2, 0)))
        progress(min(0.9, 0.5 + 0.015 * index), "Looking at the photo")
    statistics = np.stack(columns + deviations, 1).astype(np.float32)
    nothing = np.empty((len(size), 0), np.float32)
    return Features(pixels.shape[:2], labels, lab, size, _borders(labels), statistics, nothing)


def smoothed_plainly(vectors: np.ndarray, features: Features) -> np.ndarray:
    """(n, d) vectors averaged over all neighbours."""
    for _ in range(PLAIN_ROUNDS):
        vectors = _round(vectors, features, None)
    return vectors


def smoothed(vectors: np.ndarray, features: Features) -> np.ndarray:
    """(n, d) vectors averaged over neighbours that are alike, round by round."""
    for _ in range(ALIKE_ROUNDS):
        a, b = features.borders[:, 0], features.borders[:, 1]
        distance = np.square(vectors[a] - vectors[b]).sum(1)
        vectors = _round(vectors, features, np.exp(-distance / max(np.median(distance), 1e-9)))
    return vectors.astype(np.float32)


def _round(vectors: np.ndarray, features: Features, alike: np.ndarray | None) -> np.ndarray:
    a, b, length = features.borders.T
    weight = 0.5 * features.size.mean() * length / max(length.mean(), 1e-9) if len(length) else length
    if alike is not None:
        weight = weight * alike
    flow = np.zeros((len(vectors),) * 2, np.float32)
    flow[a, b] = flow[b, a] = weight
    np.fill_diagonal(flow, features.size)
    return flow @ vectors / flow.sum(1, keepdims=True)


@cache
def _discriminant() -> dict[str, np.ndarray]:
    return read_tensors(DISCRIMINANT)[0]


def _reduced(pixels: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 linear, at most DESCRIBED_PIXELS, its brightest hundredth from BRIGHT to 1 on."""
    height, width = pixels.shape[:2]
    scale = min(1.0, (DESCRIBED_PIXELS / (height * width)) ** 0.5)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    bright = float(np.percentile(small.max(2), 99))  # a photo in floats may be exposed beyond 1
    return small * np.float32(min(BRIGHT / bright, MOST_GAIN) if 0 < bright < BRIGHT else 1 / max(1.0, bright))


def _superpixels(lab: np.ndarray, progress: Callable[[float], None]) -> np.ndarray:
    """(h, w) labels 0..n-1 of connected superpixels."""
    if not hasattr(cv2, "ximgproc"):
        raise PaletteError(
            "Finding regions needs OpenCV with its contrib modules (opencv-contrib-python-headless). "
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


def _channels(lab: np.ndarray, rgb: np.ndarray):
    """(h, w) maps, one after the other."""
    lightness, a, b = cv2.split(lab)
    yield lightness / 100
    yield a / 50
    yield b / 50
    red, green, blue = (np.log(channel + 0.02) for channel in cv2.split(rgb))
    yield red - green
    yield blue - green
    yield green
    contrast = np.log(lightness + DARKEST)
    blurred = {scale: cv2.GaussianBlur(contrast, (0, 0), scale) for scale in (1, 2, 3, 4, 8, 9, 16)}
    for scale in BANDS:
        yield _energy(blurred[scale] - blurred[2 * scale], 2 * scale, 0.005)
    yield _energy(contrast - blurred[1], 2, 0.005)
    for scale in EDGE_SCALES:
        dx = cv2.Scharr(blurred[scale], cv2.CV_32F, 1, 0)
        dy = cv2.Scharr(blurred[scale], cv2.CV_32F, 0, 1)
        xx, yy, xy = (cv2.GaussianBlur(p, (0, 0), 2 * scale + 1) for p in (dx * dx, dy * dy, dx * dy))
        strength = xx + yy + 0.05
        yield np.sqrt((xx - yy) ** 2 + 4 * xy**2) / strength
        yield (xx - yy) / strength
        yield 2 * xy / strength
    for channel in (a, b):
        for scale in (1, 4):
            band = cv2.GaussianBlur(channel, (0, 0), scale) - cv2.GaussianBlur(channel, (0, 0), 2 * scale)
            yield _energy(band, 2 * scale, 0.2)
    for scale in EDGE_SCALES:
        band = contrast - blurred[3 * scale]
        yield cv2.GaussianBlur(np.sign(band) * np.sqrt(np.abs(band)), (0, 0), 2 * scale)


def _energy(band: np.ndarray, scale: float, noise: float) -> np.ndarray:
    return np.log(np.sqrt(cv2.GaussianBlur(band * band, (0, 0), scale)) + noise)


def _borders(labels: np.ndarray) -> np.ndarray:
    """(m, 3) int: a < b that touch, and the length of their border in px."""
    right = np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()])
    below = np.stack([labels[:-1].ravel(), labels[1:].ravel()])
    pairs = np.concatenate([right, below], 1)
    pairs = np.sort(pairs[:, pairs[0] != pairs[1]], 0)
    count = labels.max() + 1
    keys, lengths = np.unique(pairs[0].astype(np.int64) * count + pairs[1], return_counts=True)
    return np.stack([keys // count, keys % count, lengths], 1)
