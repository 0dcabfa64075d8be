"""From a tileable texture to its SVBRDF. Decomposers are chosen by name; all take the texture and give an SVBRDF."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from ...models import resnet101
from ..errors import PaletteError
from ..material import SVBRDF
from . import analytic, unet

DECOMPOSERS = {"unet": unet.decompose, "analytic": analytic.decompose}
# those that take their weights from a file of the user's; resnet101 has no other
FROM_FILE = {"unet": unet.decompose, "resnet101": resnet101.decompose}


def choose(decomposer: str) -> Callable[[np.ndarray, Callable[[float, str], None]], SVBRDF]:
    """The function of a decomposer, a name or name=FILE with its weights. PaletteError where there is none such."""
    name, _, file = decomposer.partition("=")
    if not file and name in DECOMPOSERS:
        return DECOMPOSERS[name]
    if name not in FROM_FILE:
        known = ", ".join([*DECOMPOSERS, *(f"{n}=FILE" for n in FROM_FILE)])
        raise PaletteError(f"decomposer '{decomposer}' is unknown; choose one of: {known}")
    if not Path(file).is_file():
        raise PaletteError(f"decomposer '{name}' needs a file of weights: {name}=FILE; there is none at '{file}'")
    return partial(FROM_FILE[name], weights=Path(file))


def prepare(decomposer: str) -> None:
    """Read the weights of a decomposer name=FILE before there is a texture; they are kept.

    Raises PaletteError for weights that cannot be read.
    """
    name, _, file = decomposer.partition("=")
    if file:
        {"unet": unet, "resnet101": resnet101}[name].load(Path(file))


def decompose(texture: np.ndarray, progress: Callable[[float, str], None], decomposer: str = "unet") -> SVBRDF:
    """The SVBRDF of a texture (H, W, 3) float32 linear, which wraps; rolling the texture rolls the maps.

    Raises PaletteError for an unknown decomposer and for weights that cannot be read.
    """
    return choose(decomposer)(texture, progress)


def constant(colour: np.ndarray) -> SVBRDF:
    """The SVBRDF of a uniform region: colour (3,) linear, flat."""
    return SVBRDF(np.clip(colour, 0, 1).astype(np.float32), np.array([0, 0, 1], np.float32), analytic.ROUGHNESS)
