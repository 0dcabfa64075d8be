"""Engines learn a concept from an exemplar and sample a tileable texture of it; chosen by name.

An engine, opened with its own settings, has `learn(pixels, mask, progress) -> concept`,
`sample(concept, size, seed, progress, quality) -> texture`, as `patch` documents them, and LEARNING_SHARE, learning's
part of the time of both. A concept and a texture may have warnings. `to_tensors(concept)` and
`from_tensors(tensors, facts, progress)`, where it has them, save one.
"""

from . import diffusion, patch

ENGINES = {"patch": lambda settings: patch, "diffusion": diffusion.Engine}


def open_engine(name: str, settings: diffusion.DiffusionSettings | None):
    """The engine of this name. Raises PaletteError when its settings or its packages don't allow to start."""
    return ENGINES[name](settings)
