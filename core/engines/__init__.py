"""Engines learn a concept from an exemplar and sample a tileable texture of it; chosen by name.

An engine is a module with `learn(pixels, mask, progress) -> concept` and
`sample(concept, size, seed, progress, quality) -> texture`, as `patch` documents them.
"""

from . import patch

ENGINES = {"patch": patch}
