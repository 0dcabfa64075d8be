#!/usr/bin/env python3
"""Known materials in scenes that are not ours: DATA/scenes, photos with true masks and the materials' names.

    python3 dev.py bench rendered --data DATA -o DIR        # 45 minutes of one core; goes on where it was stopped
    python3 dev.py bench rendered --quick                   # one photo of two procedural materials

Rows and distances are those of `endtoend`. How large a metre is in these photos nobody says, so every row is compared
with the truth at that of DENSITIES at which its albedo is nearest to it. DATA/scenes/<scene>/ holds photo.png,
masks/<part>.png and truth.json: {part: {"material": folder below pbr/}}. Writes rendered.csv (a row per part, row and
seed), rendered.json with the table, the chart, and the sheet: of every part the truth, ours and the square crop.
"""

import argparse
import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.benchmarks import charts, endtoend, measures, records, svbrdf  # noqa: E402
from material_palette.benchmarks.baselines import largest_square  # noqa: E402
from material_palette.benchmarks.collage import read_scene  # noqa: E402
from material_palette.benchmarks.endtoend import FLAT, MEASURES, OURS, ROUGHNESS, SIDE  # noqa: E402
from material_palette.benchmarks.made import make_data  # noqa: E402
from material_palette.core import palette, perceptual  # noqa: E402
from material_palette.core.errors import PaletteError  # noqa: E402
from material_palette.core.image import srgb_from_linear  # noqa: E402
from material_palette.core.material import SVBRDF  # noqa: E402

RESOLUTION = 512  # px of extracted maps, at the photo's scale
DENSITIES = 2.0 ** np.arange(6, 9.01, 0.5)  # px of a map to a tile of the truth


class Truth:
    """A known material, and what is seen of it in PAIRS crops of each map."""

    def __init__(self, maps: SVBRDF, seed: int):
        self.maps, self.places = maps, np.random.default_rng(seed).random((endtoend.PAIRS, 2, 2))
        pictures = endtoend.pictures(maps, SIDE / maps.albedo.shape[1])
        self.seen = {name: self._features(picture, 0) for name, picture in zip("ANR", pictures, strict=True)}

    def _features(self, picture: np.ndarray, of: int) -> list:
        return [perceptual.features(measures.window(picture, at[of], SIDE)) for at in self.places]

    def distance(self, name: str, picture: np.ndarray) -> float:
        """Shift-tolerant LPIPS of map `name` to a picture of it at the truth's scale, mean over the crops."""
        pairs = zip(self.seen[name], self._features(picture, 1), strict=True)
        return float(np.mean([perceptual.between(*pair) for pair in pairs]))

    def compare(self, maps: SVBRDF) -> tuple[dict[str, float], float]:
        """The distances of MEASURES at the one of DENSITIES at which albedo is nearest, and that."""
        found = []
        for density in DENSITIES if maps.albedo.ndim > 1 else (1.0,):
            pictures = endtoend.pictures(maps, SIDE / density)
            found.append((self.distance("A", pictures[0]), density, pictures))
        albedo, density, pictures = min(found, key=lambda one: one[0])
        row = {"A": albedo, "N": self.distance("N", pictures[1]), "R": self.distance("R", pictures[2])}
        return row | endtoend.compare_means(self.maps, maps), density


def rows_of(photo, part: str, mask, auto, truth, every, view, seed: int) -> dict[str, SVBRDF]:
    """The answers for one part, by row, for later seeds than the first a few; one that fails says so and is missing."""
    rows = {
        "mean colour": SVBRDF(photo[mask].mean(0).astype(np.float32), FLAT, ROUGHNESS),
        "square crop": SVBRDF(np.ascontiguousarray(photo[largest_square(mask)]), FLAT, ROUGHNESS),
    }

    def take(label, mask, quality, decomposers):
        try:
            _, found = endtoend.extracted(photo, mask, part, quality, decomposers, view, RESOLUTION, seed)
            rows.update({label.format(name): maps for name, (maps, _) in found.items()})
        except PaletteError as error:
            print(f"{part}, {label}: {error}")

    take("ours, balanced, {}", mask, "balanced", endtoend.DECOMPOSERS[: 1 if seed else None])
    if seed:
        return rows
    for quality in ("draft", "best"):
        take(f"ours, {quality}, {{}}", mask, quality, endtoend.DECOMPOSERS[:1])
    if auto is not None:
        take("ours, auto regions", auto, "balanced", endtoend.DECOMPOSERS[:1])
    random = np.random.default_rng([seed, len(part), int(mask.sum())])
    for label, choices in zip(("true class", "other class"), endtoend.by_class(truth, every), strict=True):
        if choices:
            rows[label] = choices[int(random.integers(len(choices)))].read()
    return rows


def run_scene(folder: Path, data: Path, seed: int, keep: Path) -> list[dict]:
    """All rows of all parts of a scene, for one seed; of the first the pictures for the sheet."""
    torch.set_num_threads(1)
    photo, masks, names = read_scene(folder)
    every = endtoend.known_materials(data)[1]
    known = {one.name: one for one in every}
    held_out = {f"{path.parent.name}/{path.name}" for path in svbrdf.split(data)[1]}
    view = palette.rectification.look(photo)
    auto, ious = endtoend.automatic(photo, masks) if seed == 0 else ({}, {})
    result, strips = [], []
    for i, (part, mask) in enumerate(masks.items()):
        name = names[part]
        truth = Truth(known[name].read(), 1000 * seed + i)
        tiles = {"truth": tile(truth.maps, truth.maps.albedo.shape[1])}
        for row, answer in rows_of(photo, part, mask, auto.get(part), known[name], every, view, seed).items():
            found, density = truth.compare(answer)
            facts = {"scene": folder.name, "part": part, "material": name, "held_out": name in held_out}
            facts |= {"row": row, "seed": seed, "auto_iou": ious.get(part), "density": density}
            result.append(facts | found)
            tiles[row] = tile(answer, density)
        strips.append(np.concatenate([tiles[row] for row in ("truth", OURS, "square crop") if row in tiles], 1))
        print(f"  {folder.name}, {part}: {name}", flush=True)
    if seed == 0:
        keep.mkdir(parents=True, exist_ok=True)
        width = round(photo.shape[1] * SIDE / photo.shape[0])
        shown = cv2.resize(srgb_from_linear(np.clip(photo, 0, 1)).astype(np.float32), (width, SIDE))
        strip = np.concatenate([shown, *(np.pad(s, ((0, 0), (8, 0), (0, 0))) for s in strips)], 1)
        cv2.imwrite(str(keep / f"{folder.name}.png"), np.rint(strip[..., ::-1] * 255).astype(np.uint8))
    return result


def tile(maps: SVBRDF, density: float) -> np.ndarray:
    """A tile of the base colour as a picture (SIDE, SIDE, 3), of maps with so many px to it."""
    return measures.window(endtoend.pictures(maps, SIDE / density)[0], np.zeros(2), SIDE)


def table(rows: list[dict]) -> list[str]:
    """Markdown: medians over the parts of medians over seeds; on how many parts albedo is nearer than the crop's."""
    parts: dict[str, dict[tuple, dict]] = {}
    for name in dict.fromkeys(row["row"] for row in rows):
        own = [row for row in rows if row["row"] == name]
        for key in dict.fromkeys((row["scene"], row["part"]) for row in own):
            same = [row for row in own if (row["scene"], row["part"]) == key]
            parts.setdefault(name, {})[key] = {m: float(np.median([row[m] for row in same])) for m in MEASURES}
    crop = parts.get("square crop", {})
    lines = ["| row | parts | " + " | ".join(MEASURES.values()) + " | albedo nearer than the crop's |"]
    lines.append("|---" * (len(MEASURES) + 3) + "|")
    for name, found in parts.items():
        cells = []
        for key in MEASURES:
            cells.append(f"{np.median([one[key] for one in found.values()]):.{1 if key in ('colour', 'tilt') else 3}f}")
        nearer = sum(one["A"] < crop[key]["A"] for key, one in found.items() if key in crop)
        lines.append(f"| {name} | {len(found)} | " + " | ".join(cells) + f" | {nearer} |")
    return lines


def write(rows: list[dict], parts: records.Parts, keep: Path, output: Path) -> None:
    held_out = [row for row in rows if row["held_out"]]
    about = {
        "scenes": len({row["scene"] for row in rows}), "seeds": len({row["seed"] for row in rows}),
        "resolution": RESOLUTION, "crops": [endtoend.PAIRS, SIDE], "densities": DENSITIES.round(1).tolist(),
        "table": table(rows), "table_held_out": table(held_out),
    }  # fmt: skip
    records.write(output, "rendered", rows, about, parts)
    print("\n".join([*about["table"], "materials held out:", *about["table_held_out"]]))
    panels = {title: {} for title in MEASURES.values()}
    for row in rows:
        for key, title in MEASURES.items():
            panels[title].setdefault(row["row"], []).append(row[key])
    charts.bars(panels, output / "rendered")
    strips = [cv2.imread(str(path)) for path in sorted(keep.glob("*.png"))]
    if strips:
        width = max(strip.shape[1] for strip in strips)
        strips = [np.pad(strip, ((0, 8), (0, width - strip.shape[1]), (0, 0))) for strip in strips]
        cv2.imwrite(str(output / "rendered.jpg"), np.concatenate(strips), [cv2.IMWRITE_JPEG_QUALITY, 88])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with INDEX.csv, pbr/ and scenes/; without: a procedural one")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist" / "benchmarks" / "rendered")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no scene after so long; go on later")
    parser.add_argument("--quick", action="store_true", help="one scene, few rows")
    options = parser.parse_args(arguments)
    data = options.data or make_data(ROOT / "dist" / "benchmarks" / "data")
    folders = [path.parent for path in sorted((data / "scenes").glob("*/truth.json"))]
    if not folders:
        raise SystemExit(f"no scene below '{data / 'scenes'}': <scene>/photo.png, masks/<part>.png and truth.json")
    parts = records.Parts(options.output, options.quick, options.minutes)
    keep, rows = parts.folder / "pictures", []
    for seed in (1,) if options.quick else range(options.seeds):
        for folder in folders[:1] if options.quick else folders:
            make = partial(run_scene, folder, data, seed, keep)
            rows += parts.get(f"{folder.name}-{seed}", make) or []
    if rows:
        write(rows, parts, keep, options.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
