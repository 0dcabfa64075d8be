#!/usr/bin/env python3
"""Stability where methods fail: each failure family as a ramp of severity, with the same material and known truth.

    python3 dev.py bench stability --data DATA -o DIR [--seeds 8] [--minutes M]     # goes on where it was stopped
    python3 dev.py bench stability --quick                                          # procedural materials, 3 minutes

A case is a photo of a known material under one disturbance. Ours (preset draft) and what is done without a tool (the
largest square of the region, cross-faded, as base colour) are compared with the truth. A seed stands for a material and
for the chance in its disturbances. Writes stability.csv (a row per case and method), stability.json, the chart and a
sheet of what the worst severities look like.
"""

import argparse
import re
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
from material_palette.benchmarks import charts, endtoend, measures, records, svbrdf  # noqa: E402
from material_palette.benchmarks.baselines import cross_fade, largest_square  # noqa: E402
from material_palette.benchmarks.exemplar import Slanted, photograph, scale_of  # noqa: E402
from material_palette.benchmarks.made import make_data  # noqa: E402
from material_palette.core import palette, rectification  # noqa: E402
from material_palette.core.errors import PaletteError  # noqa: E402
from material_palette.core.exemplar import LUMINANCE  # noqa: E402
from material_palette.core.image import linear_from_srgb, srgb_from_linear  # noqa: E402
from material_palette.core.material import SVBRDF  # noqa: E402
from material_palette.core.region import Region  # noqa: E402
from material_palette.core.torus import resize  # noqa: E402

SIDE, TILE, RESOLUTION = 320, 160, 192  # px: of photos, of a material's tile in them, of extracted maps
FOCAL = 1.1 * SIDE  # px; known, as from EXIF
FAMILIES: dict[str, tuple[str, tuple[float, ...]]] = {  # what the severity is; from harmless on
    "uniform": ("contrast left", (1, 0.5, 0.2, 0.1, 0.05, 0)),
    "shaded": ("lit to shaded, hard", (1, 1.5, 2, 4, 8)),
    "slanted": ("degrees", (0, 20, 40, 60, 70, 80)),
    "small": ("px across", (320, 128, 64, 48, 32)),
    "thin": ("px across", (320, 40, 20, 12, 8)),
    "scattered": ("share painted, blobs", (1, 0.5, 0.25, 0.1, 0.05)),
    "foreign": ("share of another material", (0, 0.05, 0.1, 0.2, 0.4)),
    "noise": ("deviation", (0, 0.02, 0.05, 0.1, 0.2)),
    "JPEG": ("quality", (100, 75, 40, 20, 10, 5)),
    "blur": ("px", (0, 1, 2, 4, 8)),
    "over-exposed": ("stops", (0, 0.5, 1, 2, 3)),
    "under-exposed": ("stops", (0, 1, 2, 4, 6)),
    "highlights": ("share in them", (0, 0.05, 0.1, 0.2, 0.4)),
    "few periods": ("periods seen", (4, 3, 2, 1.5, 1, 0.7)),
}
STRUCTURED = ("brick", "tiles", "paving", "roof", "bricks", "planks")  # classes that `few periods` takes
SLANT = "the slant of the region could not be told"  # said of nearly all that is stochastic: counts where it matters
LEAST_FADED = 8  # px: a smaller square is repeated as it is
METHODS = ("ours", "square crop, cross-faded")


def enlarged(value: np.ndarray, side: int, tile: int) -> np.ndarray:
    """A map at `tile` px per tile, repeated to (side, side)."""
    h, w = value.shape[:2]
    small = resize(value, (max(1, round(h * tile / w)), tile))
    again = [-(-side // n) for n in small.shape[:2]]
    return np.tile(small, (*again, 1) if value.ndim == 3 else again)[:side, :side]


def lit(maps: SVBRDF, side: int, tile: int, random, contrast: float = 1.0) -> np.ndarray:
    """A photo (side, side, 3) linear from above under a sun and a sky; a white matt plane would be 1."""
    albedo = enlarged(maps.albedo, side, tile)
    normal = enlarged(maps.normal, side, tile)
    mean = albedo.mean((0, 1))
    albedo = mean + contrast * (albedo - mean)
    angle = random.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(angle) * 0.6, np.sin(angle) * 0.6, 0.8], np.float32)
    relief = np.maximum(normal @ sun, 0.05) / 0.8
    sky = 0.5 + 0.5 * normal[..., 2]
    light = 1 + contrast * (0.35 * sky + 0.65 * relief - 1)
    return np.clip(albedo, 0, 1) * light[..., None]


def _line(random, side: int) -> np.ndarray:
    """(side, side) from 0 to 1 across the picture in some direction."""
    angle = random.uniform(0, 2 * np.pi)
    v, u = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    x = u * np.cos(angle) + v * np.sin(angle)
    return ((x - x.min()) / np.ptp(x)).astype(np.float32)


def _blobs(random, side: int, share: float) -> np.ndarray:
    field = cv2.GaussianBlur(random.standard_normal((side, side)).astype(np.float32), (0, 0), 7)
    return field > np.quantile(field, 1 - share)


def disturbed(family: str, severity: float, maps: SVBRDF, other: SVBRDF, seed: int):
    """(photo (H, W, 3) linear, mask, px per tile, normal (3,) away from the camera of what is slanted) of a case; the
    chance is the seed's at every severity."""
    random = np.random.default_rng([seed, sum(map(ord, family))])
    side, tile, mask, normal = SIDE, TILE, np.ones((SIDE, SIDE), bool), None
    if family == "few periods":
        tile = round(SIDE / severity)
    photo = lit(maps, side, tile, random, severity if family == "uniform" else 1.0)
    exposure = 0.7 / np.percentile(photo, 99)
    deviation = 0.004
    if family == "shaded":
        edge = 0.5 + 0.5 * np.tanh((_line(random, side) - 0.5) * side / 3)
        photo = photo * (1 / severity + (1 - 1 / severity) * edge)[..., None]
    elif family == "slanted":
        tilt = random.uniform(0, 2 * np.pi)
        c, s = np.cos(np.radians(severity)), np.sin(np.radians(severity))
        normal = np.array([s * np.cos(tilt), s * np.sin(tilt), c])
        flat = lit(maps, 2 * TILE, 2 * TILE, random)
        photo, mask = photograph(flat * exposure, normal, FOCAL, (side, side), 2.0, 0.0, random)
        photo = photo / exposure
    elif family in ("small", "thin"):
        half = severity / 2
        v, u = np.abs(np.mgrid[:side, :side] - (side - 1) / 2)
        across = _line(random, side) * side * np.sqrt(2)
        mask = (
            (np.maximum(u, v) <= half) if family == "small" or severity >= side else np.abs(across - 0.7 * side) < half
        )
    elif family == "scattered" and severity < 1:
        mask = _blobs(random, side, severity)
    elif family == "foreign":
        stranger = lit(other, side, tile, random)
        photo = np.where((_line(random, side) < severity)[..., None], stranger, photo)
    elif family == "noise":
        deviation += severity
    elif family == "blur" and severity:
        photo = cv2.GaussianBlur(photo, (0, 0), severity)
    elif family == "over-exposed":
        exposure *= 2.0**severity
    elif family == "under-exposed":
        exposure *= 0.5**severity
    elif family == "highlights" and severity:
        v, u = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
        radius = np.hypot(u - random.uniform(-0.4, 0.4), v - random.uniform(-0.4, 0.4))
        size = np.quantile(radius, severity)
        photo = photo + (0.8 / exposure / (1 + np.exp((radius - size) / 0.08)))[..., None]
    encoded = srgb_from_linear(np.clip(photo * exposure, 0, 1).astype(np.float32))
    encoded = encoded + deviation * random.standard_normal(encoded.shape).astype(np.float32)
    pixels = np.rint(np.clip(encoded, 0, 1) * 255).astype(np.uint8)
    if family == "JPEG" and severity < 100:
        pixels = cv2.imdecode(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, int(severity)])[1], 1)
    return linear_from_srgb(pixels / np.float32(255)), mask, tile, normal


# ---------------------------------------------------------------- judging


def quantiles(albedo: np.ndarray) -> list:
    """`measures.patch_quantiles` of a tile's linear albedo, made as bright as any other: a photo does not tell how
    bright a surface is."""
    albedo = np.asarray(albedo, np.float32)
    albedo = albedo.reshape(1, 1, 3) if albedo.ndim == 1 else albedo
    albedo = np.tile(albedo, (*(-(-64 // n) for n in albedo.shape[:2]), 1))  # patches at all scales
    gain = 0.18 / max(float((albedo @ LUMINANCE).mean()), 1e-4)
    return measures.patch_quantiles(srgb_from_linear(np.clip(albedo * gain, 0, 1)))


def judged(albedo: np.ndarray, truth: np.ndarray, target: list) -> dict:
    """error: SWD of patches x 1000; colour: CIEDE2000 of the mean, both at one brightness."""
    means = [np.asarray(x, np.float32).reshape(-1, 3).mean(0) for x in (truth, albedo)]
    lab = [svbrdf.cielab((m * 0.18 / max(float(m @ LUMINANCE), 1e-4)).reshape(1, 1, 3))[0, 0] for m in means]
    error = 1000 * measures.sliced_wasserstein(quantiles(albedo), target)
    return {"error": error, "colour": float(svbrdf.ciede2000(*lab))}


def at_one_scale(material: palette.Material, seen: Slanted) -> np.ndarray:
    """The base colour with texels as large as a px of what is seen from the front; rectified, they have other sizes."""
    albedo = material.svbrdf.albedo
    if seen.normal is None or "homography" not in material.rectification or albedo.ndim == 1:
        return albedo
    size = material.exemplar.shape[:2]
    homography = np.array(material.rectification["homography"])
    found = rectification.Rectification(seen.pixels, np.ones(size, bool), homography)
    return resize(albedo, (max(8, round(RESOLUTION * scale_of(found, seen))),) * 2)


def run_case(family: str, severity: float, maps: SVBRDF, other: SVBRDF, seed: int, picture: Path | None) -> list[dict]:
    """The rows of both methods."""
    torch.set_num_threads(1)
    photo, mask, tile, normal = disturbed(family, severity, maps, other, seed)
    true = enlarged(maps.albedo, tile, tile)
    if family == "uniform":
        true = true.mean((0, 1)) + severity * (true - true.mean((0, 1)))
    target = quantiles(true)
    settings = palette.Settings(quality="draft", resolution=RESOLUTION, seed=seed)
    rows, shown = [], [srgb_from_linear(np.where(mask[..., None], photo, photo * 0.15))]
    start = time.process_time()
    row = {"method": METHODS[0], "refused": False, "warned": False, "warnings": ""}
    try:
        region = Region("region", mask)
        material = palette.extract_material(photo, region, settings, lambda fraction, message: None, focal=FOCAL)
        warnings = [w for w in material.warnings if family == "slanted" or not w.startswith(SLANT)]
        seen = Slanted(photo, mask, normal, FOCAL, 1.0, True)
        row |= judged(at_one_scale(material, seen), true, target)
        row |= {"warned": bool(warnings), "warnings": "; ".join(re.sub(r"\d+", "#", w) for w in material.warnings)}
        shown.append(srgb_from_linear(np.clip(material.svbrdf.albedo, 0, 1)))
    except PaletteError as error:
        row |= {"refused": True, "warned": True, "warnings": re.sub(r"\d+", "#", str(error))}
        shown.append(np.zeros((8, 8, 3), np.float32))
    rows.append(row | {"cpu_seconds": time.process_time() - start})
    crop = photo[largest_square(mask)]
    if min(crop.shape[:2]) >= LEAST_FADED:
        crop = linear_from_srgb(cross_fade(srgb_from_linear(photo), mask, 0, 0)[0])
    rows.append({"method": METHODS[1], "refused": False, "warned": False} | judged(crop, true, target))
    shown += [srgb_from_linear(crop), srgb_from_linear(np.clip(true, 0, 1))]
    if picture is not None:
        picture.parent.mkdir(parents=True, exist_ok=True)
        strip = np.concatenate([_tiled(x) for x in shown], 1)[..., ::-1] * 255
        cv2.imwrite(str(picture), strip.round().astype(np.uint8))
    return [{"family": family, "severity": severity, "seed": seed} | row for row in rows]


def _tiled(picture: np.ndarray, side: int = 160) -> np.ndarray:
    """A picture, repeated or cut to side px, a photo shrunk."""
    if picture.ndim == 1:
        picture = picture.reshape(1, 1, 3)
    if picture.shape[0] == SIDE:
        return cv2.resize(picture, (side, side), interpolation=cv2.INTER_AREA)
    return np.tile(picture, (*[-(-side // n) for n in picture.shape[:2]], 1))[:side, :side]


# ---------------------------------------------------------------- results


def bound(materials: list[SVBRDF]) -> float:
    """The error from which on an answer has failed: half of the median distance of two different materials."""
    all_quantiles = [quantiles(enlarged(m.albedo, TILE, TILE)) for m in materials]
    pairs = [(a, b) for i, a in enumerate(all_quantiles) for b in all_quantiles[:i]]
    return 500 * float(np.median([measures.sliced_wasserstein(a, b) for a, b in pairs]))


def summarise(rows: list[dict], limit: float) -> dict:
    """By family, severity and method."""
    found = {}
    for row in rows:
        found.setdefault((row["family"], row["severity"], row["method"]), []).append(row)
    summary = []
    for (family, severity, method), own in found.items():
        errors = [r["error"] for r in own if "error" in r]
        quartiles = np.quantile(errors, (0.25, 0.5, 0.75, 1)) if errors else [None] * 4
        silent = [r for r in own if r.get("error", 0) > limit and not r["warned"]]
        summary.append(
            {
                "family": family, "severity": severity, "method": method, "cases": len(own),
                "median": quartiles[1], "worst": quartiles[3], "low": quartiles[0], "high": quartiles[2],
                "refused": sum(r["refused"] for r in own) / len(own),
                "warned": sum(r["warned"] for r in own) / len(own),
                "silent": len(silent) / len(own),
            }
        )  # fmt: skip
    return summary


def chart(summary: list[dict], limit: float, path: Path) -> None:
    pyplot = charts.plt()
    if pyplot is None:
        return
    families = [f for f in FAMILIES if any(s["family"] == f for s in summary)]
    figure, axes = pyplot.subplots(-(-len(families) // 5), 5, figsize=(14, 2.6 * -(-len(families) // 5)), sharey=True)
    for axis in np.ravel(axes)[len(families) :]:
        axis.axis("off")
    for axis, family in zip(np.ravel(axes), families, strict=False):
        severities = FAMILIES[family][1]
        for method, colour in zip(METHODS, (charts.OURS, charts.OTHER), strict=True):
            own = [s for s in summary if s["family"] == family and s["method"] == method and s["median"] is not None]
            own.sort(key=lambda s: severities.index(s["severity"]))
            x = [severities.index(s["severity"]) for s in own]
            axis.fill_between(x, [s["low"] for s in own], [s["high"] for s in own], color=colour, alpha=0.18, lw=0)
            axis.plot(x, [s["median"] for s in own], color=colour, marker="o", ms=3, label=method)
            axis.plot(x, [s["worst"] for s in own], color=colour, ls=":", lw=1)
        ours = [s for s in summary if s["family"] == family and s["method"] == METHODS[0]]
        for s in ours:
            words = ([f"{s['warned']:.0%} w"] if s["warned"] else []) + (
                [f"{s['refused']:.0%} r"] if s["refused"] else []
            )
            if words:
                place = severities.index(s["severity"]), 0.99
                axis.text(
                    *place, "\n".join(words), transform=axis.get_xaxis_transform(), fontsize=6, ha="center", va="top"
                )
        axis.axhline(limit, color="#b03030", lw=0.8, ls="--")
        axis.set_xticks(range(len(severities)), [f"{s:g}" for s in severities])
        axis.set_title(f"{family} ({FAMILIES[family][0]})")
        axis.set_ylim(0, 4 * limit)
    np.ravel(axes)[0].legend(fontsize=7, loc="center left", frameon=False)
    np.ravel(axes)[0].set_ylabel("patch SWD x 1000")
    charts.save(figure, path)


def sheet(folder: Path, path: Path) -> None:
    """Per family its last severity, seed 0: region, ours, crop, truth."""
    found = [(f, cv2.imread(str(folder / f"{f}.png"))) for f in FAMILIES if (folder / f"{f}.png").exists()]
    if not found:
        return
    strips = []
    for family, picture in found:
        text = f"{family}, {FAMILIES[family][1][-1]:g} {FAMILIES[family][0]}"
        cv2.putText(picture, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(picture, text, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
        strips.append(np.pad(picture, ((2, 2), (4, 4), (0, 0)), constant_values=255))
    strips += [np.full_like(strips[0], 255)] * (len(strips) % 2)
    rows = [np.concatenate(strips[i : i + 2], 1) for i in range(0, len(strips), 2)]
    cv2.imwrite(str(path), np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with INDEX.csv and pbr/; without: procedural materials")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist" / "benchmarks" / "stability")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--families", nargs="+", choices=tuple(FAMILIES), default=tuple(FAMILIES))
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no case after so long; go on later")
    parser.add_argument(
        "--coarse", action="store_true", help="first, middle and last severities; a later run adds the rest"
    )
    parser.add_argument("--quick", action="store_true", help="one seed, first and last severities")
    options = parser.parse_args(arguments)
    quick = options.quick
    known, _ = endtoend.known_materials(options.data or make_data(ROOT / "dist" / "benchmarks" / "data"))
    seeds = 1 if quick else options.seeds
    order = np.random.default_rng(5).permutation(len(known))
    any_kind = [known[i] for i in order]
    structured = [k for k in any_kind if k.kind in STRUCTURED]
    parts = records.Parts(options.output, quick, options.minutes)
    rows = []
    for seed in range(seeds):
        for family in options.families:
            chosen = structured if family == "few periods" else any_kind
            material, other = chosen[seed % len(chosen)], any_kind[(seed + 1) % len(any_kind)]
            severities = FAMILIES[family][1]
            if quick or options.coarse:
                some = (0, -1) if quick else (0, len(severities) // 2, -1)
                severities = [severities[i] for i in some]
            for severity in severities:
                picture = (
                    parts.folder / "pictures" / f"{family}.png"
                    if seed == 0 and severity == FAMILIES[family][1][-1]
                    else None
                )

                def make(family=family, severity=severity, material=material, other=other, seed=seed, picture=picture):
                    found = run_case(family, severity, material.read(), other.read(), seed, picture)
                    return [row | {"material": material.name} for row in found]

                rows += parts.get(f"{family} {severity:g} {seed}", make) or []
        print(f"seed {seed}: {len(rows)} rows", flush=True)
    if not rows:
        return 0
    limit = bound([k.read() for k in known])
    summary = summarise(rows, limit)
    ours = [r for r in rows if r["method"] == METHODS[0]]
    about = {
        "side": SIDE, "tile": TILE, "resolution": RESOLUTION, "bound": round(limit, 2), "cases": len(ours),
        "failed": sum(r.get("error", 0) > limit for r in ours) / len(ours),
        "refused": sum(r["refused"] for r in ours) / len(ours),
        "silent": sum(r.get("error", 0) > limit and not r["warned"] for r in ours) / len(ours),
        "baseline_failed": sum(r["error"] > limit for r in rows if r["method"] == METHODS[1]) / len(ours),
        "summary": summary,
    }  # fmt: skip
    records.write(options.output, "stability", rows, about, parts)
    print({k: v for k, v in about.items() if k != "summary"})
    chart(summary, limit, options.output / "stability")
    sheet(parts.folder / "pictures", options.output / "stability.jpg")
    return 0


if __name__ == "__main__":
    sys.exit(main())
