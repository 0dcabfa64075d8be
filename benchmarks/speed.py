#!/usr/bin/env python3
"""Speed against accuracy of the whole product, and how the cost grows.

    .venv/bin/python benchmarks/speed.py -o DIR/speed [--errors DIR/endtoend/endtoend.csv] [--largest 8192]
    python3 dev.py bench speed --quick

Points are preset x decomposer: CPU and wall seconds per material at 1024 px (a bundled region), against the
end-to-end error that `endtoend` has measured. Growth: resolution, regions, megapixels of the photo; each run in a
process of its own, of which the peak memory is stated. `palette` is the command line's four materials of the bundled
viaduct, from photo to .blend; `engine` is the patch engine by itself. Wall seconds mean something on an idle machine
only. A run that was stopped goes on.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.benchmarks import charts, endtoend, measures, records  # noqa: E402
from material_palette.core import palette  # noqa: E402
from material_palette.core.engines import patch  # noqa: E402
from material_palette.core.exemplar import cut_exemplar  # noqa: E402
from material_palette.core.image import read_mask, read_photo, srgb_from_linear  # noqa: E402
from material_palette.core.region import Region, read_regions  # noqa: E402

PHOTO, REGION = "facade", "stone_wall"  # bundled
GROWTH = {  # what grows: its values, and the exponent that theory gives
    "resolution": ((256, 512, 1024, 2048, 4096, 8192), 2.0, "px, side of the maps"),
    "regions": ((1, 2, 4, 8, 16, 32), 1.0, "regions of one photo, 256 px"),
    "megapixels": ((0.5, 2, 8, 24, 50), 1.0, "megapixels of the photo, 512 px"),
}
ENGINE = (("draft", 512, 5), ("balanced", 1024, 5), ("draft", 4096, 1))  # quality, px, runs
SUITES = "palette", "engine", "points", "growth", "cores"
QUICK = {"resolution": (128, 256), "regions": (1, 2), "megapixels": (0.5, 1)}


def measured(what: str, value: float, quality: str = "balanced", decomposer: str = "unet") -> dict:
    """CPU and wall seconds and peak memory of one extraction in this process, after a small one has warmed it up."""
    folder = ROOT / "examples" / PHOTO
    pixels = read_photo(folder / "photo.jpg").pixels
    mask = read_mask(folder / "masks" / f"{REGION}.png", pixels.shape[:2])
    resolution = {"resolution": value, "regions": 256, "megapixels": 512}.get(what, value)
    settings = palette.Settings(resolution=int(resolution), quality=quality, decomposer=decomposer)
    if what == "megapixels":
        scale = float(np.sqrt(value * 1e6 / (pixels.shape[0] * pixels.shape[1])))
        pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
        mask = cv2.resize(mask.astype(np.uint8), pixels.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
    regions = [Region("region", mask)]
    if what == "regions":
        # pieces of all bundled regions, about alike in size whatever their number
        every = [r.mask for r in read_regions(folder / "masks", pixels.shape[:2])]
        regions = [Region(f"region {i}", piece) for i, piece in enumerate(pieces(np.any(every, 0), int(value)))]
    warm = palette.Settings(resolution=64, quality="draft", decomposer=decomposer)
    palette.extract_palette(pixels[:200, :200], [Region("warm", np.ones((200, 200), bool))], warm, _quiet)
    before = records.peak_mb()
    wall, cpu = time.perf_counter(), time.process_time()
    found = palette.extract_palette(pixels, regions, settings, _quiet)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    failed = [m.error for m in found.materials if m.error]
    if failed:
        raise SystemExit(failed[0])
    stages = {f"s_{stage}": round(seconds, 3) for stage, seconds in found.seconds.items()}
    peak = records.peak_mb()
    return {"cpu_seconds": cpu, "wall_seconds": wall, "peak_mb": peak, "added_mb": peak - before} | stages


def engine_alone(quality: str, size: int, runs: int) -> dict:
    """Medians over runs of CPU and wall seconds to learn the viaduct's masonry and sample a texture of it, the peak
    memory, and the longest time without a call of progress."""
    folder = ROOT / "examples" / "viaduct"
    pixels = read_photo(folder / "photo.jpg").pixels
    exemplar = cut_exemplar(pixels, read_mask(folder / "masks" / "masonry.png", pixels.shape[:2]))
    encoded = srgb_from_linear(np.clip(exemplar.pixels, 0, 1))
    taken, calls = [], []

    def progress(fraction: float, message: str) -> None:
        calls.append(time.perf_counter())

    for seed in range(runs):
        wall, cpu = time.perf_counter(), time.process_time()
        patch.sample(patch.learn(encoded, exemplar.mask, progress), (size, size), seed, progress, quality)
        taken.append((time.perf_counter() - wall, time.process_time() - cpu))
    wall, cpu = np.median(taken, 0)
    silence = float(np.diff(calls).max())
    return {"cpu_seconds": cpu, "wall_seconds": wall, "peak_mb": records.peak_mb(), "runs": runs, "silence": silence}


def pieces(mask: np.ndarray, count: int) -> list[np.ndarray]:
    """The first `count` of 32 squares of 96 px that lie most within a mask."""
    side = 96
    places = [(y, x) for y in range(0, mask.shape[0] - side, side) for x in range(0, mask.shape[1] - side, side)]
    places.sort(key=lambda place: -mask[place[0] : place[0] + side, place[1] : place[1] + side].sum())
    found = []
    for y, x in places[:count]:
        piece = np.zeros_like(mask)
        piece[y : y + side, x : x + side] = True
        found.append(piece)
    return found


def _quiet(fraction: float, message: str) -> None:
    pass


def in_process(cores: int, *case) -> dict:
    """`measured(*case)` in a process of its own on so many cores."""
    command = [sys.executable, __file__, "-o", ".", "--case", json.dumps(case)]
    if hasattr(os, "sched_setaffinity"):
        chosen = sorted(os.sched_getaffinity(0))[:cores]
        done = subprocess.run(
            command, capture_output=True, text=True, preexec_fn=lambda: os.sched_setaffinity(0, chosen)
        )
    else:
        done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr[-2000:])
    return json.loads(done.stdout.strip().splitlines()[-1])


def whole_palette(folder: Path) -> dict:
    """The command line on the bundled viaduct, four materials, balanced, 1024 px: wall seconds, start to end."""
    source = ROOT / "examples" / "viaduct"
    where = [str(source / "photo.jpg"), "--masks", str(source / "masks"), "--overwrite", "-o", str(folder)]
    code = "import sys, dev; sys.exit(dev.extract(sys.argv[1:]))"
    start, before = time.perf_counter(), os.times()
    subprocess.run([sys.executable, "-c", code, *where], cwd=ROOT, check=True, capture_output=True)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    stages = json.loads((folder / "palette.json").read_text(encoding="utf-8"))["seconds"]
    return {"wall_seconds": time.perf_counter() - start, "cpu_seconds": cpu, "stages": stages}


# ---------------------------------------------------------------- results


def exponent(values: list[float], seconds: list[float]) -> float:
    """The slope of the seconds over the values, both logarithmic, over the upper half of the values."""
    half = max(2, -(-len(values) // 2))
    return float(np.polyfit(np.log(values[-half:]), np.log(seconds[-half:]), 1)[0])


def errors_of(path: Path) -> dict[str, float]:
    """By row of endtoend.csv the mean ST-LPIPS over A, N and R and over the parts that all presets have: a median jumps
    where half of a few parts are flat."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    parts = {}
    for row in rows:
        parts.setdefault(row["row"], set()).add((row["scene"], row["part"]))
    common = set.intersection(*(p for name, p in parts.items() if name.startswith("ours, ") and "auto" not in name))
    found = {}
    for name in parts:
        own = [r for r in rows if r["row"] == name and (r["scene"], r["part"]) in common]
        if own:
            found[name] = float(np.mean([float(r[key]) for r in own for key in "ANR"]))
    return found


def chart_points(points: dict[str, tuple[float, float]], others: dict[str, float], path: Path) -> None:
    pyplot = charts.plt()
    if pyplot is None:
        return
    figure, axes = pyplot.subplots(figsize=(7, 4.2))
    front = measures.pareto(points)
    if front:
        axes.step(*zip(*(points[n] for n in front), strict=True), where="post", color="0.7", lw=1, zorder=1)
    for name, (x, y) in points.items():
        axes.plot(x, y, "o", color=charts.OURS if "unet" in name else charts.COLOURS[2], zorder=3)
        where = (6, 5 if "unet" in name else -11)
        axes.annotate(name.removeprefix("ours, "), (x, y), where, textcoords="offset points", fontsize=7)
    for i, (name, y) in enumerate(sorted(others.items(), key=lambda item: item[1])):
        axes.axhline(y, color=charts.OTHER, lw=0.8, ls="--")
        where = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points", "ha": "right"}
        axes.annotate(name, (0.99, y), (0, 2 if i % 2 else -9), fontsize=8, color=charts.OTHER, **where)
    axes.set_xlabel("CPU seconds per material at 1024 px")
    axes.set_ylabel("end-to-end error: mean ST-LPIPS of A, N, R")
    axes.margins(x=0.15, y=0.15)
    charts.save(figure, path)


def chart_growth(growth: dict, path: Path) -> None:
    pyplot = charts.plt()
    if pyplot is None:
        return
    figure, axes = pyplot.subplots(2, len(growth), figsize=(4 * len(growth), 5.4), squeeze=False)
    for (upper, lower), (what, rows) in zip(axes.T, growth.items(), strict=True):
        values = [row["value"] for row in rows]
        seconds = [row["cpu_seconds"] for row in rows]
        upper.loglog(values, seconds, "o-", color=charts.OURS, label="measured")
        if len(values) > 1:
            theory = GROWTH[what][1]
            line = [seconds[-1] * (v / values[-1]) ** theory for v in values]
            upper.loglog(values, line, "--", color=charts.GREY, label=f"exponent {theory:g}")
            upper.set_title(f"fitted {exponent(values, seconds):.2f}")
        upper.set_ylabel("CPU seconds")
        upper.legend(frameon=False)
        lower.semilogx(values, [row["peak_mb"] for row in rows], "o-", color=charts.OTHER)
        lower.set_ylim(bottom=0)
        lower.set_ylabel("peak MB")
        lower.set_xlabel(GROWTH[what][2])
        for axis in (upper, lower):
            axis.set_xticks(values, [f"{v:g}" for v in values])
            axis.set_xticks([], minor=True)
    charts.save(figure, path)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="not needed")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist" / "benchmarks" / "speed")
    parser.add_argument("--errors", type=Path, help="endtoend.csv (beside the output)")
    parser.add_argument("--largest", type=int, default=4096, help="px, of the resolutions (%(default)s)")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no measurement after so long")
    parser.add_argument("--quick", action="store_true", help="the smallest values only")
    parser.add_argument("--only", nargs="+", choices=SUITES)
    parser.add_argument("--case", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.case:
        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        what, *case = json.loads(options.case)
        print(json.dumps(engine_alone(*case) if what == "engine" else measured(what, *case)))
        return 0
    quick = options.quick
    parts = records.Parts(options.output, quick, options.minutes)
    wanted = options.only or SUITES
    size, rows, points, growth, about = 256 if quick else 1024, [], {}, {}, {}
    errors = options.errors or options.output.parent / "endtoend" / "endtoend.csv"
    errors = errors_of(errors) if errors.exists() else {}

    def take(name: str, cores: int, *case) -> dict | None:
        found = parts.get(name, lambda: in_process(cores, *case))
        if found:
            print(f"{name}: {found['cpu_seconds']:.1f} s CPU, {found['peak_mb']:.0f} MB", flush=True)
            rows.append({"measurement": name} | found)
        return found

    if "palette" in wanted and not quick:
        found = parts.get("palette", lambda: whole_palette(options.output.parent / "parts" / "palette"))
        if found:
            about["palette of 4 materials, 1024 px, balanced"] = found
            print(f"palette: {found['wall_seconds']:.1f} s wall, {found['cpu_seconds']:.1f} s CPU", flush=True)
    if "engine" in wanted:
        for quality, side, runs in ENGINE[:1] if quick else ENGINE:
            take(f"patch engine, {quality}, {side} px", 2, "engine", quality, side, runs)
    if "points" in wanted:
        for decomposer in endtoend.DECOMPOSERS:
            for quality in ("balanced",) if quick else endtoend.QUALITIES:
                name = f"ours, {quality}, {decomposer}"
                found = take(f"{name}, {size} px", 2, "point", size, quality, decomposer)
                if found and name in errors:
                    points[name] = found["cpu_seconds"], errors[name]
    if "growth" in wanted:
        for what, (values, theory, _) in GROWTH.items():
            growth[what] = []
            for value in QUICK[what] if quick else values:
                if what == "resolution" and value > options.largest:
                    continue
                found = take(f"{what} {value:g}", 2, what, value)
                if found:
                    growth[what].append({"value": value} | found)
            if len(growth[what]) > 1:
                fitted = exponent([g["value"] for g in growth[what]], [g["cpu_seconds"] for g in growth[what]])
                about[what] = {"exponent": round(fitted, 3), "theory": theory}
        growth = {what: found for what, found in growth.items() if found}
    if "cores" in wanted and not quick:
        for cores in (1, 2):
            take(f"{cores} cores", cores, "point", size)
    if not rows and not about:
        return 0
    about |= {"points": points, "front": measures.pareto(points) if points else [], "errors": errors}
    records.write(options.output, "speed", rows, about, parts)
    if points:
        others = {k: v for k, v in errors.items() if k in ("true class", "square crop", "mean colour")}
        chart_points(points, others, options.output / "speed")
    if growth:
        chart_growth(growth, options.output / "growth")
    return 0


if __name__ == "__main__":
    sys.exit(main())
