"""What a material does not need: a map that is constant within what 8 bits show becomes a value."""

import numpy as np

from .image import srgb_from_linear
from .material import SVBRDF

STEP = 1.0 / 255


def reduce(svbrdf: SVBRDF) -> tuple[SVBRDF, list[str]]:
    """The SVBRDF with constants in place of maps that show none of their variation, and a line on each such map."""
    albedo, normal, roughness, height = svbrdf.albedo, svbrdf.normal, svbrdf.roughness, svbrdf.height
    reduced = []
    if albedo.ndim > 1 and _flat(srgb_from_linear(albedo)):
        albedo = albedo.reshape(-1, 3).mean(0)
    if albedo.ndim == 1:
        reduced.append("basecolor: one colour")
    if normal.ndim > 1 and _flat((normal + 1) / 2) and np.abs(normal.reshape(-1, 3).mean(0)[:2]).max() < STEP:
        normal = np.array([0, 0, 1], np.float32)
    if normal.ndim == 1:
        # the normal is the height's gradient: without slope there is no relief to displace
        height = None
        reduced += ["normal: flat", "height: flat"]
    if np.ndim(roughness) and _flat(roughness):
        roughness = float(roughness.mean())
    if not np.ndim(roughness):
        reduced.append(f"roughness: {roughness:.2f} everywhere")
    return SVBRDF(albedo, normal, roughness, height, svbrdf.metallic), reduced


def _flat(encoded: np.ndarray) -> bool:
    channels = encoded.reshape(-1, encoded.shape[-1]) if encoded.ndim == 3 else encoded.reshape(-1, 1)
    return bool((channels.max(0) - channels.min(0) <= STEP).all())
