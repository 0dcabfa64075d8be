"""What every suite writes: a CSV of rows, and a JSON that says where they come from; finished parts of long runs."""

import csv
import json
import os
import platform
import resource
import shlex
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent


def machine() -> dict:
    cpu = platform.processor()
    try:
        cpu = next(x for x in Path("/proc/cpuinfo").read_text().splitlines() if x.startswith("model name"))
        cpu = cpu.split(":")[1].strip()
    except (OSError, StopIteration):
        pass
    versions = {"python": platform.python_version(), "torch": torch.__version__, "opencv": cv2.__version__}
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        **versions,
        "numpy": np.__version__,
    }


def commit() -> str:
    """The commit that is measured; a plus says that the product's files differ from it."""

    def git(*arguments):
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True).stdout.strip()

    return git("rev-parse", "--short=10", "HEAD") + ("+" if git("status", "--porcelain", "core", "models") else "")


def command() -> str:
    """What was typed, without the folders of this machine."""
    words = [Path(sys.argv[0]).name]
    for word in sys.argv[1:]:
        label, equals, path = word.rpartition("=")  # row=FILE too
        words.append(label + equals + Path(path).name if os.path.isabs(path) else word)
    return shlex.join(words)


class Parts:
    """Finished pieces of the run that writes `output`, by name, one JSON each, so that a stopped run goes on; `minutes`
    ends it early. They lie in `parts` beside the output, in a folder of its name."""

    def __init__(self, output: Path, quick: bool = False, minutes: float = float("inf")):
        self.folder = output.parent / "parts" / (output.name + ("-quick" if quick else ""))
        self.end = time.monotonic() + 60 * minutes
        self.folder.mkdir(parents=True, exist_ok=True)

    def get(self, name: str, make):
        """The piece of that name: as it lies there, else as `make()` makes it. None: out of time."""
        path = self.folder / f"{name}.json"
        if path.exists():
            return json.loads(path.read_text())["piece"]
        if time.monotonic() > self.end:
            return None
        piece = make()
        temporary = path.with_suffix(".new")
        temporary.write_text(json.dumps({"commit": commit(), "piece": piece}))
        temporary.replace(path)
        return piece

    def commits(self) -> list[str]:
        return sorted({json.loads(path.read_text())["commit"] for path in self.folder.glob("*.json")})


def peak_mb() -> float:
    """This process's largest resident memory in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024 if sys.platform != "darwin" else 1024**2)


def write(folder: Path, name: str, rows: list[dict], about: dict, parts: Parts | None = None) -> None:
    """folder/name.csv of the rows, all their keys as columns; folder/name.json of the facts."""
    folder.mkdir(parents=True, exist_ok=True)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items()})
    commits = (parts.commits() if parts else []) or [commit()]
    facts = {"command": command(), "commits": commits, "machine": machine(), "peak_mb": round(peak_mb())}
    (folder / f"{name}.json").write_text(json.dumps(facts | about, indent=1) + "\n", encoding="utf-8")
