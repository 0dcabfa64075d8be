"""Disturbances of light, exposure and painting, made of known textures, for `exemplar.py`.

A `Case` is what a photo shows of a known surface. Sun and sky differ in colour, relief is seen under the sun only, the
camera rounds to 8 bits and adds noise, as photos do.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from material_palette.core.image import linear_from_srgb, srgb_from_linear

SIDE = 512  # px of a case
SUN = np.array([1.08, 1.0, 0.86], np.float32)
SKY = np.array([0.78, 0.98, 1.28], np.float32)
NOISE = 0.6 / 255  # of an encoded pixel


@dataclass
class Surface:
    """albedo (H, W, 3) float32 linear and normal (H, W, 3), +Y up, of SIDE x SIDE px."""

    name: str
    albedo: np.ndarray
    normal: np.ndarray


@dataclass
class Case:
    """photo and truth (H, W, 3) float32 linear, the truth divided by the light that falls on a flat surface.

    mask (H, W) bool, the region as painted; light (H, W) float32, the luminance of what falls on each pixel; foreign
    (H, W) bool, painted but of another material.
    """

    photo: np.ndarray
    truth: np.ndarray
    mask: np.ndarray
    light: np.ndarray
    foreign: np.ndarray


def materials(data: Path, training: bool = False) -> list[Path]:
    """Folders of test materials, or of those to tune on: the split of `training/analytic.py`."""
    found = []
    for collection in sorted((data / "pbr").iterdir()):
        if collection.name.endswith("-derived"):
            continue
        for i, folder in enumerate(sorted(collection.iterdir())):
            held_out = collection.name == "polyhaven" or i % 4 == 3
            if held_out != training and (folder / "basecolor.jpg").exists() and (folder / "normal.jpg").exists():
                found.append(folder)
    return found


def read_surface(folder: Path) -> Surface:
    """A material at its own scale, repeated or cut to SIDE x SIDE px."""
    maps = []
    for name in ("basecolor", "normal"):
        pixels = cv2.imread(str(folder / f"{name}.jpg"))[..., ::-1].astype(np.float32) / 255
        pixels = np.tile(pixels, (-(-SIDE // pixels.shape[0]), -(-SIDE // pixels.shape[1]), 1))
        maps.append(pixels[:SIDE, :SIDE])
    albedo = np.maximum(linear_from_srgb(maps[0]), 0.004)
    normal = maps[1] * 2 - 1
    return Surface(folder.name, albedo, normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6))


def two_tone(kind: str, seed: int = 0) -> Surface:
    """What must not be taken for a shadow: chequers, bricks, planks, stains, a dado, painted stripes."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    grain = _noise(random, 1.2) * 0.06 + _noise(random, 8) * 0.05
    dark, light = np.array([0.16, 0.13, 0.11]), np.array([0.55, 0.5, 0.44])
    if kind == "chequers":
        side = random.choice([64, 85, 128])
        share = ((v // side + u // side) % 2).astype(np.float32)
        light, dark = np.full(3, 0.6), np.full(3, 0.15)
    elif kind == "bricks":
        row = v // 48
        share = ((v % 48 < 6) | ((u + 48 * (row % 2)) % 96 < 6)).astype(np.float32)
        tone = random.normal(0, 0.15, (20, 20))[row.astype(int), ((u + 48 * (row % 2)) // 96).astype(int)]
        grain = grain + tone * (1 - share)
        dark = np.array([0.3, 0.12, 0.08])
    elif kind == "planks":
        board = (u // 73).astype(int)
        share = random.uniform(0, 1, 20)[board]
        grain = grain + cv2.GaussianBlur(random.standard_normal((SIDE, SIDE)).astype(np.float32), (0, 0), 1, sigmaY=20)
        share = np.where(u % 73 < 2, 0, share)
        dark = np.array([0.1, 0.06, 0.03])
    elif kind == "stains":
        share = 1 / (1 + np.exp(-14 * (_noise(random, 45) + 0.4)))
        dark = light * np.array([0.62, 0.52, 0.40])
    elif kind == "dado":
        share = (v < 0.55 * SIDE).astype(np.float32)
        dark = light * np.array([0.35, 0.6, 0.5])
    else:
        share = (np.sin(2 * np.pi * (u + 0.2 * v) / 110) > 0).astype(np.float32)
        dark = light * np.array([0.7, 0.3, 0.25])
    colour = light * share[..., None] + dark * (1 - share[..., None])
    normal = np.zeros((SIDE, SIDE, 3), np.float32)
    normal[..., 2] = 1
    return Surface(kind, np.clip(colour * np.exp(grain)[..., None], 0.004, 0.9).astype(np.float32), normal)


TWO_TONES = ("chequers", "bricks", "planks", "stains", "dado", "stripes")


def case(surface: Surface, family: str, severity: float, seed: int, other: Surface | None = None) -> Case:
    """The surface photographed under a disturbance of FAMILIES; `other` is what is painted over by mistake."""
    random = np.random.default_rng(seed)
    mask = np.ones((SIDE, SIDE), bool) if seed % 2 else _painted(random)
    azimuth = random.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(azimuth) * 0.6, np.sin(azimuth) * 0.6, 0.8], np.float32)
    relief = np.maximum(surface.normal @ sun, 0.05) / 0.8
    # skies differ: from grey, as indoors or under haze, to deep blue
    blue = random.uniform(0.1, 1)
    sky_colour, sun_colour = 1 + blue * (SKY - 1), 1 + blue * (SUN - 1)
    sky = (0.5 + 0.5 * surface.normal[..., 2])[..., None] * sky_colour
    direct = relief[..., None] * sun_colour
    share = 0.35  # of the sky in the light where the sun shines, unless the severity says otherwise
    lit = np.ones((SIDE, SIDE), np.float32)
    scale = np.ones((SIDE, SIDE), np.float32)
    foreign = np.zeros((SIDE, SIDE), bool)
    if family in ("hard shadow", "soft shadow", "striped shadow", "leaf shadow"):
        share = 1 / severity
        lit = _shadow(family, random)
    elif family == "ramp":
        along = _along(random)
        scale = 1 + (severity - 1) * along
    elif family == "vignetting":
        v, u = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j].astype(np.float32)
        centre = random.uniform(-0.3, 0.3, 2)
        radius = (u - centre[0]) ** 2 + (v - centre[1]) ** 2
        scale = 1 / (1 + (severity**0.5 - 1) * radius / radius.max()) ** 2
    sun_there = ((1 - share) * lit)[..., None]
    seen = surface.albedo * (sky * share + direct * sun_there)
    # what the light would be on a flat surface
    flat_sky, flat_sun = sky_colour * share, sun_colour * sun_there
    truth = seen / (flat_sky + flat_sun) * (sky_colour * share + sun_colour * (1 - share))
    exposure = 0.7 / np.percentile(truth, 99)
    photo, truth = seen * scale[..., None] * exposure, truth * exposure
    if family == "ramp":
        photo /= severity
    if family == "clipping" and severity:
        photo *= _pool(random, photo, severity)[..., None]
    if family == "foreign" and severity:
        foreign = _strip(random, mask, severity)
        stranger = other.albedo * (flat_sky + flat_sun)
        exposure = min(exposure, 0.9 / np.percentile(stranger, 99))
        photo = np.where(foreign[..., None], stranger * exposure, photo)
    encoded = srgb_from_linear(np.clip(photo, 0, 1)) + NOISE * random.standard_normal(photo.shape)
    photo = linear_from_srgb(np.rint(np.clip(encoded, 0, 1) * 255) / 255)
    return Case(photo, truth.astype(np.float32), mask, scale * (share + (1 - share) * lit), foreign)


FAMILIES: dict[str, tuple[str, tuple[float, ...]]] = {
    "ramp": ("brightest to darkest", (1, 2, 4, 8)),
    "vignetting": ("centre to corner", (1, 1.5, 2, 3)),
    "hard shadow": ("lit to shaded", (1.5, 2, 3, 5, 8)),
    "soft shadow": ("lit to shaded", (1.5, 2, 3, 5, 8)),
    "striped shadow": ("lit to shaded", (2, 3, 5)),
    "leaf shadow": ("lit to shaded", (2, 3, 5)),
    "clipping": ("share over-exposed", (0, 0.1, 0.2, 0.4)),
    "foreign": ("share of another material", (0, 0.05, 0.1, 0.2, 0.4)),
}
CLEAN = {"ramp": 1, "vignetting": 1, "clipping": 0, "foreign": 0}  # severity at which nothing is wrong


def _noise(random: np.random.Generator, sigma: float) -> np.ndarray:
    noise = cv2.GaussianBlur(random.standard_normal((SIDE, SIDE)).astype(np.float32), (0, 0), sigma)
    return noise / noise.std()


def _painted(random: np.random.Generator) -> np.ndarray:
    """A region as a person paints it: round, wavy."""
    v, u = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    angle = np.arctan2(v, u)
    radius = 0.85 + sum(0.1 / k * np.cos(k * angle + random.uniform(0, 6.28)) for k in (2, 3, 5))
    return np.hypot(u, v) < radius


def _along(random: np.random.Generator) -> np.ndarray:
    """(H, W) 0 to 1 across the picture in some direction."""
    v, u = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j].astype(np.float32)
    angle = random.uniform(0, 2 * np.pi)
    x = u * np.cos(angle) + v * np.sin(angle)
    return (x - x.min()) / np.ptp(x)


def _shadow(family: str, random: np.random.Generator) -> np.ndarray:
    """(H, W) share of the sun that arrives."""
    x = 2 * _along(random) - 1
    wave = 0.06 * _noise(random, 40)
    if family == "striped shadow":
        lit = (np.sin(x * random.uniform(6, 10) + wave * 4) > random.uniform(-0.3, 0.3)).astype(np.float32)
        return cv2.GaussianBlur(lit, (0, 0), 2.5)
    if family == "leaf shadow":
        lit = (_noise(random, 22) > random.uniform(-0.3, 0.3)).astype(np.float32)
        return cv2.GaussianBlur(lit, (0, 0), 4)
    lit = (x + wave > random.uniform(-0.15, 0.15)).astype(np.float32)
    return cv2.GaussianBlur(lit, (0, 0), 1.0 if family == "hard shadow" else SIDE / 40)


def _pool(random: np.random.Generator, photo: np.ndarray, share: float) -> np.ndarray:
    """A pool of light that clips this share of the pixels."""
    v, u = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j].astype(np.float32)
    centre = random.uniform(-0.4, 0.4, 2)
    radius = np.hypot(u - centre[0], v - centre[1])
    size = np.sqrt(4 * share / np.pi)
    pool = 1 / (1 + np.exp((radius - size) / 0.05))
    # as bright as it takes for half of the pool's darker pixels to clip too
    inside = photo.max(-1)[radius < size]
    return 1 + pool * (1.3 / max(np.percentile(inside, 30), 1e-3) - 1)


def _strip(random: np.random.Generator, mask: np.ndarray, share: float) -> np.ndarray:
    """The part of the region, of this share, beyond a wavy line: painted over the edge."""
    x = _along(random) + 0.02 * _noise(random, 30)
    return mask & (x < np.percentile(x[mask], 100 * share))


Render = Callable[[Surface, float, int], Case]
