"""Regions of a photo: found by engines chosen by name, or selected by clicks."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..errors import PaletteError
from ..region import Region
from .auto import segment_auto
from .materialistic import Materialistic, segment_materialistic
from .pick import Pick
from .sam import Sam, segment_sam

SEGMENTERS = {"auto": segment_auto, "sam": segment_sam, "materialistic": segment_materialistic}
REGIONS = 8  # by default
MOST_REGIONS = 32


def segment(
    photo_pixels: np.ndarray,
    engine: str = "auto",
    regions: int = REGIONS,
    seed: int = 0,
    progress: Callable[[float, str], None] = lambda fraction, message: None,
    warn: Callable[[str], None] = lambda text: None,
    weights: str | Path | None = None,
) -> list[Region]:
    """At most `regions` regions of a photo (H, W, 3) linear float32, disjoint, by decreasing area.

    They need not cover the photo: what is too small to hold a texture or no surface is left out, and `warn` told.
    `weights` is the folder or file of an engine that doesn't bring its own ("sam", "materialistic").
    Raises PaletteError for an unknown engine, a number of regions outside 1..32, or a photo without any region.
    """
    if engine not in SEGMENTERS:
        raise PaletteError(f"There is no segmentation '{engine}'; there is: {', '.join(sorted(SEGMENTERS))}.")
    if not 1 <= regions <= MOST_REGIONS:
        raise PaletteError(f"The number of regions is {regions}; it must be from 1 to {MOST_REGIONS}.")
    found = SEGMENTERS[engine](photo_pixels, regions, seed, progress, warn, weights)
    if not found:
        raise PaletteError(
            f"Segmentation '{engine}' found no region large enough for a texture. Use a larger photo or paint masks."
        )
    return found


def picker(weights: str | Path | None = None) -> Pick | Sam | Materialistic:
    """What answers clicks on a photo: `look(pixels, progress)` once, then `select(clicks, tolerance)` at will.

    Without `weights` the embedded `Pick`; with the folder of a Segment Anything model `Sam`, which also takes a `box`;
    with another file or folder `Materialistic`. Raises PaletteError when these can't be loaded.
    """
    if not weights:
        return Pick()
    path = Path(weights)
    segment_anything = (path / "config.json").exists() or any(path.glob("*coder*.onnx"))
    return Sam(path) if segment_anything else Materialistic(path)
