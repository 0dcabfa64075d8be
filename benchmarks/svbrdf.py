#!/usr/bin/env python3
"""Accuracy of decomposers (texture to albedo, normal, roughness) on materials that none of them was trained on.

    python benchmarks/svbrdf.py --data DATA -o benchmarks/results/svbrdf/
    python benchmarks/svbrdf.py --data DATA --rows analytic unet resnet101=model.ckpt -o dist/benchmarks/
    python benchmarks/svbrdf.py --data DATA --quick -o dist/benchmarks/       # 2 minutes

DATA is a folder with pbr/<collection>/<material>/{basecolor,normal,roughness}.jpg. Held out are the collection
`polyhaven` and every fourth material of the others. A row is a name of ROWS, or name=FILE with other weights. Writes
svbrdf.csv (a row per decomposer, material and seed), svbrdf.json (machine, command, summary), svbrdf.png (chart) and
svbrdf.jpg (sheet). `--keep` goes on: rows that svbrdf.csv has already are not run again.
Matplotlib makes the chart, `flip-evaluator` the column FLIP; without them both are left out, and it says so.
"""

import argparse
import csv
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
if "material_palette" not in sys.modules:
    sys.path.insert(0, str(ROOT))
    import dev

    dev.load_package()
from material_palette.benchmarks import charts, rivals  # noqa: E402
from material_palette.benchmarks.records import command, commit, machine  # noqa: E402
from material_palette.core import brdf, decomposition, perceptual  # noqa: E402
from material_palette.core.errors import PaletteError  # noqa: E402
from material_palette.core.exemplar import LUMINANCE  # noqa: E402
from material_palette.core.image import linear_from_srgb, srgb_from_linear  # noqa: E402
from material_palette.core.material import SVBRDF  # noqa: E402
from material_palette.core.torus import blur, normal_from_height  # noqa: E402

SIZE, RELIT, FLIP = 512, 192, 96  # px: side of what is decomposed, of what is relit, and of what FLIP sees
SEEDS = (101, 202, 303)  # of the lights of the inputs; training's are drawn otherwise
SIZES = (512, 1024, 2048)  # for seconds and memory
FITTED_ON = 24  # training materials for the strength of luminance-to-normal
Decompose = Callable[[np.ndarray], SVBRDF]


@dataclass
class Material:
    """Truth: albedo (S, S, 3) linear, normal (S, S, 3) unit, +Y up, roughness and metallic (S, S), float32."""

    name: str
    albedo: torch.Tensor
    normal: torch.Tensor
    roughness: torch.Tensor
    metallic: torch.Tensor

    @property
    def has_normal(self) -> bool:
        """False where the normals were computed from a height of guessed strength."""
        return not self.name.split("/")[0].endswith("-derived")


def split(data: Path) -> tuple[list[Path], list[Path]]:
    """(training, held out) folders of materials; raises SystemExit where there are none."""
    training, held_out = [], []
    for collection in sorted(path for path in (data / "pbr").glob("*") if path.is_dir()):
        folders = [
            folder
            for folder in sorted(collection.iterdir())
            if all((folder / f"{name}.jpg").exists() for name in ("basecolor", "normal", "roughness"))
        ]
        for i, folder in enumerate(folders):
            (held_out if collection.name == "polyhaven" or i % 4 == 3 else training).append(folder)
    if not held_out:
        raise SystemExit(f"no material below '{data / 'pbr'}': <collection>/<material>/basecolor.jpg and so on")
    return training, held_out


def read_material(folder: Path, size: int) -> Material:
    def read(name):
        pixels = cv2.imread(str(folder / f"{name}.jpg"))[..., ::-1].astype(np.float32) / 255
        return torch.from_numpy(cv2.resize(pixels, (size, size), interpolation=cv2.INTER_AREA))

    return Material(
        f"{folder.parent.name}/{folder.name}",
        torch.from_numpy(linear_from_srgb(read("basecolor").numpy())),
        torch.nn.functional.normalize(read("normal") * 2 - 1, dim=-1),
        read("roughness")[..., 0].clone(),
        read("metallic")[..., 0].clone() if (folder / "metallic.jpg").exists() else torch.zeros(size, size),
    )


# ---------------------------------------------------------------- light


def photographed(material: Material, seed: int) -> np.ndarray:
    """The material from above, (S, S, 3) linear in [0, 1], under a sun and an uneven sky; it tiles.

    A white matt plane would have mean 1: the exposure is known, as after the pipeline's flattening.
    """
    random = np.random.default_rng(seed)
    height, azimuth, share = random.uniform(0.45, 0.95), random.uniform(0, 2 * np.pi), random.uniform(0.3, 0.8)
    flat = np.sqrt(1 - height**2)
    sun = torch.tensor([flat * np.cos(azimuth), flat * np.sin(azimuth), height], dtype=torch.float32)
    lights = torch.cat([sun[None], brdf.sky(12)])
    tilt = torch.tensor(random.normal(0, 0.5, 2), dtype=torch.float32)
    sky = (1 + lights[1:, :2] @ tilt).clamp_min(0.1)[:, None] * torch.tensor([0.94, 1.0, 1.06])
    sky = sky / (sky * lights[1:, 2:]).sum(0).mean()
    warm = torch.tensor([1.05, 1.0, 0.92]) / height
    intensity = torch.cat([share * warm[None], (1 - share) * sky])
    up = torch.tensor([0.0, 0.0, 1.0])
    maps = material.albedo, material.normal, material.roughness
    return brdf.render(*maps, lights[:, None, None], intensity, up, material.metallic).clamp(0, 1).numpy()


@cache
def relighting() -> tuple[list, list]:
    """Nine set-ups (light, falloff), (view, _) of (R, R, 3): six where lamp and eye mirror, three at random, as in
    Deschaintre et al. 2018."""
    random, places, pairs = np.random.default_rng(9), brdf.plane(RELIT, RELIT), []
    for i in range(9):

        def above(random=random):
            z, angle = random.uniform(0.5, 1), random.uniform(0, 2 * np.pi)
            flat = np.sqrt(1 - z**2)
            return np.array([flat * np.cos(angle), flat * np.sin(angle), z], np.float32) * random.uniform(1.5, 3)

        lamp = above()
        eye = lamp * np.array([-1, -1, 1], np.float32) if i < 6 else above()
        aside = np.append(random.uniform(-0.3, 0.3, 2), 0).astype(np.float32)
        pairs.append([brdf.towards(torch.from_numpy(p + aside), places) for p in (lamp, eye)])
    return pairs


def relit(albedo, normal, roughness, metallic) -> np.ndarray:
    """The nine pictures (9, R, R, 3), sRGB-encoded in [0, 1]."""
    pictures = []
    for (light, falloff), (view, _) in relighting():
        pictures.append(brdf.shade(albedo, normal, roughness, light, view, metallic) * falloff)
    return srgb_from_linear(torch.stack(pictures).clamp(0, 1).numpy())


def smaller(material) -> tuple[torch.Tensor, ...]:
    """Maps of a Material or SVBRDF as full images (RELIT, RELIT[, 3])."""

    def shrink(x, channels):
        x = torch.as_tensor(np.asarray(0.0 if x is None else x, np.float32))
        if x.ndim < 2:
            return x.expand(RELIT, RELIT, channels) if channels > 1 else x.expand(RELIT, RELIT)
        return torch.from_numpy(cv2.resize(x.numpy(), (RELIT, RELIT), interpolation=cv2.INTER_AREA))

    normal = torch.nn.functional.normalize(shrink(material.normal, 3), dim=-1)
    return shrink(material.albedo, 3), normal, shrink(material.roughness, 1), shrink(material.metallic, 1)


# ---------------------------------------------------------------- measures


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Wang et al. 2004, Gaussian window of deviation 1.5, data range 1, mean over channels."""

    def local(x):
        return cv2.GaussianBlur(x, (11, 11), 1.5, borderType=cv2.BORDER_REFLECT_101)

    a, b = (x.astype(np.float32) for x in (a, b))
    ma, mb = local(a), local(b)
    va, vb, cov = local(a * a) - ma * ma, local(b * b) - mb * mb, local(a * b) - ma * mb
    score = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4))
    return float(score.mean())


def ciede2000(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Colour differences (...) of CIELAB colours (..., 3). Source: Sharma, Wu, Dalal 2005."""
    (l1, a1, b1), (l2, a2, b2) = (np.moveaxis(np.asarray(x, np.float64), -1, 0) for x in (first, second))
    c7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    g = 0.5 * (1 - np.sqrt(c7 / (c7 + 25.0**7)))
    a1, a2 = a1 * (1 + g), a2 * (1 + g)
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    colourless = c1 * c2 == 0
    dh = np.where(colourless, 0, (h2 - h1 + 180) % 360 - 180)
    big_dh = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(dh / 2))
    mean_l, mean_c = (l1 + l2) / 2, (c1 + c2) / 2
    mean_h = np.where(colourless, h1 + h2, (h1 + np.where(np.abs(h2 - h1) > 180, dh, h2 - h1) / 2) % 360)
    cosines = ((1, 30, -0.17), (2, 0, 0.24), (3, -6, 0.32), (4, 63, -0.20))
    t = 1 + sum(w * np.cos(np.radians(k * mean_h - s)) for k, s, w in cosines)
    sl = 1 + 0.015 * (mean_l - 50) ** 2 / np.sqrt(20 + (mean_l - 50) ** 2)
    sc, sh = 1 + 0.045 * mean_c, 1 + 0.015 * mean_c * t
    rt = -2 * np.sqrt(mean_c**7 / (mean_c**7 + 25.0**7))
    rt = rt * np.sin(np.radians(60 * np.exp(-(((mean_h - 275) / 25) ** 2))))
    dl, dc, dh = (l2 - l1) / sl, (c2 - c1) / sc, big_dh / sh
    return np.sqrt(dl**2 + dc**2 + dh**2 + rt * dc * dh)


def cielab(linear: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(srgb_from_linear(np.clip(linear, 0, 1)).astype(np.float32), cv2.COLOR_RGB2Lab)


def flip(truth: np.ndarray, found: np.ndarray) -> float | None:
    """Mean FLIP (Andersson et al. 2020) of pictures (n, R, R, 3); None without flip-evaluator."""
    if find_spec("flip_evaluator") is None:
        return None
    import flip_evaluator

    def seen(picture):
        return cv2.resize(picture, (FLIP, FLIP), interpolation=cv2.INTER_AREA)

    pairs = zip(truth, found, strict=True)
    return float(np.mean([flip_evaluator.evaluate(seen(a), seen(b), "LDR", applyMagma=False)[1] for a, b in pairs]))


def as_picture(value: np.ndarray) -> np.ndarray:
    """Normals (S, S, 3) or roughness (S, S) as a picture (S, S, 3) in [0, 1]."""
    return value / 2 + 0.5 if value.ndim == 3 else np.repeat(value[..., None], 3, 2)


def measure(material: Material, found: SVBRDF, truth: dict, with_flip: bool) -> dict:
    size = material.roughness.shape[0]
    albedo, normal = (np.broadcast_to(x, (size, size, 3)).astype(np.float32) for x in (found.albedo, found.normal))
    roughness = np.broadcast_to(np.asarray(found.roughness, np.float32), (size, size))
    row = {}
    for key, ours, theirs in (
        ("A", albedo, material.albedo.numpy()),
        ("N", normal, material.normal.numpy()),
        ("R", roughness, material.roughness.numpy()),
    ):
        if key == "N" and not material.has_normal:
            continue
        row[f"{key}_mse"] = float(np.mean((ours - theirs) ** 2))
        row[f"{key}_ssim"] = ssim(ours, theirs)
        if key != "A":
            # what squared error is blind to: whether the map looks like one of its kind
            row[f"{key}_lpips"] = perceptual.distance(as_picture(ours), as_picture(theirs))
    small = smaller(found)
    row["delta_e"] = float(ciede2000(truth["lab"], cielab(small[0].numpy())).mean())
    if material.has_normal:
        cosine = (normal * material.normal.numpy()).sum(-1) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-6)
        row["angle"] = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())
        pictures = relit(*small)
        row["relit_psnr"] = float(-10 * np.log10(max(np.mean((pictures - truth["relit"]) ** 2), 1e-10)))
        if with_flip:
            row["relit_flip"] = flip(truth["relit"], pictures)
    return row


# ---------------------------------------------------------------- rows


@dataclass
class Prior:
    """What the training materials have in common."""

    albedo: np.ndarray  # (3,) linear
    roughness: float
    strength: float  # slope per unit of luminance and pixel, for luminance-to-normal


FLAT = np.array([0, 0, 1], np.float32)


def constant_prior(prior: Prior, weights: Path | None) -> Decompose:
    return lambda texture: SVBRDF(prior.albedo, FLAT, prior.roughness)


def nothing(prior: Prior, weights: Path | None) -> Decompose:
    """The photo is the albedo, the surface is flat."""
    return lambda texture: SVBRDF(texture, FLAT, prior.roughness)


def luminance_to_normal(prior: Prior, weights: Path | None) -> Decompose:
    """Bright is high: what tools without learning do."""
    return lambda texture: SVBRDF(texture, luminance_normal(texture, prior.strength), prior.roughness)


def luminance_normal(texture: np.ndarray, strength: float) -> np.ndarray:
    luminance = torch.from_numpy(srgb_from_linear(texture @ LUMINANCE).astype(np.float32))
    return normal_from_height(blur(luminance, 1.0) * (strength / texture.shape[1])).numpy()


def product(name: str) -> Callable:
    """A decomposer of the product, with its own weights or with those of a file."""

    def row(prior: Prior, weights: Path | None) -> Decompose:
        try:
            chosen = decomposition.choose(name if weights is None else f"{name}={weights}")
        except PaletteError as error:
            raise SystemExit(str(error)) from error
        return lambda texture: chosen(texture, _quiet)

    return row


def deep_materials(prior: Prior, weights: Path | None) -> Decompose:
    if weights is None:
        raise SystemExit("row 'deep-materials' needs the weights that training/train.py makes: deep-materials=FILE")
    return lambda texture: rivals.deep_materials(texture, weights)


def as_found(prior: Prior, weights: Path | None) -> Decompose:
    """The network's slopes alone, and all that it takes for light taken out: what squared error wants."""
    return lambda texture: decomposition.unet.decompose(
        texture, _quiet, weights or decomposition.unet.WEIGHTS, share=1.0, guess=0.0
    )


ROWS = {
    "constant prior": constant_prior,
    "nothing": nothing,
    "luminance-to-normal": luminance_to_normal,
    "analytic": product("analytic"),
    "unet as found": as_found,
    "unet": product("unet"),
    "resnet101": product("resnet101"),
    "deep-materials": deep_materials,
}
DEFAULT = tuple(name for name in ROWS if name not in ("resnet101", "deep-materials"))  # which need weights
LABELS = {"nothing": "photo as albedo, flat"}


def _quiet(fraction: float, message: str) -> None:
    pass


def decomposer(row: str, prior: Prior) -> Decompose:
    """The function of a row `name` or `name=FILE`; a name before a colon tells two files of one decomposer apart."""
    name, _, weights = row.partition("=")
    name = name.split(":")[-1]
    if name not in ROWS:
        raise SystemExit(f"row '{name}' is unknown; choose from: {', '.join(ROWS)}")
    return ROWS[name](prior, Path(weights) if weights else None)


def label(row: str) -> str:
    name = row.partition("=")[0].split(":")[0]
    return LABELS.get(name, name)


def fit_prior(training: list[Path], size: int) -> Prior:
    small = [read_material(folder, 64) for folder in training]
    albedo = np.mean([m.albedo.mean((0, 1)).numpy() for m in small], 0)
    roughness = float(np.mean([m.roughness.mean() for m in small]))
    chosen = [f for f in training if not f.parent.name.endswith("-derived")]
    chosen = chosen[:: max(1, len(chosen) // FITTED_ON)][:FITTED_ON]
    pairs = []
    for i, folder in enumerate(chosen):
        material = read_material(folder, size)
        pairs.append((photographed(material, 5000 + i), material.normal.numpy()))
    trials = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
    errors = [np.mean([np.mean((luminance_normal(p, s) - n) ** 2) for p, n in pairs]) for s in trials]
    return Prior(albedo.astype(np.float32), roughness, trials[int(np.argmin(errors))])


# ---------------------------------------------------------------- results

MAPS = ("A_mse", "N_mse", "R_mse", "A_ssim", "N_ssim", "R_ssim")
OTHERS = ("delta_e", "angle", "relit_psnr", "relit_flip", "N_lpips", "R_lpips")


def read_results(folder: Path, conditions: dict) -> list[dict]:
    """The rows of a folder's svbrdf.csv; SystemExit where it is missing or its JSON says other conditions."""
    try:
        about = json.loads((folder / "svbrdf.json").read_text())
        with (folder / "svbrdf.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise SystemExit(f"--keep: cannot read '{error.filename}'; leave --keep out to measure all rows") from error
    for name, value in conditions.items():
        if about[name] != value:
            raise SystemExit(f"--keep: the rows in '{folder}' are of other {name}; leave --keep out")
    numbers = {key: lambda x: float(x) if x else None for key in (*MAPS, *OTHERS)} | {"seed": int}
    return [{key: numbers.get(key, str)(x) for key, x in row.items()} for row in rows]


def summarise(results: list[dict], rows: list[str], where: Callable[[str], bool]) -> dict:
    """Per row: each material's median over the seeds, of which the mean (the paper's form) and quartiles."""
    summary = {}
    for row in rows:
        per_material: dict[str, dict[str, list]] = {}
        for r in results:
            if r["row"] == label(row) and where(r["material"]):
                for key in (*MAPS, *OTHERS):
                    if r.get(key) is not None:
                        per_material.setdefault(key, {}).setdefault(r["material"], []).append(r[key])
        summary[label(row)] = {}
        for key, found in per_material.items():
            values = [float(np.median(v)) for v in found.values()]
            low, median, high = np.quantile(values, (0.25, 0.5, 0.75))
            quartiles = {"mean": np.mean(values), "low": low, "median": median, "high": high}
            summary[label(row)][key] = {k: float(v) for k, v in quartiles.items()} | {"materials": len(values)}
    return summary


def delta(summary: dict, row: str, against: str) -> float:
    """The paper's delta: mean gain in per cent over the six numbers, relative to another row's."""
    gains = []
    for key in MAPS:
        ours, theirs = summary[row][key]["mean"], summary[against][key]["mean"]
        gains.append((theirs - ours) / theirs if key.endswith("mse") else (ours - theirs) / abs(theirs))
    return 100 * float(np.mean(gains))


def table(summary: dict, against: str, cost: dict) -> str:
    lines = [
        "| row | A mse | N mse | R mse | A ssim | N ssim | R ssim | delta | CIEDE2000 | normals, degrees "
        "| relit PSNR, dB | relit FLIP | N, ST-LPIPS | R, ST-LPIPS |"
        + "".join(f" {size} px: s, MB |" for size in SIZES if cost),
        "|---" * (14 + (len(SIZES) if cost else 0)) + "|",
    ]
    for row, found in summary.items():
        cells = [f"{found[k]['mean'] * (10 if k.endswith('mse') else 1):.3f}" for k in MAPS]
        cells.append(f"{delta(summary, row, against):+.1f} %")
        for key, digits in zip(OTHERS, (1, 1, 1, 3, 3, 3), strict=True):
            cells.append(f"{found[key]['median']:.{digits}f}" if key in found else "")
        for size in SIZES if cost else ():
            spent = cost.get(row, {}).get(str(size))
            cells.append(f"{spent['cpu_seconds']:.2f}, {spent['peak_mb']:.0f}" if spent else "")
        lines.append(f"| {row} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def cost_of(row: str, data: Path) -> dict:
    """CPU seconds and the process's peak memory at each size, each in a process of its own."""
    found = {}
    for size in SIZES:
        command = [sys.executable, __file__, "--data", str(data), "--cost", str(size), "--rows", row]
        run = subprocess.run(command, capture_output=True, text=True)
        if run.returncode == 0:
            found[str(size)] = json.loads(run.stdout.strip().splitlines()[-1])
    return found


def print_cost(row: str, size: int, held_out: list[Path]) -> None:
    decompose = decomposer(row, Prior(np.full(3, 0.2, np.float32), 0.6, 1.0))
    texture = photographed(read_material(held_out[-1], 512), 1)
    decompose(texture[:128, :128].copy())  # weights are read once a session
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    texture = np.ascontiguousarray(np.tile(texture, (size // 512, size // 512, 1)))
    wall, cpu = time.perf_counter(), time.process_time()
    decompose(texture)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(
        json.dumps(
            {"wall_seconds": wall, "cpu_seconds": cpu, "peak_mb": peak / 1024, "added_mb": (peak - before) / 1024}
        )
    )


def chart(summary: dict, path: Path) -> None:
    plt = charts.plt()
    if plt is None:
        return
    panels = {
        "A_mse": ("albedo, MSE x 10 (less is better)", 10),
        "angle": ("normals, degrees (less)", 1),
        "R_mse": ("roughness, MSE x 10 (less)", 10),
        "relit_psnr": ("relit, PSNR in dB (more)", 1),
    }
    figure, axes = plt.subplots(1, len(panels), figsize=(13, 0.6 + 0.42 * len(summary)), sharey=True)
    for axis, (key, (title, factor)) in zip(axes, panels.items(), strict=True):
        for i, found in enumerate(summary.values()):
            if key in found:
                low, median, high = (found[key][k] * factor for k in ("low", "median", "high"))
                axis.barh(i, median, color="#4a7a9c", height=0.6)
                axis.plot([low, high], [i, i], color="#222222", linewidth=1.2)
        axis.set_title(title, fontsize=9)
        axis.tick_params(labelsize=8)
    axes[0].set_yticks(range(len(summary)), list(summary))
    axes[0].invert_yaxis()
    charts.save(figure, path)


def sheet(materials: list[Material], decompose: Decompose, path: Path) -> None:
    """Per material two rows, truth and found: input, albedo, normal, roughness, relit twice."""
    rows = []
    for material in materials:
        pixels = photographed(material, SEEDS[0])
        shown = srgb_from_linear(cv2.resize(pixels, (RELIT, RELIT), interpolation=cv2.INTER_AREA))
        for i, maps in enumerate((smaller(material), smaller(decompose(pixels)))):
            albedo, normal, roughness, _ = maps
            pictures = relit(*maps)
            grey = np.repeat(roughness.numpy()[..., None], 3, 2)
            first = shown if i == 0 else np.ones_like(shown)
            parts = [first, srgb_from_linear(albedo.numpy()), normal.numpy() / 2 + 0.5, grey, pictures[1], pictures[7]]
            rows.append(np.concatenate(parts, 1))
    pixels = np.concatenate(rows)[..., ::-1]
    cv2.imwrite(str(path), (np.clip(pixels, 0, 1) * 255).round().astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 88])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist" / "benchmarks")
    parser.add_argument("--rows", nargs="+", default=list(DEFAULT), help="names of ROWS, name=FILE, label:name=FILE")
    parser.add_argument("--against", default="constant prior", help="the row that delta is relative to")
    parser.add_argument("--collections", nargs="+", help="held-out collections that count; default: all")
    parser.add_argument("--quick", action="store_true", help="polyhaven if there, 256 px, one seed, no cost")
    parser.add_argument("--size", type=int, help=f"px of what is decomposed ({SIZE}; with --quick 256)")
    parser.add_argument("--keep", action="store_true", help="do not run again the rows that svbrdf.csv already has")
    parser.add_argument("--no-cost", action="store_true", help="without seconds and memory")
    parser.add_argument("--cost", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    training, held_out = split(options.data)
    if options.cost:
        print_cost(options.rows[0], options.cost, held_out)
        return 0
    size, seeds = options.size or (256 if options.quick else SIZE), SEEDS[:1] if options.quick else SEEDS
    collections = (
        ["polyhaven"] if options.quick and (options.data / "pbr" / "polyhaven").is_dir() else options.collections
    )
    held_out = [f for f in held_out if not collections or f.parent.name in collections]
    options.output.mkdir(parents=True, exist_ok=True)
    start = time.time()
    prior = fit_prior(training, size)
    conditions = {"size": size, "seeds": list(seeds), "materials": [f"{f.parent.name}/{f.name}" for f in held_out]}
    results = read_results(options.output, conditions) if options.keep else []
    results = [r for r in results if r["row"] in map(label, options.rows)]
    kept = list(dict.fromkeys(r["row"] for r in results))
    rows = {row: decomposer(row, prior) for row in options.rows if label(row) not in kept}
    if find_spec("flip_evaluator") is None:
        print("flip-evaluator is not installed: without the column FLIP", flush=True)
    print(f"{len(held_out)} held-out materials, prior of {len(training)}: {prior}", flush=True)

    for folder in held_out:
        material = read_material(folder, size)
        small = smaller(material)
        truth = {"relit": relit(*small), "lab": cielab(small[0].numpy())}
        for seed in seeds:
            pixels = photographed(material, seed + sum(map(ord, material.name)))
            for row, decompose in rows.items():
                found = measure(material, decompose(pixels), truth, with_flip=seed == seeds[0])
                results.append({"row": label(row), "material": material.name, "seed": seed} | found)
        print(f"{time.time() - start:4.0f} s  {material.name}", flush=True)
    summaries = {"all": summarise(results, options.rows, lambda name: True)}
    if any(f.parent.name == "polyhaven" for f in held_out):
        summaries["polyhaven"] = summarise(results, options.rows, lambda name: name.startswith("polyhaven/"))
    cost = {} if options.quick or options.no_cost else {label(row): cost_of(row, options.data) for row in rows}

    with (options.output / "svbrdf.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["row", "material", "seed", *MAPS, *OTHERS])
        writer.writeheader()
        writer.writerows(results)
    about = {
        "rows": [row.partition("=")[0] for row in options.rows],
        "kept": kept,
        "against": options.against,
        **conditions,
        "command": command(),
        "commit": commit(),
        "machine": machine(),
        "prior": {"albedo": prior.albedo.tolist(), "roughness": prior.roughness, "strength": prior.strength},
        "cost": cost,
        "summary": summaries,
    }
    (options.output / "svbrdf.json").write_text(json.dumps(about, indent=1))
    for name, summary in summaries.items():
        print(f"\n{name}\n{table(summary, options.against, cost)}")
    chart(summaries["all"], options.output / "svbrdf")
    shown = [f for f in held_out if f.parent.name in ("polyhaven", "ambientcg")][:: max(1, len(held_out) // 6)][:6]
    last = decomposer(options.rows[-1], prior)
    sheet([read_material(f, size) for f in shown or held_out[:4]], last, options.output / "svbrdf.jpg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
