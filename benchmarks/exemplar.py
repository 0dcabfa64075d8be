#!/usr/bin/env python3
"""From a region in the wild to a flat, evenly lit exemplar: error against the severity of each disturbance.

    python benchmarks/exemplar.py --data DATA -o benchmarks/results/exemplar/             about two hours on a core
    python benchmarks/exemplar.py --data DATA --quick -o dist/benchmarks/                 2 minutes

DATA holds INDEX.csv and pbr/<set>/<material>/basecolor.jpg. Of its materials only the test split takes part: all of
polyhaven and every fourth of the other sets. A family of disturbances makes photos of a known texture at growing
severity and judges what the product makes of them; see FAMILIES. Writes exemplar.csv (a row per case; a run that was
stopped goes on from it), exemplar.json (machine, commands, summary), exemplar.svg and .png (the chart), columns.jpg
(columns as seen and unrolled); --minutes 0 draws them again. Needs requirements-benchmarks.txt besides
requirements.txt.
"""

import argparse
import csv
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.benchmarks import charts, lighting, measures  # noqa: E402
from material_palette.benchmarks.records import command, commit, machine  # noqa: E402
from material_palette.core import perceptual, rectification  # noqa: E402
from material_palette.core.cylinder import Cylinder  # noqa: E402
from material_palette.core.engines import patch  # noqa: E402
from material_palette.core.exemplar import cut_exemplar  # noqa: E402
from material_palette.core.image import linear_from_srgb, read_photo, srgb_from_linear  # noqa: E402
from material_palette.core.texture_gradient import AXIS, plane_axes  # noqa: E402
from material_palette.core.torus import resize  # noqa: E402

SAMPLES = 2  # of the rendered photos, per px and axis
FALSE = 20.0  # degrees of error, from which on a claimed plane is a false one
LINED = {"brick", "tiles", "paving", "roof", "facade", "solar"}
LINED_NAMES = (
    "WoodSiding",
    "WoodFloor",
    "wood_fence",
    "wood_road",
    "garage_door",
    "block_wall",
    "tile_",
    "Check",
    "Pannel",
)
UNIFORM = ("Engraved_Metal", "Metal049A", "Plastic007", "Paper001", "Lead", "tile_default_metal")


@dataclass
class Texture:
    """pixels (h, w, 3) float32 linear, tileable; kind "lines" or "stochastic"."""

    name: str
    kind: str
    pixels: np.ndarray
    folder: Path | None = None  # of its maps


@dataclass
class Family:
    """One disturbance. make(texture, severity, random, side) -> a photo; judge(photo, texture, full) -> measures.

    full: also the slow measures. A measure is a number; it is charted against the severity, "before" and "after" as two
    curves of one panel when the names end so.
    """

    axis: str
    severities: tuple[float, ...]
    make: Callable
    judge: Callable
    charted: tuple[tuple[str, str], ...]  # measure, label


@dataclass
class Slanted:
    """A photo of a plane: pixels (side, side, 3) float32 linear, mask; the truth."""

    pixels: np.ndarray
    mask: np.ndarray
    normal: np.ndarray  # (3,), away from the camera
    focal: float
    density: float  # texture px per photo px on the axis
    known: bool


# ---------------------------------------------------------------- slant


def slanted(texture: Texture, slant: float, random: np.random.Generator, side: int, known: bool = True) -> Slanted:
    """A perspective photo at a random tilt, turn, focal length and scale, of a whole frame or of a part of it."""
    tilt, turn = random.uniform(0, 2 * np.pi, 2)
    focal = side * random.uniform(0.7, 1.5)
    density = random.uniform(0.7, 1.3) * min(texture.pixels.shape[:2]) / 640
    c, s = np.cos(np.radians(slant)), np.sin(np.radians(slant))
    normal = np.array([s * np.cos(tilt), s * np.sin(tilt), c])
    pixels, mask = photograph(texture.pixels, normal, focal, (side, side), density, turn, random)
    mask &= shape_of_region(side, random)
    return Slanted(pixels, mask, normal, focal, density, known)


def shape_of_region(side: int, random: np.random.Generator) -> np.ndarray:
    """Half of the regions are the whole frame, the others an ellipse in it."""
    whole = random.random() < 0.5
    centre, axes = random.uniform(0.4, 0.6, 2) * side, random.uniform(0.3, 0.5, 2) * side
    turn = random.uniform(0, 180)
    if whole:
        return np.ones((side, side), bool)
    mask = np.zeros((side, side), np.uint8)
    cv2.ellipse(mask, (tuple(centre), tuple(2 * axes), turn), 1, -1)
    return mask > 0


def photograph(
    texture: np.ndarray, normal: np.ndarray, focal: float, size: tuple[int, int], density: float, turn: float, random
):
    """Photo (h, w, 3) linear of a plane at the distance 1 along the axis, and the mask of what is no farther than 16.

    normal (3,): away from the camera; density: texture px per photo px where seen from the front. SAMPLES x SAMPLES
    point samples a px from a mip map; noise of 1 / 255 and 8 bits.
    """
    h, w = size
    c, s = np.cos(turn), np.sin(turn)
    axes = np.array([[c, s], [-s, c]]) @ plane_axes(normal)
    levels = [np.ascontiguousarray(texture, np.float32)]
    while min(levels[-1].shape[:2]) > 4:
        levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    levels = [np.pad(level, ((1, 2), (1, 2), (0, 0)), mode="wrap") for level in levels]
    start = random.uniform(0, 1000, 2)
    photo, mask = np.zeros((h, w, 3), np.float32), np.ones((h, w), bool)
    for i in range(SAMPLES**2):
        x = (np.arange(w) + (i % SAMPLES + 0.5) / SAMPLES - 0.5 - (w - 1) / 2) / focal
        y = (np.arange(h) + (i // SAMPLES + 0.5) / SAMPLES - 0.5 - (h - 1) / 2) / focal
        ray = np.stack(np.meshgrid(x, y) + [np.ones((h, w))], -1)
        inverse = ray @ normal / normal[2]
        mask &= inverse > 0.06
        point = ray / np.maximum(inverse, 0.06)[..., None] - [0, 0, 1]
        at = point @ axes.T * focal * density
        change = np.maximum(*(np.linalg.norm(np.gradient(at, axis=axis), axis=-1) for axis in (0, 1)))
        depth = np.clip(np.log2(np.maximum(change / SAMPLES, 1e-3)), 0, len(levels) - 1.001)
        for k in range(int(depth.min()), int(depth.max()) + 2):
            weight = np.maximum(0, 1 - np.abs(depth - k)).astype(np.float32)[..., None]
            rows, columns = (n - 3 for n in levels[k].shape[:2])
            u, v = ((at[..., a] + start[a] + 0.5) / 2**k - 0.5 for a in (0, 1))
            place = (u % columns + 1).astype(np.float32), (v % rows + 1).astype(np.float32)
            photo += weight * cv2.remap(levels[k], *place, cv2.INTER_LINEAR)
    encoded = srgb_from_linear(np.clip(photo / SAMPLES**2, 0, 1))
    encoded += (random.standard_normal(encoded.shape) / 255).astype(np.float32)
    return linear_from_srgb(np.rint(encoded.clip(0, 1) * 255) / np.float32(255)), mask


def judge_slanted(photo: Slanted, texture: Texture, full: bool) -> dict:
    start = time.process_time()
    view = rectification.look(photo.pixels, photo.focal if photo.known else None)
    found = rectification.rectify(photo.pixels, photo.mask, view)
    result = {"cpu_seconds": time.process_time() - start, "megapixels": photo.mask.sum() / 1e6}
    result |= claim(found, photo)
    result |= {
        "untouched_error": float(np.degrees(np.arccos(photo.normal[2]))) if not result["claimed"] else "",
        "confidence": found.confidence,
    }
    if full:
        plain = rectification.Rectification(photo.pixels, photo.mask)
        result |= {
            f"swd_{name}": swd_to_flat(one, scale_of(one, photo), texture)
            for name, one in (("before", plain), ("after", found))
        }
    return result


def claim(found: rectification.Rectification, photo: Slanted) -> dict:
    """Whether a plane is claimed, how far its normal is off, in degrees, and whether that makes it a false one."""
    if found.homography is None:
        return {"claimed": 0.0, "normal_error": "", "false": 0.0}
    error = float(np.degrees(np.arccos(np.clip(-found.normal @ photo.normal, -1, 1))))
    return {"claimed": 1.0, "normal_error": error, "false": float(error > FALSE)}


def scale_of(found: rectification.Rectification, photo: Slanted) -> float:
    """Texture px per texel of the true plane in the middle of the exemplar, the geometric mean of both directions."""
    h = found.homography if found.homography is not None else np.eye(3)
    side = photo.mask.shape[0]
    centre = ((side - 1) / 2,) * 2
    to_plane = np.linalg.inv(rectification.plane_to_photo(photo.normal, photo.focal, centre, centre)) @ h
    y, x = (np.median(v) for v in np.nonzero(found.mask))
    bottom = to_plane[2] @ [x, y, 1]
    return np.sqrt(abs(np.linalg.det(to_plane)) / abs(bottom) ** 3) * photo.focal * photo.density


def synthesised(found: rectification.Rectification, size: int) -> np.ndarray:
    """The texture (size, size, 3), sRGB-encoded, that is made of an exemplar."""
    exemplar = cut_exemplar(found.pixels, found.mask)
    concept = patch.learn(srgb_from_linear(np.clip(exemplar.pixels, 0, 1)), exemplar.mask, _quiet)
    return patch.sample(concept, (size, size), 0, _quiet, "draft").pixels


def swd_to_flat(found: rectification.Rectification, scale: float, texture: Texture, size: int = 256) -> float:
    """Patch SWD of the texture synthesised from an exemplar to the true flat one, at `scale` texture px per texel."""
    made = synthesised(found, size)
    tiled = np.tile(texture.pixels, (2, 2, 1))
    w, h = (max(64, round(n / scale)) for n in tiled.shape[1::-1])
    shrink = cv2.INTER_AREA if scale > 1 else cv2.INTER_CUBIC
    flat = srgb_from_linear(np.clip(cv2.resize(tiled, (w, h), interpolation=shrink), 0, 1))
    # the colour is not at stake
    flat = flat + (made.mean((0, 1)) - flat.mean((0, 1)))
    whole = np.ones(flat.shape[:2], bool)
    return measures.sliced_wasserstein(measures.patch_quantiles(made), measures.patch_quantiles(flat, whole))


# ---------------------------------------------------------------- floors

COMPARED = 192  # px of the crops of textures that are compared
MADE = 320  # px of a synthesised texture


def floor(texture: Texture, slant: float, random: np.random.Generator, side: int) -> Slanted:
    """A photo of a floor, near at the bottom, up to its horizon or 16 times the distance of its middle."""
    turn, focal = random.uniform(0, 2 * np.pi), side * random.uniform(0.9, 1.2)
    density = random.uniform(0.7, 1.3) * min(texture.pixels.shape[:2]) / 640
    normal = np.array([0, np.sin(np.radians(slant)), np.cos(np.radians(slant))])
    pixels, mask = photograph(texture.pixels, normal, focal, (side, side), density, turn, random)
    return Slanted(pixels, mask, normal, focal, density, True)


def judge_floor(photo: Slanted, texture: Texture, full: bool) -> dict:
    """Textures of the floor as it is seen and of the floor rectified by its known plane, to the true one, at the scale
    at which the photo would show it from the front: detail that is lost counts."""
    side = len(photo.mask)
    centre = ((side - 1) / 2,) * 2
    to_photo = rectification.plane_to_photo(photo.normal, photo.focal, centre, centre)
    start = time.process_time()
    found = rectification.resample(photo.pixels, photo.mask, to_photo)
    result = {"cpu_seconds": time.process_time() - start, "megapixels": photo.mask.sum() / 1e6}
    if full:
        places = np.random.default_rng(0).random((4, 2, 2))
        flat = resize(texture.pixels, tuple(round(n / photo.density) for n in texture.pixels.shape[:2]))
        flat = srgb_from_linear(np.clip(flat, 0, 1))
        for name, one in (("before", rectification.Rectification(photo.pixels, photo.mask)), ("after", found)):
            scale = scale_of(one, photo) / photo.density  # px seen from the front per texel
            made = resize(synthesised(one, MADE), (round(MADE * scale),) * 2)
            made = np.clip(made + (flat.mean((0, 1)) - made.mean((0, 1))), 0, 1)  # the colour is not at stake
            pairs = [[measures.window(x, at, COMPARED) for x, at in zip((flat, made), p, strict=True)] for p in places]
            result[f"lpips_{name}"] = float(np.mean([perceptual.distance(*pair) for pair in pairs]))
            result[f"scale_{name}"] = 1 / scale
    return result


# ---------------------------------------------------------------- rooms


def courses(random: np.random.Generator, side: int = 640) -> np.ndarray:
    """Blocks in courses (side, side, 3) float32 linear, which tile: what walls have besides a texture."""
    height, width = side // 10, side // 5
    picture = np.full((side, side), 0.3, np.float32) * np.exp(random.normal(0, 0.1, (side, side))).astype(np.float32)
    for row in range(10):
        top, shift = row * height, row % 2 * width // 2
        picture[top : top + 6] = 0.1
        for column in range(5):
            picture[top : top + height, (column * width + shift) % side :][:, :6] = 0.1
    return np.repeat(picture[..., None], 3, 2)


def room(texture: Texture, pitch: float, random: np.random.Generator, side: int) -> Slanted:
    """A photo of the floor in the corner of a room whose walls are of blocks; the camera looks down by some degrees.
    The mask is the floor; the focal length is not known."""
    focal, turn, yaw = side * random.uniform(0.7, 1.2), random.uniform(0, 2 * np.pi), random.uniform(0.4, 1.17)
    density = random.uniform(1.5, 3) * min(texture.pixels.shape[:2]) / 640
    c, s = np.cos(np.radians(pitch)), np.sin(np.radians(pitch))
    down = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    normals = down @ np.array([[0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)], [-np.cos(yaw), 0, np.sin(yaw)]]).T
    grid = (np.arange(side) - (side - 1) / 2) / focal
    rays = np.stack(np.meshgrid(grid, grid) + [np.ones((side, side))], -1)
    inverse = rays @ (normals / normals[2])
    # the walls meet in the middle, the floor begins up to 15 % of the side below it
    inverse[..., 0] *= (inverse[..., 1:].max(-1) / inverse[..., 0])[int(side * random.uniform(0.5, 0.65)), side // 2]
    nearest = inverse.argmax(-1)
    photo = np.zeros((side, side, 3), np.float32)
    for i, (pixels, px) in enumerate([(texture.pixels, density), (courses(random), 2.0), (courses(random), 2.0)]):
        # courses run along the floor
        right, below = plane_axes(normals[:, i]) @ np.cross(normals[:, 0], normals[:, i])
        along = np.arctan2(below, right) if i else turn
        seen, _ = photograph(pixels, normals[:, i], focal, (side, side), px, along, random)
        photo[nearest == i] = seen[nearest == i]
    return Slanted(photo, nearest == 0, normals[:, 0], focal, density, False)


def judge_room(photo: Slanted, texture: Texture, full: bool) -> dict:
    """The floor's plane by its own texture alone, and by the frame of the photo's lines too."""
    start = time.process_time()
    view, result = rectification.look(photo.pixels), {}
    framed = view.frame
    for name, view.frame in (("before", None), ("after", framed)):
        found = claim(rectification.rectify(photo.pixels, photo.mask, view), photo)
        result |= {f"{measure}_{name}": value for measure, value in found.items()}
    return result | {"cpu_seconds": time.process_time() - start, "megapixels": photo.mask.sum() / 1e6}


# ---------------------------------------------------------------- turned in the photo's plane


@dataclass
class Turned:
    """A photo of a texture from the front: pixels (side, side, 3) float32 linear; its rows lie at `degrees`."""

    pixels: np.ndarray
    degrees: float


def turned(texture: Texture, degrees: float, random: np.random.Generator, side: int) -> Turned:
    """The rows to the right and down by so many degrees, at a random scale and place."""
    density = random.uniform(0.7, 1.3) * min(texture.pixels.shape[:2]) / 640
    pixels, _ = photograph(texture.pixels, AXIS, side, (side, side), density, np.radians(degrees), random)
    return Turned(pixels, degrees)


def judge_turned(photo: Turned, texture: Texture, full: bool) -> dict:
    """left: degrees between the texture's rows or columns and the exemplar's."""
    start, mask = time.process_time(), np.ones(photo.pixels.shape[:2], bool)
    found = rectification.rectify(photo.pixels, mask, rectification.look(photo.pixels))
    seconds, angle = time.process_time() - start, 0.0
    if found.homography is not None:
        middle = np.array(found.mask.shape[::-1]) / 2
        (x0, y0), (x1, y1) = cv2.perspectiveTransform(np.array([[middle, middle + [1, 0]]]), found.homography)[0]
        angle = np.degrees(np.arctan2(y1 - y0, x1 - x0))
    return {
        "cpu_seconds": seconds,
        "megapixels": mask.sum() / 1e6,
        "claimed": float(found.method == "turned"),
        "flattened": float(found.method in ("auto", "cylinder")),
        "left": abs((photo.degrees - angle + 45) % 90 - 45),
    }


# ---------------------------------------------------------------- curved


@dataclass
class Curved:
    """A photo of a column from afar: pixels (side, side, 3) float32 linear, mask; the truth."""

    pixels: np.ndarray
    mask: np.ndarray
    cylinder: Cylinder | None
    density: float  # texture px per px of the surface


def curved(texture: Texture, half_angle: float, random: np.random.Generator, side: int) -> Curved:
    """A column that fills the photo's width up to this angle from its middle, standing, lying or leaning."""
    angle, turn = random.uniform(0, np.pi), random.uniform(0, 2 * np.pi)
    density = random.uniform(0.7, 1.3) * min(texture.pixels.shape[:2]) / 640
    across, centre, fine = np.array([np.cos(angle), np.sin(angle)]), np.full(2, (side - 1) / 2), 3
    half = side / 2 * 0.9
    cylinder = Cylinder(across, float(centre @ across), half / np.sin(np.radians(half_angle))) if half_angle else None
    u, v = np.meshgrid(*[(np.arange(side * fine) + 0.5) / fine - 0.5] * 2)
    points = np.stack([u.ravel(), v.ravel()], -1)
    mask = (np.abs((points - centre) @ across) <= half).reshape(side, fine, side, fine).all((1, 3))
    flat = points if cylinder is None else cylinder.unrolled(points)
    c, s = np.cos(turn), np.sin(turn)
    at = (flat @ np.array([[c, s], [-s, c]]) * density + random.uniform(0, 1000, 2)).reshape(side * fine, -1, 2)
    h, w = texture.pixels.shape[:2]
    wrapped = np.pad(texture.pixels, ((1, 2), (1, 2), (0, 0)), mode="wrap")
    at = (at % (w, h) + 1).astype(np.float32)
    photo = cv2.resize(cv2.remap(wrapped, at, None, cv2.INTER_LINEAR), (side, side), interpolation=cv2.INTER_AREA)
    encoded = srgb_from_linear(photo.clip(0, 1)) + (random.standard_normal(photo.shape) / 255).astype(np.float32)
    return Curved(linear_from_srgb(np.rint(encoded.clip(0, 1) * 255) / np.float32(255)), mask, cylinder, density)


def judge_curved(photo: Curved, texture: Texture, full: bool) -> dict:
    start = time.process_time()
    found = rectification.rectify(photo.pixels, photo.mask, rectification.look(photo.pixels))
    result = {
        "cpu_seconds": time.process_time() - start,
        "megapixels": photo.mask.sum() / 1e6,
        "claimed": float(found.method == "cylinder"),
        "flattened": float(found.homography is not None),
        "stretch_before": stretch(rectification.Rectification(photo.pixels, photo.mask), photo),
        "stretch_after": stretch(found, photo),
    }
    if full:
        plain = rectification.Rectification(photo.pixels, photo.mask)
        result |= {
            f"swd_{name}": swd_to_flat(one, photo.density * scale_on(one, photo), texture)
            for name, one in (("before", plain), ("after", found))
        }
    return result


def _texels_on_surface(found: rectification.Rectification, photo: Curved) -> np.ndarray:
    """(n, 2, 2) derivatives of the true surface, laid flat, by the exemplar's px, at some of these."""
    y, x = np.nonzero(found.mask)
    at = np.stack([x, y], -1)[:: max(1, len(x) // 2000)].astype(float)

    def surface(points: np.ndarray) -> np.ndarray:
        if found.cylinder is not None:
            points = found.cylinder.rolled(points @ found.to_surface[:, :2].T + found.to_surface[:, 2])
        elif found.homography is not None:
            points = cv2.perspectiveTransform(points[None], found.homography)[0]
        return points if photo.cylinder is None else photo.cylinder.unrolled(points)

    return np.stack([surface(at + step) - surface(at - step) for step in ((0.5, 0), (0, 0.5))], -1)


def stretch(found: rectification.Rectification, photo: Curved) -> float:
    """How unlike the exemplar's texels are on the surface: standard deviation of the logarithm of their sides' ratio
    and of their scale; 0 when all are squares of one size."""
    long, short = np.maximum(np.linalg.svd(_texels_on_surface(found, photo), compute_uv=False), 1e-3).T
    return float(np.sqrt((np.log(long / short) ** 2).mean() + np.log(long * short).std() ** 2 / 4))


def scale_on(found: rectification.Rectification, photo: Curved) -> float:
    """Px of the surface per texel, the median of the geometric means of both directions."""
    return float(np.median(np.sqrt(np.abs(np.linalg.det(_texels_on_surface(found, photo))))))


def _quiet(fraction: float, message: str) -> None:
    pass


SHARES = ("claimed", "false", "flattened", "shadow", "changed")
SLANTS = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 75.0)
SLANT_CURVES = (
    ("normal_error", "error of the normal, degrees"),
    ("claimed", "share rectified"),
    ("swd", "patch SWD to the flat texture"),
)
FAMILIES = {
    "slant": Family("slant, degrees; focal length known", SLANTS, slanted, judge_slanted, SLANT_CURVES),
    "slant-focal": Family(
        "slant, degrees; focal length not known",
        SLANTS,
        lambda texture, severity, random, side: slanted(texture, severity, random, side, known=False),
        judge_slanted,
        SLANT_CURVES[:2],
    ),
    "floor": Family(
        "slant of a floor, degrees; plane known",
        (45.0, 60.0, 70.0, 75.0),
        floor,
        judge_floor,
        (("lpips", "ST-LPIPS to the flat texture"), ("scale", "texels per px seen from the front")),
    ),
    "room": Family(
        "floor of a room: camera down, degrees",
        (5.0, 10.0, 20.0, 30.0, 40.0),
        room,
        judge_room,
        (("normal_error", "error of the normal, degrees"), ("claimed", "share rectified")),
    ),
    "curved": Family(
        "half-angle seen of a column, degrees",
        (0.0, 30.0, 45.0, 60.0, 75.0),
        curved,
        judge_curved,
        (("stretch", "stretch of the texels, log"), ("claimed", "share unrolled"), SLANT_CURVES[2]),
    ),
    "turned": Family(
        "degrees in the photo's plane",
        (0.0, 2.0, 5.0, 10.0, 20.0, 40.0),
        turned,
        judge_turned,
        (("left", "degrees to the exemplar's rows or columns"), ("claimed", "share turned")),
    ),
}
for _name, (_axis, _severities) in lighting.FAMILIES.items():
    _curves = (("foreign", "share of foreign pixels"),) if _name == "foreign" else tuple(lighting.CURVES.items())
    if _name == "two tones":
        _curves = (("changed", "share changed noticeably"),)
    FAMILIES[_name] = Family(_axis, _severities, lighting.make(_name), lighting.judge, _curves)


# ---------------------------------------------------------------- running


def read_textures(data: Path) -> list[Texture]:
    """The test split's base colours that have a texture at all, sorted by path."""
    with open(data / "INDEX.csv", encoding="utf-8") as file:
        rows = sorted((row for row in csv.DictReader(file) if row["kind"] == "pbr"), key=lambda row: row["path"])
    sets = {}
    for row in rows:
        sets.setdefault(row["path"].split("/")[1], []).append(row)
    found = []
    for name, members in sets.items():
        for row in members if name == "polyhaven" else members[3::4]:
            if any(part in row["path"] for part in UNIFORM):
                continue
            lined = row["class"] in LINED or any(part in row["path"] for part in LINED_NAMES)
            pixels = read_photo(data / row["path"] / "basecolor.jpg").pixels
            found.append(Texture(row["path"][4:], "lines" if lined else "stochastic", pixels, data / row["path"]))
    return found


def run(
    textures: list[Texture], families: list[str], every: int, side: int, slow: int, path: Path, limit: float
) -> list[dict]:
    """Rows of the CSV at `path`, which is added to: a case that stands there is not run again.

    every: one texture of so many takes part; slow: of so many of these the slow measures are taken too; limit: seconds
    after which no case is begun.
    """
    rows = []
    if path.exists():
        with open(path, encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    done = {(row["family"], float(row["severity"]), row["texture"]) for row in rows}
    start = time.monotonic()
    chosen = range(0, len(textures), every)
    measured = set(chosen[:: max(1, len(chosen) // slow)]) if slow else set()
    cases = [(name, severity, i) for i in chosen for name in families for severity in FAMILIES[name].severities]
    # in an order that gives all severities and all textures a share of a run that is stopped
    order = np.random.default_rng(0).permutation(len(cases))
    for name, severity, i in (cases[k] for k in order):
        texture = textures[i]
        if (name, severity, texture.name) in done or time.monotonic() - start > limit:
            continue
        family = FAMILIES[name]
        photo = family.make(texture, severity, np.random.default_rng([i, int(severity)]), side)
        judged = family.judge(photo, texture, i in measured)
        judged = {k: float(f"{v:.5g}") if isinstance(v, float) else v for k, v in judged.items()}
        rows.append({"family": name, "severity": severity, "texture": texture.name, "kind": texture.kind} | judged)
        columns = list(dict.fromkeys(key for row in rows for key in row))
        whole = path.with_suffix(".new")
        with open(whole, "w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, columns, lineterminator="\n", restval="")
            writer.writeheader()
            writer.writerows(rows)
        whole.replace(path)
        print(name, severity, texture.name, judged, flush=True)
    return rows


def summarise(rows: list[dict]) -> dict:
    """Per family, kind and severity the number of cases, and of every measure the median, or the mean of a share."""
    summary = {}
    keys = sorted({(row["family"], row["kind"], float(row["severity"])) for row in rows})
    for family, kind, severity in keys:
        own = [row for row in rows if (row["family"], row["kind"], float(row["severity"])) == (family, kind, severity)]
        entry = {"cases": len(own)}
        for measure in own[0].keys() - {"family", "severity", "texture", "kind"}:
            values = [float(row[measure]) for row in own if row.get(measure) not in ("", None)]
            if values:
                share = measure.removesuffix("_before").removesuffix("_after") in SHARES
                entry[measure] = float(f"{(np.mean if share else np.median)(values):.4g}")
        summary.setdefault(family, {}).setdefault(kind, {})[f"{severity:g}"] = dict(sorted(entry.items()))
    return summary


def write_chart(summary: dict, folder: Path) -> None:
    """A row of panels per family: each measure's median against the severity, per kind of texture, before and after."""
    plt = charts.plt()
    if plt is None:
        return
    names = [name for name in FAMILIES if name in summary]
    across = max(len(FAMILIES[name].charted) for name in names)
    figure, axes = plt.subplots(len(names), across, figsize=(3.4 * across, 2.7 * len(names)), squeeze=False)
    for row, name in zip(axes, names, strict=True):
        for place in row[len(FAMILIES[name].charted) :]:
            place.set_visible(False)
        for place, (measure, label) in zip(row, FAMILIES[name].charted, strict=False):
            for kind, colour in (("lines", "tab:red"), ("stochastic", "tab:blue")):
                for suffix, style, said in (("_before", ":", ", as seen"), ("_after", "-", ""), ("", "-", "")):
                    curve = [
                        (float(severity), entry[measure + suffix])
                        for severity, entry in summary[name].get(kind, {}).items()
                        if measure + suffix in entry
                    ]
                    if curve:
                        place.plot(
                            *zip(*sorted(curve), strict=True), style, color=colour, marker=".", label=kind + said
                        )
            place.set_xlabel(FAMILIES[name].axis)
            place.set_ylabel(label)
            place.set_ylim(bottom=0)
            place.grid(lw=0.3, alpha=0.5)
            if place.lines:
                place.legend(fontsize=7)
    charts.save(figure, folder / "exemplar")


def write_columns(textures: list[Texture], folder: Path, half_angle: float = 75.0, side: int = 448) -> None:
    """columns.jpg: columns as they are seen, and what is learnt from; of four textures with CC0 maps, if there are."""
    rows, shown = [], [t for t in textures if t.name.startswith("polyhaven/")][:4]
    if len(shown) < 4:
        return
    for i, texture in enumerate(shown):
        photo = curved(texture, half_angle, np.random.default_rng([i, 1]), side)
        found = rectification.rectify(photo.pixels, photo.mask, rectification.look(photo.pixels))
        exemplar = cut_exemplar(found.pixels, found.mask).picture()
        seen = np.rint(255 * srgb_from_linear(np.where(photo.mask[..., None], photo.pixels, 0.01))).astype(np.uint8)
        scale = min(1.0, side / exemplar.shape[0], 1.6 * side / exemplar.shape[1])
        exemplar = cv2.resize(exemplar, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        down, right = side - exemplar.shape[0], int(1.6 * side) - exemplar.shape[1]
        exemplar = np.pad(exemplar, ((0, down), (0, right), (0, 0)), constant_values=25)
        rows.append(np.hstack([seen, np.full((side, 8, 3), 255, np.uint8), exemplar]))
    sheet = np.vstack([np.hstack(rows[k : k + 2]) for k in range(0, len(rows), 2)])
    cv2.imwrite(str(folder / "columns.jpg"), sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, required=True, metavar="DATA", help="folder with INDEX.csv and pbr/")
    parser.add_argument("--quick", action="store_true", help="the same as --every 16 --side 448 --slow 0")
    parser.add_argument("--every", type=int, default=0, metavar="N", help="one texture of N takes part (1)")
    parser.add_argument("--families", nargs="+", choices=list(FAMILIES), default=list(FAMILIES), metavar="NAME")
    parser.add_argument("--side", type=int, default=0, help="px of the photos (1000)")
    parser.add_argument("--slow", type=int, default=8, metavar="N", help="textures that are synthesised too, about (8)")
    parser.add_argument("--minutes", type=float, default=1e6, help="stop after; the next call goes on")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    textures, every = read_textures(options.data), options.every or (16 if options.quick else 1)
    side, slow = options.side or (448 if options.quick else 1000), 0 if options.quick else options.slow
    options.output.mkdir(parents=True, exist_ok=True)
    start = time.time()
    path = options.output / "exemplar.csv"
    done = sum(1 for _ in open(path, encoding="utf-8")) - 1 if path.exists() else 0
    rows = run(textures, options.families, every, side, slow, path, 60 * options.minutes)
    summary = summarise(rows)
    facts_path = options.output / "exemplar.json"
    before = json.loads(facts_path.read_text(encoding="utf-8")) if facts_path.exists() and done else {}
    new = len(rows) > done  # else only the chart and the picture are drawn again
    facts = {
        "commands": sorted({*before.get("commands", []), *[command()] * new}),
        "commits": sorted({*before.get("commits", []), *[commit()] * new}),
        "machine": machine(),
        "minutes": round(before.get("minutes", 0) + (time.time() - start) / 60, 1),
        "side": side,
        "false_share": {
            name: float(f"{np.mean(shares):.4g}")
            for name in summary
            if (shares := [float(r["false"]) for r in rows if r["family"] == name and r.get("false") not in (None, "")])
        },
        "summary": summary,
    }
    facts_path.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    write_chart(summary, options.output)
    if "curved" in summary:
        write_columns(textures, options.output)
    print(json.dumps(facts["false_share"]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
