"""Brush help: a few scribbles inside and outside become a region, by grabCut (Rother et al. 2004) as OpenCV has it."""

import cv2
import numpy as np

from ..errors import PaletteError
from ..image import srgb_from_linear

GRABCUT_PIXELS = 300_000  # the photo is reduced to this; 2 MP would take ten seconds
ROUNDS = 4


def region_from_scribbles(pixels: np.ndarray, inside: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """(H, W) bool: the region of a photo (H, W, 3) linear float32 that holds `inside` and not `outside`.

    inside, outside (H, W) bool: what was brushed. Where both were, inside counts. Without anything outside, the photo's
    edge counts as outside where it isn't brushed. Deterministic.
    Raises PaletteError when nothing is brushed inside or the shapes differ.
    """
    if inside.shape != pixels.shape[:2] or outside.shape != pixels.shape[:2]:
        raise PaletteError("The scribbles are not of the photo's size; brush them anew on this photo.")
    if not inside.any():
        raise PaletteError("Nothing is brushed inside the region. Brush at least a stroke there.")
    if not outside.any():
        outside = np.ones_like(outside)
        outside[1:-1, 1:-1] = False
    height, width = inside.shape
    scale = min(1.0, (GRABCUT_PIXELS / (height * width)) ** 0.5)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    encoded = np.clip(srgb_from_linear(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)), 0, 1)
    small = np.round(encoded * 255).astype(np.uint8)
    trimap = np.full(small.shape[:2], cv2.GC_PR_BGD, np.uint8)
    trimap[_reduced(outside, size)] = cv2.GC_BGD
    trimap[_reduced(inside, size)] = cv2.GC_FGD
    if (trimap == cv2.GC_FGD).all():
        return np.ones_like(inside)
    cv2.setRNGSeed(0)
    background, foreground = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(small, trimap, None, background, foreground, ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.float32)
    soft = cv2.resize(cv2.GaussianBlur(found, (0, 0), 0.7), (width, height), interpolation=cv2.INTER_LINEAR)
    return (soft > 0.5) & ~outside | inside


def _reduced(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
