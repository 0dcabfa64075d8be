"""Decomposer `analytic`: albedo, normal, roughness and height of an evenly lit, tileable texture, without training.

Claim: gradients of luminance without a change of chromaticity are shading (colour Retinex); integrated on the torus
they give the shading, and, dark being deep, the height. Mean roughness is the prior, since no statistic of the texture
predicted it better on materials outside the fit (`training/analytic.py`).

Sources: Land and McCann 1971, Grosse et al. 2009 (colour Retinex); Langer and Zucker 1994 (dark is deep);
Frankot and Chellappa 1988 (integration).
"""

from collections.abc import Callable

import numpy as np
import torch

from ..exemplar import LUMINANCE
from ..material import SVBRDF
from ..torus import frequencies, gradient, integrate, normal_from_height

# fitted by training/analytic.py on the training materials
CHROMA = 0.1  # change of log chromaticity per pixel at which a gradient counts as albedo
SHADING = 0.2  # share of the shading found that is taken out of the albedo
RELIEF = 0.4  # slope per unit of log shading
ROUGHNESS = 0.6
VARIATION = 0.03  # deviation of roughness within a material: two thirds of the training materials' median
LEAST_CONTRAST = 0.05  # deviation of log luminance; what varies less varies in roughness less
# cycles per tile below which shading is no relief, but what is left of the illumination
LONGEST = 3.0
DARKEST = 0.02  # linear; keeps the logarithm of black finite
LEAST_ROUGHNESS = 0.05


def decompose(texture: np.ndarray, progress: Callable[[float, str], None]) -> SVBRDF:
    """The SVBRDF of a texture (H, W, 3) float32 linear, which wraps; rolling the texture rolls the maps."""
    pixels = torch.from_numpy(np.ascontiguousarray(texture))
    progress(0.0, "separating shading and albedo")
    shading = _shading(pixels)
    progress(0.4, "separating shading and albedo")
    albedo = (pixels * torch.exp(-SHADING * shading)[..., None]).clamp(0, 1)
    progress(0.5, "integrating the height")
    height = _relief(shading)
    progress(0.8, "computing normals")
    normal = normal_from_height(height)
    progress(1.0, "computing normals")
    return SVBRDF(albedo.numpy(), normal.numpy(), vary(ROUGHNESS, albedo).numpy(), height.numpy())


def vary(mean: float, albedo: torch.Tensor) -> torch.Tensor:
    """Roughness (H, W) about a mean: what is darker in the albedo (H, W, 3) is rougher.

    In measured materials roughness follows the albedo's details (|r| = 0.5), in one half of them this way round, in the
    other half the other, and no picture tells which. So the pattern is likely, its sign a convention (dirt and pores
    are dark, worn edges bright), and it is weak, so that its squared error is hardly above that of none.
    """
    luminance = torch.log(albedo @ torch.from_numpy(LUMINANCE) + DARKEST)
    luminance = luminance - luminance.mean()
    varied = mean - VARIATION * luminance / luminance.std().clamp_min(LEAST_CONTRAST)
    return varied.clamp(LEAST_ROUGHNESS, 1)


def relief(pixels: torch.Tensor) -> torch.Tensor:
    """Height (H, W) in tile widths of linear pixels (H, W, 3), which wrap, as `decompose` finds it."""
    return _relief(_shading(pixels))


def _shading(pixels: torch.Tensor) -> torch.Tensor:
    """Logarithm of the shading (H, W), mean 0."""
    luminance = torch.log(pixels @ torch.from_numpy(LUMINANCE) + DARKEST)
    change = torch.zeros_like(luminance)
    for channel in range(3):
        for slope in gradient(torch.log(pixels[..., channel] + DARKEST) - luminance):
            change += slope**2
    share = torch.exp(-change / CHROMA**2)
    dx, dy = gradient(luminance)
    return integrate(share * dx, share * dy)


def _relief(shading: torch.Tensor) -> torch.Tensor:
    """Height (H, W) in tile widths. Divided by frequency: a dark spot of any size is a dent of the same slope."""
    v, u = frequencies(*shading.shape)
    frequency = torch.sqrt(u**2 + v**2)
    longest = LONGEST * 2 * torch.pi / min(shading.shape)
    band = frequency**2 / (frequency**2 + longest**2) / (frequency + 0.05)
    return RELIEF / shading.shape[1] * torch.fft.irfft2(torch.fft.rfft2(shading) * band, s=shading.shape)
