"""From a tileable texture to its SVBRDF. Decomposers are chosen by name; all take the texture and give an SVBRDF."""

from collections.abc import Callable

import numpy as np

from ..errors import PaletteError
from ..material import SVBRDF
from . import analytic, unet

DECOMPOSERS = {"unet": unet.decompose, "analytic": analytic.decompose}


def decompose(texture: np.ndarray, progress: Callable[[float, str], None], decomposer: str = "unet") -> SVBRDF:
    """The SVBRDF of a texture (H, W, 3) float32 linear, which wraps; rolling the texture rolls the maps.

    Raises PaletteError for an unknown decomposer and for weights that cannot be read.
    """
    if decomposer not in DECOMPOSERS:
        raise PaletteError(f"decomposer '{decomposer}' is unknown; choose one of: {', '.join(DECOMPOSERS)}")
    return DECOMPOSERS[decomposer](texture, progress)


def constant(colour: np.ndarray) -> SVBRDF:
    """The SVBRDF of a uniform region: colour (3,) linear, flat."""
    return SVBRDF(np.clip(colour, 0, 1).astype(np.float32), np.array([0, 0, 1], np.float32), analytic.ROUGHNESS)
