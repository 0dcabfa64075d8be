#!/usr/bin/env python3
"""Regions against true masks: `auto` and `pick` beside their opponents, on the same photos in one run.

    python benchmarks/segmentation.py --data DATA -o benchmarks/results/segmentation/     about 40 minutes on one core
    python benchmarks/segmentation.py --data DATA -o DIR --only photos auto     of: photos auto stability pick text time
    python benchmarks/segmentation.py --data DATA -o DIR --quick

DATA is a folder with INDEX.csv, pbr/, textures/, scenes/ and photos/. Collages are made of textures of the test split,
which nothing was fitted on; no scene and none of its materials was either. Of real photos, patches are labelled by hand
(photos.json; the later ones when features and merging were chosen): what is measured is which patches are together,
not where borders lie. Text is sought in every photo and texture, where hardly any is, and in signs drawn into the
photos. Writes segmentation.csv, a row per measure, photo and method, as it goes (a second call goes on
where the first ended), segmentation.json, charts and sheet.jpg.
"""

import argparse
import csv
import json
import resource
import subprocess
import sys
import time
from collections import defaultdict
from itertools import zip_longest
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.benchmarks import charts, records  # noqa: E402
from material_palette.benchmarks import regions as measures  # noqa: E402
from material_palette.benchmarks.collage import collage, photos, scenes, sources  # noqa: E402
from material_palette.core.errors import PaletteError  # noqa: E402
from material_palette.core.image import linear_from_srgb, read_photo, srgb_from_linear  # noqa: E402
from material_palette.core.segmentation import REGIONS, segment  # noqa: E402
from material_palette.core.segmentation.features import DESCRIBED_PIXELS, describe  # noqa: E402
from material_palette.core.segmentation.pick import Click, select  # noqa: E402
from material_palette.core.segmentation.text import text_mask  # noqa: E402

COLLAGES = 12
SHOWN = ("kodak_", "azure_")  # photos that may be shown
KINDS = {"scene": "scenes", "collage": "collages", "photo": "real photos", "later": "real photos, later"}
PARTS = ("photos", "auto", "stability", "pick", "text", "time", "sheet")
SIGNS = ("Museum of Modern Art", "BAKERY & CAFE", "No parking here", "Hotel Europa 1928", "Joiner and Glazier")


def ours(pixels: np.ndarray, count: int) -> np.ndarray:
    labels = np.full(pixels.shape[:2], -1)
    try:
        for index, region in enumerate(segment(pixels, regions=REGIONS)):
            labels[region.mask] = index
    except PaletteError:
        pass
    return labels


OURS = "ours, auto"
WHOLE = {OURS: ours, **measures.WHOLE}


def changed(pixels: np.ndarray, truth: np.ndarray):
    """(name, photo, its labels): what cameras and files do to a photo."""
    encoded = np.round(255 * np.clip(srgb_from_linear(pixels), 0, 1)).astype(np.uint8)
    jpeg = cv2.imdecode(cv2.imencode(".jpg", encoded, [cv2.IMWRITE_JPEG_QUALITY, 30])[1], cv2.IMREAD_COLOR)
    yield "JPEG 30", linear_from_srgb(jpeg / np.float32(255)), truth
    noise = np.random.default_rng(0).normal(0, 0.03, encoded.shape)
    yield "noise 3 %", linear_from_srgb(np.clip(encoded / 255 + noise, 0, 1)), truth
    yield "blur 1.5 px", cv2.GaussianBlur(pixels, (0, 0), 1.5), truth
    for stops in (-2, 2):  # with what 8 bits leave of it
        levels = 255 * srgb_from_linear(np.clip(pixels * np.float32(2.0**stops), 0, 1))
        exposed = linear_from_srgb(np.round(levels) / np.float32(255))
        yield f"{stops:+} EV", exposed, truth
    yield "+2 EV, where not white", exposed, without(truth, (exposed >= 1).all(-1))
    for scale in (0.5, 2):
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        size = {"dsize": None, "fx": scale, "fy": scale}
        resized = cv2.resize(pixels, interpolation=method, **size).clip(0)
        labels = cv2.resize(truth.astype(np.int16), interpolation=cv2.INTER_NEAREST, **size)
        yield f"scale x{scale}", resized, labels.astype(int)


def without(truth: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """truth (H, W), unknown in the pixels `lost` (H, W) bool; of materials that then cover 1 % of the photo."""
    kept = np.where(lost, -1, truth)
    large = np.bincount(kept.ravel() + 1, minlength=truth.max() + 2)[1:] >= 0.01 * truth.size
    number = np.append(np.where(large, np.cumsum(large) - 1, -1), -1)  # the last is for what is unknown
    return number[kept]


class Table:
    """Rows on disk: (part, photo, method, measure, value); what is there is not measured again."""

    def __init__(self, path: Path):
        self.path, self.rows = path, []
        if path.exists():
            with path.open(newline="", encoding="utf-8") as file:
                self.rows = [tuple(row) for row in csv.reader(file)][1:]
        self.done = {row[:3] for row in self.rows}

    def add(self, part: str, photo: str, method: str, **values: float) -> None:
        new = [(part, photo, method, measure, f"{value:.5g}") for measure, value in values.items()]
        first = not self.path.exists()
        with self.path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            if first:
                writer.writerow(("part", "photo", "method", "measure", "value"))
            writer.writerows(new)
        self.rows += new
        self.done.add((part, photo, method))

    def summary(self) -> dict:
        """Median, quartiles and mean over photos, by part, kind of photo, method and measure."""
        found = defaultdict(list)
        clean = {row[1]: float(row[4]) for row in self.rows if row[0] == "auto" and row[2:4] == (OURS, "iou")}
        for part, photo, method, measure, value in self.rows:
            kind = photo.split("_")[0]
            found[part, kind, method, measure].append(float(value))
            if part == "stability" and clean.get(photo):
                found[part, kind, method, "of clean"].append(float(value) / clean[photo])
        return {
            " | ".join(key): {
                "median": round(float(np.median(values)), 4),
                "quartiles": [round(float(q), 4) for q in np.quantile(values, (0.25, 0.75))],
                "mean": round(float(np.mean(values)), 4),
                "least": round(float(np.min(values)), 4),
                "n": len(values),
            }
            for key, values in found.items()
        }


def real_photos(table: Table, photos: list) -> None:
    for photo in photos:
        for name, method in WHOLE.items():
            if ("photos", photo.name, name) not in table.done and method is not measures.grabcut:
                labels = method(photo.pixels, REGIONS)
                truth = photo.labels, photo.scored
                table.add(
                    "photos",
                    photo.name,
                    name,
                    iou=measures.mean_iou(labels, *truth),
                    pure=measures.pure(labels, *truth),
                )


def whole_photos(table: Table, photos: list) -> None:
    for photo in photos:
        count = photo.labels.max() + 1
        for name, method in WHOLE.items():
            if ("auto", photo.name, name) not in table.done:
                start = time.process_time()
                labels = method(photo.pixels, count)
                table.add(
                    "auto",
                    photo.name,
                    name,
                    iou=measures.mean_iou(labels, photo.labels),
                    pure=measures.pure(labels, photo.labels),
                    boundary_f=measures.boundary_f(labels, photo.labels),
                    count_error=abs(labels.max() + 1 - count),
                    cpu_seconds=time.process_time() - start,
                )


def stability(table: Table, photos: list) -> None:
    for photo in photos:
        for name, pixels, truth in changed(photo.pixels, photo.labels):
            if ("stability", photo.name, name) not in table.done:
                labels = ours(pixels, 0)
                table.add("stability", photo.name, name, iou=measures.mean_iou(labels, truth))


def clicks(table: Table, photos: list, most: int = 3) -> None:
    for photo in photos:
        methods = {**measures.CLICKED, "ours, pick": None, "ours, pick, best tolerance": None}
        for name in methods:
            if ("pick", photo.name, name) in table.done:
                continue
            features = describe(photo.pixels) if methods[name] is None else None
            scores = np.zeros((photo.labels.max() + 1, most))
            for material in range(len(scores)):
                truth = photo.labels == material
                given = [measures.first_click(truth, np.random.default_rng(material))]
                for number in range(most):
                    if features is None:
                        mask = methods[name](photo.pixels, given)
                    else:
                        tolerances = np.linspace(0.15, 1, 18) if "best" in name else (0.5,)
                        tried = [select(features, [Click(*click) for click in given], t) for t in tolerances]
                        mask = max(tried, key=lambda mask: measures.iou(mask, truth))
                    scores[material, number] = measures.iou(mask, truth)
                    click = measures.next_click(truth, mask)
                    if click is None:
                        scores[material, number:] = 1.0
                        break
                    given.append(click)
            values = {f"iou_{number + 1}": scores[:, number].mean() for number in range(most)}
            table.add("pick", photo.name, name, **values)


def lettering(table: Table, data: Path) -> None:
    """The share of each photo and texture that is taken for text, and of a sign's lines that are found in it."""
    for path in sorted([*(data / "photos").glob("*.jpg"), *(data / "textures").glob("*.jpg")]):
        name = f"{path.parent.name}_{path.stem}"
        if ("text", name, "ours") in table.done:
            continue
        pixels = np.clip(read_photo(path).pixels, 0, 1)
        scale = min(1.0, (DESCRIBED_PIXELS / pixels[..., 0].size) ** 0.5)
        encoded = srgb_from_linear(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
        found = {"taken_for_text": lettered(encoded).mean()}
        if path.parent.name == "photos":
            signed, lines = sign(encoded, np.random.default_rng(list(path.stem.encode())))
            found["of_sign"] = lettered(signed)[lines].mean()
        table.add("text", name, "ours", **found)


def lettered(encoded: np.ndarray) -> np.ndarray:
    return text_mask(cv2.cvtColor(np.clip(encoded, 0, 1).astype(np.float32), cv2.COLOR_RGB2LAB)[..., 0])


def sign(encoded: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A photo (h, w, 3) sRGB with a board of two lines, and (h, w) bool where these are; letters of 12 to 40 px."""
    height, width = encoded.shape[:2]
    words, font = random.choice(SIGNS, 2), random.choice([cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX])
    size, stroke = random.uniform(12, 40), 2
    (across, tall), _ = cv2.getTextSize(max(words, key=len), int(font), 1.0, stroke)
    size = min(size / tall, 0.8 * width / across)
    tall, across = int(size * tall), int(1.1 * size * across)
    left, top = random.integers(0, max(1, width - across - 2 * tall)), random.integers(0, height - 6 * tall)
    ground, ink = (0.85, 0.15) if random.random() < 0.5 else (0.2, 0.9)
    board, lines = np.full((height, width), -1.0, np.float32), np.zeros((height, width), np.float32)
    cv2.rectangle(board, (int(left), int(top)), (int(left) + across + 2 * tall, int(top) + 6 * tall), ground, -1)
    for line, word in enumerate(words):
        at = int(left) + tall, int(top) + 2 * tall + int(2.4 * tall * line)
        (long, _), _ = cv2.getTextSize(word, int(font), size, stroke)
        cv2.putText(board, word, at, int(font), size, ink, max(1, round(tall / 10)), cv2.LINE_AA)
        cv2.rectangle(lines, (at[0], at[1] - tall), (at[0] + long, at[1]), 1.0, -1)
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), random.normal(0, 4), 1)
    board = cv2.warpAffine(board, turn, (width, height), borderValue=-1)
    lines = cv2.warpAffine(lines, turn, (width, height)) > 0.5
    shade = 0.9 + 0.1 * encoded.mean(2) / encoded.mean()
    drawn = np.where(board[..., None] >= 0, (board * shade)[..., None], encoded)
    return drawn + random.normal(0, 0.01, drawn.shape), lines


def times(table: Table, data: Path) -> None:
    """Of a real photo enlarged to 2 megapixels, each in a process of its own."""
    for part in ("auto", "pick"):
        if ("time", part, "ours") not in table.done:
            command = [sys.executable, __file__, "--data", str(data), "-o", str(table.path.parent), "--measure", part]
            wall, cpu, change, megabytes = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
            table.add("time", part, "ours", wall_s=wall, cpu_s=cpu, change_ms=change, peak_mb=megabytes)


def measure_time(data: Path, part: str) -> None:
    pixels = read_photo(data / "photos" / "azure_colmar.jpg").pixels
    pixels = cv2.resize(pixels, (1632, 1224), interpolation=cv2.INTER_CUBIC).clip(0)
    describe(pixels[:64, :64])
    wall, cpu = time.perf_counter(), time.process_time()
    change = 0.0
    if part == "auto":
        segment(pixels)
    else:
        features = describe(pixels)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    if part == "pick":
        start = time.process_time()
        for number in range(20):
            select(features, [Click(800, 600), Click(100, 100, False)], number / 20)
        change = 1000 * (time.process_time() - start) / 20
    megabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps([wall, cpu, change, megabytes]))


def sheet(data: Path, folder: Path) -> None:
    """Photos that may be shown, and their regions."""
    tiles = []
    for path in sorted((data / "photos").glob("*.jpg")):
        if not path.name.startswith(SHOWN):
            continue
        pixels = read_photo(path).pixels
        labels = ours(pixels, 0)
        image = np.round(255 * np.clip(srgb_from_linear(pixels), 0, 1)).astype(np.uint8)[..., ::-1]
        drawn = image // 4
        for index in range(labels.max() + 1):
            hue = np.uint8([[[index * 180 // REGIONS, 220, 255]]])
            colour = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0]
            drawn[labels == index] = image[labels == index] // 2 + colour // 2
        scale = 200 / image.shape[0]
        small = [cv2.resize(x, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for x in (image, drawn)]
        tile = np.zeros((204, 612, 3), np.uint8)
        pair = np.hstack(small)[:200, :608]
        tile[: pair.shape[0], : pair.shape[1]] = pair
        tiles.append(tile)
    if tiles:
        tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 2)
        rows = [np.hstack(tiles[start : start + 2]) for start in range(0, len(tiles), 2)]
        cv2.imwrite(str(folder / "sheet.jpg"), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])


def chart(table: Table, folder: Path) -> None:
    """IoU per method, on each kind of photo, and of clicks."""
    whole, clicked = defaultdict(lambda: defaultdict(list)), defaultdict(lambda: defaultdict(list))
    for part, photo, method, measure, value in table.rows:
        kind = KINDS.get(photo.split("_")[0])
        if part in ("photos", "auto") and measure == "iou":
            whole[f"{kind}: IoU"][method].append(float(value))
        elif part == "pick" and measure in ("iou_1", "iou_3"):
            count = "1 click" if measure == "iou_1" else "3 clicks"
            clicked[f"{kind}: IoU after {count}"][method].append(float(value))
    for panels, name in ((whole, "auto"), (clicked, "pick")):
        if panels:
            charts.bars(panels, folder / name)


def main(given: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, metavar="DATA")
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--collages", type=int, default=COLLAGES)
    parser.add_argument("--measure", choices=("auto", "pick"), help=argparse.SUPPRESS)
    parser.add_argument("--quick", action="store_true", help="two collages, whole photos only")
    arguments = parser.parse_args(given)
    if arguments.measure:
        measure_time(arguments.data, arguments.measure)
        return 0
    if arguments.quick:
        arguments.collages, arguments.only = 2, ("auto",)
    arguments.output.mkdir(parents=True, exist_ok=True)
    table = Table(arguments.output / "segmentation.csv")
    choices = sources(arguments.data, "test")
    rendered = scenes(arguments.data)[: 0 if arguments.quick else None]
    for photo in rendered:
        photo.name = "scene_" + photo.name
    if "photos" in arguments.only:
        real_photos(table, photos(arguments.data))
    made = [collage(choices, seed) for seed in range(arguments.collages)]
    # scenes and collages in turn: a run that is stopped has some of both
    known = [photo for pair in zip_longest(rendered, made) for photo in pair if photo is not None]
    for part, run in (("auto", whole_photos), ("stability", stability), ("pick", clicks)):
        if part in arguments.only:
            run(table, known if part == "auto" else known[: len(known) // 2])
    if "text" in arguments.only:
        lettering(table, arguments.data)
    if "time" in arguments.only:
        times(table, arguments.data)
    if "sheet" in arguments.only:
        sheet(arguments.data, arguments.output)
    file = arguments.output / "segmentation.json"
    # rows of runs before stay in the table, so their commits stay too
    before = json.loads(file.read_text(encoding="utf-8"))["commits"] if file.exists() else []
    commits = list(dict.fromkeys([*before, records.commit()]))
    facts = {"command": records.command(), "commits": commits, "machine": records.machine()}
    text = json.dumps(facts | {"summary": table.summary()}, indent=1)
    file.write_text(text + "\n", encoding="utf-8")
    chart(table, arguments.output)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
