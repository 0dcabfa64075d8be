#!/usr/bin/env python3
"""End to end, the paper's protocol: known materials in a rendered scene, extracted from the photo, put back.

    python3 dev.py bench endtoend --data DATA          # about 25 minutes of one core
    python3 dev.py bench endtoend --quick              # procedural materials, one small scene

Scenes are those of `scenes.py`; the materials are CC0, of DATA's test split (all of polyhaven, every fourth of the
others), each once in six scenes. Every row gives for every part an SVBRDF and its scale; they are compared with the
truth at the truth's scale, and the scene is rendered again with them. Writes endtoend.csv (a row per part and method),
rerender.csv (per scene and method), endtoend.json, the charts and the sheet; and resemblance.csv, how near what is
extracted is to other materials of the same class.
"""

import argparse
import csv
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.benchmarks import charts, measures, records, scenes, svbrdf  # noqa: E402
from material_palette.benchmarks.baselines import largest_square  # noqa: E402
from material_palette.benchmarks.made import make_data  # noqa: E402
from material_palette.benchmarks.zero_shot import ZeroShot  # noqa: E402
from material_palette.core import decomposition, palette, perceptual  # noqa: E402
from material_palette.core.errors import PaletteError  # noqa: E402
from material_palette.core.exemplar import LUMINANCE  # noqa: E402
from material_palette.core.image import linear_from_srgb, srgb_from_linear  # noqa: E402
from material_palette.core.material import SVBRDF  # noqa: E402
from material_palette.core.region import Region  # noqa: E402
from material_palette.core.segmentation import segment  # noqa: E402
from material_palette.core.torus import resize  # noqa: E402

SIDE = 128  # px of a crop that is compared: one tile of the truth, about as many px as the photo shows of it
PAIRS = 4  # crops per map
RESOLUTION = 256  # px of extracted maps, at the photo's scale
TRUTH = 512  # px across a known material
ROUGHNESS = 0.6  # of rows without an opinion
FLAT = np.array([0, 0, 1], np.float32)
FOUND = 0.1  # IoU from which on an automatic region counts as a part's
QUALITIES = ("draft", "balanced", "best")
DECOMPOSERS = ("unet", "analytic")
OURS = "ours, balanced, unet"
EXPOSED = ", exposure known"  # rows of which the photo's exposure is right in the mean of its parts
CARD = ", grey card"  # rows that have a second photo, with a grey card in it
AGAIN = (OURS, "ours, auto regions", "true class", "other class", "mean colour", "square crop")  # rendered again
MEASURES = {
    "A": "albedo, ST-LPIPS",
    "N": "normals, ST-LPIPS",
    "R": "roughness, ST-LPIPS",
    "colour": "mean colour, CIEDE2000",
    "roughness": "mean roughness, error",
    "tilt": "relief: mean tilt, degrees of error",
}


@dataclass
class Found:
    """One answer for a part: maps, and their px per metre of the surface."""

    maps: SVBRDF
    density: float
    seconds: float = 0.0  # CPU
    warnings: tuple[str, ...] = ()


# ---------------------------------------------------------------- known materials


@dataclass
class Known:
    name: str
    kind: str  # its class
    read: object  # () -> SVBRDF, TRUTH px across


def read_maps(folder: Path) -> SVBRDF:
    """A material of the data folder, TRUTH px across, at its own shape."""

    def read(name: str) -> np.ndarray:
        pixels = cv2.imread(str(folder / f"{name}.jpg"))[..., ::-1].astype(np.float32) / 255
        size = TRUTH, round(TRUTH * pixels.shape[0] / pixels.shape[1])
        return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)

    normal = read("normal") * 2 - 1
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    metallic = read("metallic")[..., 0] if (folder / "metallic.jpg").exists() else None
    return SVBRDF(linear_from_srgb(read("basecolor")), normal, read("roughness")[..., 0], None, metallic)


def known_materials(data: Path) -> tuple[list[Known], list[Known]]:
    """(those that are put into scenes, all with exact normals) of the data folder."""
    with open(data / "INDEX.csv", newline="", encoding="utf-8") as file:
        index = {row["path"]: row for row in csv.DictReader(file)}
    training, held_out = svbrdf.split(data)
    every, tested = [], []
    for folder in sorted(training + held_out):
        row = index.get(folder.relative_to(data).as_posix())
        if row is None or folder.parent.name.endswith("-derived"):
            continue
        name = f"{folder.parent.name}/{folder.name}"
        every.append(Known(name, row["class"], lambda folder=folder: read_maps(folder)))
        if folder in held_out and row["licence"].startswith("CC0") and "stylised" not in row["class"]:
            tested.append(every[-1])
    return tested, every


def cast(tested: list[Known], number: int) -> dict[str, Known]:
    """The materials of a scene's parts: a pass through all of them in mixed order, then another order."""
    kind = tuple(scenes.KINDS)[number % len(scenes.KINDS)]
    per_pass = max(1, len(tested) // 4)
    order = np.random.default_rng(number // per_pass).permutation(len(tested))
    first = number % per_pass * 4
    return {part: tested[order[(first + i) % len(tested)]] for i, part in enumerate(scenes.KINDS[kind])}


def by_class(known: Known, every: list[Known]) -> tuple[list[Known], list[Known]]:
    """The other materials of its class, and those of other classes."""
    same = [m for m in every if m.kind == known.kind and m.name != known.name]
    return same, [m for m in every if m.kind != known.kind]


def tile_of(maps: SVBRDF, across: float) -> tuple[float, float]:
    """Metres of a tile across and up."""
    h, w = maps.albedo.shape[:2] if maps.albedo.ndim == 3 else (1, 1)
    return across, across * h / w


# ---------------------------------------------------------------- rows

_kept: dict[str, np.ndarray] = {}


def _keep(texture: np.ndarray, progress) -> SVBRDF:
    _kept["texture"] = texture
    return SVBRDF(texture, FLAT, ROUGHNESS)


decomposition.DECOMPOSERS["kept"] = _keep  # the texture, so that every decomposer sees the same one


def _quiet(fraction: float, message: str) -> None:
    pass


def extracted(photo, mask, part, quality, decomposers, view, resolution, seed=0, card=None):
    """The material that the product makes of a region, and by decomposer its full maps and their CPU seconds; card is
    what the photo shows of a grey card."""
    light = {"white_balance": "card", "grey_card": card} if card else {}
    settings = palette.Settings(quality=quality, decomposer="kept", resolution=resolution, seed=seed, **light)
    _kept.clear()
    start = time.process_time()
    material = palette.extract_material(photo, Region(part, mask), settings, _quiet, view)
    base = time.process_time() - start
    found = {}
    for name in decomposers:
        start, maps = time.process_time(), material.svbrdf
        if "texture" in _kept:
            maps = decomposition.decompose(_kept["texture"], _quiet, name)
        found[name] = maps, base + time.process_time() - start
    return material, found


def measured(photo, mask, shown, part, quality, decomposers, view, resolution, card=None) -> dict[str, Found]:
    """By decomposer what is extracted, at the scale that shown and part tell."""
    material, found = extracted(photo, mask, part, quality, decomposers, view, resolution, card=card)
    homography = material.rectification.get("homography")
    density = scenes.texels_per_metre(shown, part, None if homography is None else np.array(homography))
    warnings = tuple(material.warnings)
    return {name: Found(maps, density, seconds, warnings) for name, (maps, seconds) in found.items()}


def rows_of(number, shown, part, tile, truth: Known, every, view, auto, card, options, random) -> dict[str, Found]:
    """All answers for one part, by row; a row that fails says so and is missing."""
    photo, mask = shown.photo, shown.masks[part]
    rows: dict[str, Found] = {}

    def take(label, mask, quality, decomposers, card=None):
        try:
            found = measured(photo, mask, shown, part, quality, decomposers, view, options.resolution, card)
            rows.update({label.format(name): one for name, one in found.items()})
        except PaletteError as error:
            print(f"{part}, {label}: {error}")

    for quality in QUALITIES if number < options.presets else QUALITIES[1:2]:
        take(f"ours, {quality}, {{}}", mask, quality, DECOMPOSERS)
    take("ours, balanced, {}" + CARD, mask, "balanced", DECOMPOSERS[:1], card)
    if auto is not None:
        take("ours, auto regions", auto, "balanced", DECOMPOSERS[:1])
    same, other = by_class(truth, every)
    for label, choices in (("true class", same), ("other class", other)):
        for i in range(min(2, len(choices))):
            chosen = choices[int(random.integers(len(choices)))].read()
            rows[label if i == 0 else f"{label} again"] = Found(chosen, chosen.albedo.shape[1] / tile)
    start = time.process_time()
    mean = photo[mask].mean(0).astype(np.float32)
    rows["mean colour"] = Found(SVBRDF(mean, FLAT, ROUGHNESS), 1.0, time.process_time() - start)
    start = time.process_time()
    crop = np.ascontiguousarray(photo[largest_square(mask)])
    density = scenes.texels_per_metre(shown, part)
    rows["square crop"] = Found(SVBRDF(crop, FLAT, ROUGHNESS), density, time.process_time() - start)
    lit = np.clip(crop * (np.float32(scenes.GREY_CARD) / np.float32(card)), 0, 1)
    rows["square crop" + CARD] = Found(SVBRDF(lit, FLAT, ROUGHNESS), density)
    return rows


# ---------------------------------------------------------------- comparing


def pictures(maps: SVBRDF, scale: float) -> list[np.ndarray]:
    """A, N and R as pictures (H, W, 3) in 0 to 1, resized by scale; constants are (1, 1, 3)."""
    found = []
    for value, encode in (
        (maps.albedo, lambda x: srgb_from_linear(np.clip(x, 0, 1))),
        (maps.normal, lambda x: x / 2 + 0.5),
        (maps.roughness, lambda x: np.repeat(x[..., None], 3, -1) if x.ndim == 2 else np.broadcast_to(x, 3)),
    ):
        x = np.asarray(encode(np.asarray(value, np.float32)), np.float32)
        if x.ndim == 1:
            x = x.reshape(1, 1, 3)
        else:
            x = np.clip(resize(x, tuple(max(1, round(n * scale)) for n in x.shape[:2])), 0, 1)
        found.append(x)
    return found


def tilt(maps: SVBRDF) -> float:
    """Mean angle in degrees between normals and the surface's own."""
    z = np.asarray(maps.normal, np.float32)[..., 2]
    return float(np.degrees(np.arccos(np.clip(z, -1, 1))).mean())


def mean_colour(maps: SVBRDF) -> np.ndarray:
    return np.asarray(maps.albedo, np.float32).reshape(-1, 3).mean(0)


def compare(truth: SVBRDF, tile: float, found: Found, seed: int) -> dict[str, float]:
    """The distances of MEASURES: maps by PAIRS of crops of one tile's size, each anywhere."""
    random = np.random.default_rng(seed)
    theirs = pictures(truth, SIDE / truth.albedo.shape[1])
    ours = pictures(found.maps, SIDE / (tile * found.density))
    row = {}
    places = random.random((PAIRS, 2, 2))
    for name, first, second in zip("ANR", theirs, ours, strict=True):
        pairs = [(measures.window(first, a, SIDE), measures.window(second, b, SIDE)) for a, b in places]
        row[name] = float(np.mean([perceptual.distance(*pair) for pair in pairs]))
    return row | compare_means(truth, found.maps)


def compare_means(truth: SVBRDF, maps: SVBRDF) -> dict[str, float]:
    """Those of MEASURES that no scale changes."""
    lab = [svbrdf.cielab(mean_colour(m).reshape(1, 1, 3))[0, 0] for m in (truth, maps)]
    return {
        "colour": float(svbrdf.ciede2000(*lab)),
        "roughness": float(abs(np.mean(truth.roughness) - np.mean(maps.roughness))),
        "tilt": abs(tilt(truth) - tilt(maps)),
    }


def compare_pictures(first: np.ndarray, second: np.ndarray) -> dict[str, float]:
    """Of two photos linear: FLIP where flip-evaluator is installed, ST-LPIPS, PSNR of the encoded ones."""
    first, second = (srgb_from_linear(x).astype(np.float32) for x in (first, second))
    row = {
        "st_lpips": perceptual.distance(first, second),
        "psnr": float(-10 * np.log10(np.mean((first - second) ** 2) + 1e-10)),
    }
    try:
        import flip_evaluator

        row["flip"] = float(flip_evaluator.evaluate(first, second, "LDR", applyMagma=False)[1])
    except ImportError:
        pass
    return row


def add_exposed(row: str, answers: dict[str, dict[str, Found]], truth: dict[str, SVBRDF]) -> None:
    """Add a row whose base colours have the factor, one for the scene, that makes them right in the mean of its parts:
    what is left of the error when something tells the exposure."""
    parts = [part for part, found in answers.items() if row in found]
    level = {part: float(mean_colour(answers[part][row].maps) @ LUMINANCE) for part in parts}
    true = {part: float(mean_colour(truth[part]) @ LUMINANCE) for part in parts}
    gain = np.exp(np.mean([np.log(max(true[part], 1e-3) / max(level[part], 1e-3)) for part in parts]))
    for part in parts:
        found = answers[part][row]
        maps = replace(found.maps, albedo=np.clip(found.maps.albedo * np.float32(gain), 0, 1))
        answers[part][row + EXPOSED] = replace(found, maps=maps)


def automatic(photo: np.ndarray, parts: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """By part, given by its true mask, the automatic region that fits it best, where one does, and all IoUs."""
    regions = segment(photo)
    masks, ious = {}, {}
    for part, mask in parts.items():
        scores = [(region.mask & mask).sum() / (region.mask | mask).sum() for region in regions]
        best = int(np.argmax(scores))
        ious[part] = float(scores[best])
        if scores[best] >= FOUND:
            # what is known of the surface's scale is known within the part
            masks[part] = regions[best].mask
    return masks, ious


# ---------------------------------------------------------------- a scene


def photographed(number: int, tested: list[Known], options):
    """A scene's kind, its known materials and their maps by part, the scene dressed in them, and its photo."""
    torch.set_num_threads(1)
    kind = tuple(scenes.KINDS)[number % len(scenes.KINDS)]
    parts = cast(tested, number)
    truth = {part: known.read() for part, known in parts.items()}
    scene = scenes.Scene(kind, number, options.size, options.samples)
    scene.dress(truth, {part: tile_of(maps, scenes.KINDS[kind][part]) for part, maps in truth.items()})
    return kind, parts, truth, scene, scene.show()


def run_scene(number: int, tested, every, options, keep: Path) -> dict:
    """All rows of all parts of one scene, and the scene rendered again with some of them."""
    kind, parts, truth, scene, shown = photographed(number, tested, options)
    across = scenes.KINDS[kind]
    tiles = {part: tile_of(maps, across[part]) for part, maps in truth.items()}
    view = palette.rectification.look(shown.photo)
    card = scene.show_card(shown.gain)
    auto, ious = automatic(shown.photo, shown.masks) if options.auto else ({}, {})
    result, answers = {"kind": kind, "parts": [], "again": []}, {}
    for i, part in enumerate(shown.masks):
        random = np.random.default_rng([number, i])
        found = rows_of(
            number, shown, part, across[part], parts[part], every, view, auto.get(part), card, options, random
        )
        answers[part] = found
        print(f"  {part}: {parts[part].name}, {len(found)} rows", flush=True)
    for row in (OURS, "square crop"):
        add_exposed(row, answers, truth)
    for i, (part, found) in enumerate(answers.items()):
        for row, answer in found.items():
            facts = {"scene": f"{number}_{kind}", "part": part, "material": parts[part].name, "row": row}
            facts |= compare(truth[part], across[part], answer, 1000 * number + i)
            facts |= {"cpu_seconds": answer.seconds, "pixels": int(shown.masks[part].sum())}
            facts |= {"auto_iou": ious.get(part), "warnings": "; ".join(answer.warnings)}
            result["parts"].append(facts)
    share, samples = scenes.AGAIN
    original = scenes.exposed(scene.render(share, samples), shown.gain)
    small = original.shape[1], original.shape[0]
    views = [cv2.resize(shown.photo, small, interpolation=cv2.INTER_AREA)]
    for row in AGAIN:
        maps, repeats = dict(truth), dict(tiles)
        if not any(row in found for found in answers.values()):
            continue
        for part, found in answers.items():
            answer = found.get(row) or found["mean colour"]
            maps[part] = answer.maps
            # the maps are tiles of their own size
            h, w = answer.maps.albedo.shape[:2] if answer.maps.albedo.ndim == 3 else (1, 1)
            repeats[part] = w / answer.density, h / answer.density
        scene.dress(maps, repeats)
        again = scenes.exposed(scene.render(share, samples), shown.gain)
        result["again"].append({"scene": f"{number}_{kind}", "row": row} | compare_pictures(original, again))
        views.append(again)
    keep.mkdir(parents=True, exist_ok=True)
    strip = np.concatenate([srgb_from_linear(view) for view in views], 1)[..., ::-1]
    cv2.imwrite(str(keep / f"{number}_{kind}.png"), np.rint(strip * 255).astype(np.uint8))
    return result


# ---------------------------------------------------------------- resemblance


def resembling(number: int, tested, every, options) -> list[dict]:
    """The paper's other table, on a scene's photo: distances of maps to those of a random material of their class.

    Rows: ours from true masks and from automatic ones; the known material itself (the least that can be asked for);
    ours against a material of another class (no resemblance at all). With CLIP's weights also the place at which it
    puts the class of a tile of the base colour.
    """
    classify = ZeroShot(options.clip, sorted({known.kind for known in every})) if options.clip else None
    kind, parts, truth, _, shown = photographed(number, tested, options)
    across = scenes.KINDS[kind]
    view, found = palette.rectification.look(shown.photo), []
    auto = automatic(shown.photo, shown.masks)[0] if options.auto else {}
    for i, (part, mask) in enumerate(shown.masks.items()):
        random, known, tile = np.random.default_rng([number, i, 1]), parts[part], across[part]
        alike, others = by_class(known, every)
        if not alike:
            continue
        same = alike[int(random.integers(len(alike)))].read()
        other = others[int(random.integers(len(others)))].read()
        rows = {"the material itself": (same, Found(truth[part], truth[part].albedo.shape[1] / tile))}
        for label, region in (("true masks", mask), ("automatic", auto.get(part))):
            if region is None:
                continue
            try:
                ours = measured(
                    shown.photo, region, shown, part, "balanced", DECOMPOSERS[:1], view, options.resolution
                )["unet"]
            except PaletteError as error:
                print(f"{part}, {label}: {error}")
                continue
            rows[f"ours, {label}"] = same, ours
            if label == "true masks":
                rows["ours, other class"] = other, ours
        for row, (reference, answer) in rows.items():
            facts = {"scene": f"{number}_{kind}", "part": part, "material": known.name, "class": known.kind, "row": row}
            if classify and "other" not in row:
                albedo = pictures(answer.maps, 1.0)[0]
                facts["clip_rank"] = classify.rank(albedo, known.kind)
            found.append(facts | compare(reference, tile, answer, 1000 * number + i))
    return found


# ---------------------------------------------------------------- results


def merged(row: str) -> str:
    return row.removesuffix(" again")


def table(rows: list[dict], again: list[dict]) -> str:
    """Markdown: medians over the parts, and over the scenes."""
    lines = [
        "| row | parts | " + " | ".join(MEASURES.values()) + " | re-rendered: FLIP | ST-LPIPS | PSNR, dB | CPU s |"
    ]
    lines.append("|---" * (len(MEASURES) + 6) + "|")
    for name in dict.fromkeys(merged(r["row"]) for r in rows):
        own = [r for r in rows if merged(r["row"]) == name]
        cells = [f"{np.median([r[key] for r in own]):.{1 if key in ('colour', 'tilt') else 3}f}" for key in MEASURES]
        back = [r for r in again if r["row"] == name]
        for key, digits in (("flip", 3), ("st_lpips", 3), ("psnr", 1)):
            values = [r[key] for r in back if key in r]
            cells.append(f"{np.median(values):.{digits}f}" if values else "")
        cells.append(f"{np.median([r['cpu_seconds'] for r in own]):.1f}" if name.startswith("ours") else "")
        lines.append(f"| {name} | {len({(r['scene'], r['part']) for r in own})} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def duels(rows: list[dict]) -> dict:
    """Per measure and baseline: share of the parts on which OURS is nearer to the truth, and the ratio of medians."""
    found = {}
    for baseline in ("true class", "other class", "mean colour", "square crop"):
        pairs = []
        for ours in (r for r in rows if r["row"] == OURS):
            theirs = [
                r for r in rows
                if merged(r["row"]) == baseline and (r["scene"], r["part"]) == (ours["scene"], ours["part"])
            ]  # fmt: skip
            if theirs:
                pairs.append([(ours[key], float(np.mean([t[key] for t in theirs]))) for key in MEASURES])
        values = np.array(pairs)
        if len(values):
            found[baseline] = {
                key: {
                    "parts": len(values),
                    "nearer": round(float(np.mean(values[:, i, 0] < values[:, i, 1])), 3),
                    "ours": round(float(np.median(values[:, i, 0])), 4),
                    "theirs": round(float(np.median(values[:, i, 1])), 4),
                }
                for i, key in enumerate(MEASURES)
            }
    return found


def resemblance_table(rows: list[dict]) -> str:
    """Markdown: medians over the parts."""
    clip = any("clip_rank" in r for r in rows)
    lines = ["| row | parts | A | N | R |" + " CLIP top-1 | top-5 |" * clip, "|---" * (5 + 2 * clip) + "|"]
    for name in dict.fromkeys(r["row"] for r in rows):
        own = [r for r in rows if r["row"] == name]
        cells = " | ".join(f"{np.median([r[key] for r in own]):.3f}" for key in "ANR")
        if clip:
            ranks = np.array([r["clip_rank"] for r in own if "clip_rank" in r])
            cells += " | " + " | ".join(f"{np.mean(ranks <= n):.3f}" if len(ranks) else "" for n in (1, 5))
        lines.append(f"| {name} | {len(own)} | {cells} |")
    return "\n".join(lines)


def write(results: list[dict], parts: records.Parts, keep: Path, options) -> None:
    rows = [row for result in results for row in result["parts"]]
    again = [row for result in results for row in result["again"]]
    folder = options.output
    about = {
        "scenes": len(results), "size": options.size, "samples": options.samples, "resolution": options.resolution,
        "crops": [PAIRS, SIDE], "duels": duels(rows), "table": table(rows, again).splitlines(),
    }  # fmt: skip
    records.write(folder, "endtoend", rows, about, parts)
    records.write(folder, "rerender", again, {}, parts)
    print(table(rows, again))
    panels = {title: {} for title in MEASURES.values()}
    for row in rows:
        for key, title in MEASURES.items():
            panels[title].setdefault(merged(row["row"]), []).append(row[key])
    for key, title in (("flip", "scene rendered again, FLIP"), ("st_lpips", "scene rendered again, ST-LPIPS")):
        values = {}
        for row in again:
            if key in row:
                values.setdefault(row["row"], []).append(row[key])
        if values:
            panels[title] = values
    charts.bars(panels, folder / "endtoend")
    strips = [cv2.imread(str(path)) for path in sorted(keep.glob("*.png"))]
    if strips:
        width = min(strip.shape[1] for strip in strips)
        strips = [strip[:, :width] for strip in strips[:6]]
        sheet = cv2.resize(np.concatenate(strips), None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / "endtoend.jpg"), sheet, [cv2.IMWRITE_JPEG_QUALITY, 85])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with INDEX.csv and pbr/; without: procedural materials")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist" / "benchmarks" / "endtoend")
    parser.add_argument("--scenes", type=int, default=6, help="how many (%(default)s use every material once)")
    parser.add_argument(
        "--presets", type=int, default=6, help="scenes with all presets, not `balanced` alone (%(default)s)"
    )
    parser.add_argument("--clip", type=Path, metavar="DIR", help="CLIP's weights, for its classes of what is extracted")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no scene after so long; go on later")
    parser.add_argument("--quick", action="store_true", help="one small scene, one preset")
    options = parser.parse_args(arguments)
    quick = options.quick
    tested, every = known_materials(options.data or make_data(ROOT / "dist" / "benchmarks" / "data"))
    options.presets = 0 if quick else options.presets
    options.size, options.samples = ((400, 300), 8) if quick else ((scenes.WIDTH, scenes.HEIGHT), scenes.SAMPLES)
    options.auto, options.resolution = not quick, RESOLUTION
    parts = records.Parts(options.output, quick, options.minutes)
    keep = parts.folder / "pictures"
    results = []
    for number in range(1 if quick else options.scenes):
        print(f"scene {number}", flush=True)
        found = parts.get(f"scene{number}", lambda number=number: run_scene(number, tested, every, options, keep))
        if found is not None:
            results.append(found)
    if results:
        write(results, parts, keep, options)
    resemblance = []
    for number in range(0 if quick else options.scenes):
        make = partial(resembling, number, tested, every, options)
        resemblance += parts.get(f"resemblance{number}", make) or []
    if resemblance:
        records.write(
            options.output, "resemblance", resemblance, {"table": resemblance_table(resemblance).splitlines()}, parts
        )
        print(resemblance_table(resemblance))
    return 0


if __name__ == "__main__":
    sys.exit(main())
