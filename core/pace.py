"""How long a material takes on this machine, from the last runs on it."""

import json
import statistics
from pathlib import Path

_KEPT = 200  # runs remembered
_COUNTED = 5  # of them, the latest of a kind, decide
_UNTIMED = 8.0  # seconds of `balanced` at 1024 px on two cores of a server; stands in until a material has been timed
_QUALITY = {"draft": 0.75, "balanced": 1.0, "best": 2.2}  # cost beside `balanced`, as docs/results.md has it


def expected(history: list[dict], engine: str, quality: str, resolution: int, materials: int) -> float | None:
    """Seconds that `materials` materials will take; None for an engine of which nothing can be said.

    history: what `remembered` returns. Runs of the same quality at the nearest resolution decide, else those of another
    quality; the engine patch is forecast even before any run, as on the machine that the benchmark of speed ran on.
    """
    runs = [run for run in history if run["engine"] == engine]
    known = {q: _seconds(found, q, resolution) for q in _QUALITY if (found := [r for r in runs if r["quality"] == q])}
    if quality in known:
        return materials * known[quality]
    if engine != "patch":
        return None
    seconds = _seconds(runs, quality, resolution) if runs else _UNTIMED * _cost(quality, resolution)
    order = list(_QUALITY)  # none takes longer than the next
    least = [known[q] for q in order[: order.index(quality)] if q in known]
    most = [known[q] for q in order[order.index(quality) :] if q in known]
    return materials * min([max([seconds, *least]), *most])


def _seconds(runs, quality, resolution):
    """Of one material, from the latest runs at the nearest resolution."""
    nearest = min((run["resolution"] for run in runs), key=lambda r: abs(r - resolution))
    latest = [run for run in runs if run["resolution"] == nearest][-_COUNTED:]
    pace = statistics.median(run["seconds"] / _cost(run["quality"], run["resolution"]) for run in latest)
    return pace * _cost(quality, resolution)


def _cost(quality, resolution):
    """Beside that of `balanced` at 1024 px: a part that each region takes, and one that grows with the side to 1.6."""
    return 0.12 + 0.88 * _QUALITY.get(quality, 1.0) * (resolution / 1024) ** 1.6


def remembered(path: Path | None) -> list[dict]:
    """The runs in the file, oldest first; none when there is no file or it can't be understood."""
    try:
        runs = json.loads(Path(path).read_text(encoding="utf-8"))
        return [
            {
                "engine": str(run["engine"]),
                "quality": str(run["quality"]),
                "resolution": int(run["resolution"]),
                "seconds": float(run["seconds"]),
            }
            for run in runs
            if int(run["resolution"]) > 0
        ]
    except (OSError, TypeError, ValueError, LookupError):  # a damaged memory costs a forecast, not the run
        return []


def remember(path: Path | None, history: list[dict]) -> None:
    """Write the latest of `history`; a folder that can't be written only costs the memory."""
    try:
        Path(path).write_text(json.dumps(history[-_KEPT:]), encoding="utf-8")
    except (OSError, TypeError):
        pass
