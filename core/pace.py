"""How long a material takes on this machine, from the last runs on it."""

import json
import statistics
from pathlib import Path

_KEPT = 200  # runs remembered
_COUNTED = 5  # of them, the latest of a kind, decide


def expected(history: list[dict], engine: str, quality: str, resolution: int, materials: int) -> float | None:
    """Seconds that `materials` materials will take, or None when no run of this engine and quality is remembered.

    history: what `remembered` returns. Taken from the runs at the nearest resolution, by the number of pixels.
    """
    runs = [run for run in history if run["engine"] == engine and run["quality"] == quality]
    if not runs:
        return None
    nearest = min((run["resolution"] for run in runs), key=lambda r: abs(r - resolution))
    latest = [run["seconds"] for run in runs if run["resolution"] == nearest][-_COUNTED:]
    return materials * statistics.median(latest) * (resolution / nearest) ** 2


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
