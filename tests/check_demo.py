"""Run `dev.py demo` twice and check what it promises: time, memory, statuses, seams, the same files twice.

    .venv/bin/python tests/check_demo.py FOLDER

writes FOLDER/first and FOLDER/second; exits with 1 and the list of what failed.
"""

import hashlib
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
SECONDS, GIGABYTES, MATERIALS, RESOLUTION = 90, 4.0, 3, 1024


def run(folder):
    """Extract the example into `folder`; wall seconds and peak resident memory in GB of the process."""
    start = time.perf_counter()
    subprocess.run([sys.executable, str(ROOT / "dev.py"), "demo", "-o", str(folder)], check=True)
    seconds = time.perf_counter() - start
    unit = 1 if sys.platform == "darwin" else 1024  # ru_maxrss counts bytes on macOS, kB on Linux
    return seconds, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * unit / 1e9


def without_seconds(content):
    if isinstance(content, dict):
        return {key: without_seconds(value) for key, value in content.items() if key != "seconds"}
    return [without_seconds(value) for value in content] if isinstance(content, list) else content


def digests(folder):
    """SHA-256 of what must be the same in two runs: every file but palette.blend, into which Blender writes addresses
    of its memory; the JSON files less the seconds."""
    found = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix != ".blend"):
        content = path.read_bytes()
        if path.suffix == ".json":
            content = json.dumps(without_seconds(json.loads(content)), sort_keys=True).encode()
        found[path.relative_to(folder).as_posix()] = hashlib.sha256(content).hexdigest()
    return found


def check_maps(folder, wrap_ratio, gate):
    """Failures of one palette: statuses, sizes, and the wrap gate on every map that is an image."""
    palette = json.loads((folder / "palette.json").read_text(encoding="utf-8"))
    materials = palette["materials"]
    failures = [f"{m['name']}: {m['status']}, {m['error']}" for m in materials if m["status"] != "ok"]
    if len(materials) < MATERIALS:
        failures.append(f"{len(materials)} materials, at least {MATERIALS} are promised")
    for material in materials:
        for kind, entry in material["maps"].items():
            if "file" not in entry:
                print(f"  {material['name']:>12} {kind:<10} constant {entry['value']}")
                continue
            pixels = cv2.imread(str(folder / entry["file"]), cv2.IMREAD_UNCHANGED)
            ratio = wrap_ratio(pixels.astype(np.float32) / np.iinfo(pixels.dtype).max)
            print(f"  {material['name']:>12} {kind:<10} {pixels.shape[1]} x {pixels.shape[0]}  wrap {ratio:.2f}")
            if ratio > gate:
                failures.append(f"{entry['file']}: wrap step {ratio:.2f} > {gate}")
            # maps have no more texels than they need
            if pixels.shape[0] != pixels.shape[1] or pixels.shape[0] > RESOLUTION:
                failures.append(f"{entry['file']}: {pixels.shape[1]} x {pixels.shape[0]}, at most {RESOLUTION} square")
    return failures


def main(folder):
    sys.path.insert(0, str(ROOT))
    import dev

    dev.load_package()
    from material_palette.core.torus import WRAP_GATE, wrap_ratio

    failures = []
    for name in ("first", "second"):
        seconds, gigabytes = run(folder / name)
        print(f"{name} run: {seconds:.1f} s wall (limit {SECONDS}), {gigabytes:.2f} GB peak (limit {GIGABYTES})")
        if seconds > SECONDS:
            failures.append(f"{name} run took {seconds:.1f} s")
        if gigabytes > GIGABYTES:
            failures.append(f"{name} run took {gigabytes:.2f} GB")
    failures += check_maps(folder / "first", wrap_ratio, WRAP_GATE)
    first, second = digests(folder / "first"), digests(folder / "second")
    different = sorted(n for n in first.keys() | second.keys() if first.get(n) != second.get(n))
    failures += [f"{name}: differs between two runs" for name in different]
    if not different:
        print(f"{len(first)} files are identical in both runs")
    for failure in failures:
        print("FAILED " + failure)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
