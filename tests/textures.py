"""Synthetic surfaces with a known property, for the tests."""

import cv2
import numpy as np


def pebbles(height: int, width: int, seed: int = 0) -> np.ndarray:
    """(H, W, 3) float32 in [0, 1]: blobs of a few px in two colours; does not tile."""
    random = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(random.standard_normal((height, width)).astype(np.float32), (0, 0), 2.5)
    share = 1 / (1 + np.exp(-40 * noise))[..., None]
    colour = share * np.array([0.75, 0.65, 0.5]) + (1 - share) * np.array([0.25, 0.22, 0.2])
    grain = 0.02 * random.standard_normal((height, width, 1))
    return np.clip(colour + grain, 0, 1).astype(np.float32)


def tileable_noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    """(H, W) float32 in [0, 1], smooth over a few px, wraps."""
    random = np.random.default_rng(seed)
    noise = np.tile(random.standard_normal((height, width)).astype(np.float32), (3, 3))
    noise = cv2.GaussianBlur(noise, (0, 0), 2.0)[height : 2 * height, width : 2 * width]
    return (noise - noise.min()) / np.ptp(noise)


def quiet(fraction: float, message: str) -> None:
    """Progress for nobody."""
