"""SVBRDF: the maps of one material, each a tileable image or a constant."""

from dataclasses import dataclass

import numpy as np


@dataclass
class SVBRDF:
    """Spatially varying Cook-Torrance GGX material on the torus.

    albedo     (H, W, 3) float32, linear Rec.709 in [0, 1], or a constant (3,).
    normal     (H, W, 3) float32 unit vectors, tangent space, +Y up (OpenGL), or a constant (3,).
    roughness  (H, W) float32 perceptual roughness in [0, 1] (alpha = roughness^2), or a float.
    height     (H, W) float32 in units of the tile's width, mean 0, or None: the surface is flat.
    metallic   (H, W) float32 in [0, 1], or None: a dielectric.
    """

    albedo: np.ndarray
    normal: np.ndarray
    roughness: np.ndarray | float
    height: np.ndarray | None = None
    metallic: np.ndarray | None = None
