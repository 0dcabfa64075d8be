"""How long extraction took on this machine: remembered in the extension's own folder, told before the next run."""

from pathlib import Path

import bpy

from ..core import pace

_history = None


def add(chosen, records):
    """Remember the seconds of the materials (records of palette.json) that were made with the settings `chosen`."""
    history = _load()
    for record in records:
        if "sample" in record["seconds"]:  # a constant material says nothing of the engine
            history.append(
                {key: chosen[key] for key in ("engine", "quality")}
                | {"resolution": _sampled(chosen["resolution"], chosen["scale"])}
                | {"seconds": sum(record["seconds"].values())}
            )
    pace.remember(_path(), history)


def expected(settings, quality, regions):
    """Seconds that extracting so many regions will take with a scene's settings; None while nothing is known."""
    return pace.expected(_load(), settings.engine, quality, _sampled(settings.resolution, settings.scale), regions)


def count():
    """How many materials are remembered."""
    return len(_load())


def folder():
    """Where they are remembered, or None."""
    return _path().parent if _path() else None


def clear():
    """Forget all, for good."""
    _load().clear()
    pace.remember(_path(), [])


def forget():
    global _history
    _history = None


def _sampled(resolution, scale):
    """Side in px of the texture that is made, as `core.palette.Settings.sampled`."""
    return round(resolution / scale)


def _load():
    global _history
    if _history is None:
        _history = pace.remembered(_path())
    return _history


def _path():
    try:
        return Path(bpy.utils.extension_path_user(__package__.rpartition(".")[0], create=True)) / "pace.json"
    except ValueError:  # not installed as an extension: there is no folder to write to
        return None
