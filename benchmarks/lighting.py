"""Disturbances of light, exposure and painting, made of known textures, for `exemplar.py`.

A `Case` is what a photo shows of a known surface. Sun and sky differ in colour, relief is seen under the sun only, the
camera rounds to 8 bits and adds noise, as photos do.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..core.delighting import masked_blur
from ..core.exemplar import LUMINANCE, cut_exemplar
from ..core.image import linear_from_srgb, srgb_from_linear
from . import measures

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
    if family == "sheen":
        # a broad reflection adds white light; nothing clips
        centre, (v, u) = random.uniform(-0.4, 0.4, 2), np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
        gloss = severity * np.exp(-((u - centre[0]) ** 2 + (v - centre[1]) ** 2) / 0.3).astype(np.float32)
        mean = float((photo @ LUMINANCE).mean())
        exposure /= 1 + severity / 2
        photo, truth = ((x / (1 + severity / 2)) for x in (photo + mean * gloss[..., None], truth))
        scale = 1 + gloss
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
    "sheen": ("reflection over mean brightness", (0.25, 0.5, 1)),
    "foreign": ("share of another material", (0, 0.05, 0.1, 0.2, 0.4)),
    "two tones": ("chequers, bricks, planks, stains, dado, stripes", (0, 1, 2, 3, 4, 5)),
}
CURVES = {
    "halves": "CIEDE2000, lit to shaded half",
    "contrast": "contrast of the detail, found / true",
    "swd": "patch SWD to the truth x 1000",
}


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


# ---------------------------------------------------------------- judging

SOME = 7  # one pixel of so many is judged by its colour
NOTICEABLE = 2.0  # CIEDE2000, mean over the pixels of a clean exemplar


def colour_difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """CIEDE2000 (Sharma et al. 2005) of linear Rec.709 colours (..., 3)."""
    lab = [
        cv2.cvtColor(srgb_from_linear(np.clip(x, 0, 1)).reshape(1, -1, 3), cv2.COLOR_RGB2LAB)[0]
        for x in (first, second)
    ]
    (l1, a1, b1), (l2, a2, b2) = (np.moveaxis(x.astype(np.float64), -1, 0) for x in lab)
    chroma = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    stretch = 1.5 - 0.5 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))
    a1, a2 = a1 * stretch, a2 * stretch
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = np.degrees(np.arctan2(b1, a1)) % 360, np.degrees(np.arctan2(b2, a2)) % 360
    turn = np.where(c1 * c2 == 0, 0, (h2 - h1 + 180) % 360 - 180)
    hue = np.where(c1 * c2 == 0, h1 + h2, (h1 + turn / 2) % 360)
    light, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    dl, dc, dh = l2 - l1, c2 - c1, 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))

    def cosine(degrees):
        return np.cos(np.radians(degrees))

    t = 1 - 0.17 * cosine(hue - 30) + 0.24 * cosine(2 * hue) + 0.32 * cosine(3 * hue + 6) - 0.2 * cosine(4 * hue - 63)
    sl = 1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2)
    sc, sh = 1 + 0.045 * chroma, 1 + 0.015 * chroma * t
    rotation = (
        -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7)) * np.sin(np.radians(60 * np.exp(-(((hue - 275) / 25) ** 2))))
    )
    return np.sqrt((dl / sl) ** 2 + (dc / sc) ** 2 + (dh / sh) ** 2 + rotation * dc / sc * dh / sh)


def _judged(case: Case, pixels: np.ndarray, kept: np.ndarray, truth: list) -> dict[str, float]:
    """How far pixels (H, W, 3) linear are from the truth over what is kept (H, W) bool.

    halves: CIEDE2000 between the mean colour as found on the brighter and on the darker half; contrast: of the detail,
    found over true; error: CIEDE2000 per pixel, exposures matched; swd: of the patches to those of the whole truth,
    x 1000, exposures matched. truth: those patches.
    """
    own = kept & ~case.foreign
    gain = np.log(np.maximum(pixels, 1e-4) / np.maximum(case.truth, 1e-4))
    low, high = np.percentile(case.light[case.mask], (2, 98))
    bright = case.light > np.sqrt(low * high)
    halves = np.nan
    if high > 1.05 * low and min((own & bright).sum(), (own & ~bright).sum()) > 500:
        first, second = (np.median(gain[own & side], 0) for side in (bright, ~bright))
        middle = np.log(case.truth[case.mask].mean(0)) - np.mean(first + second) / 2
        halves = float(colour_difference(np.exp(middle + first)[None], np.exp(middle + second)[None])[0])
    spread = []
    for x in (pixels, case.truth):
        y = np.log(np.maximum(x @ LUMINANCE, 1e-3))
        spread.append(float((y - masked_blur(y, own, SIDE / 40))[own].std()))
    exposure = np.exp(-np.median(gain[own]))
    swd = 1000 * measures.sliced_wasserstein(patches(pixels * exposure, kept), truth)
    error = float(colour_difference(*((x[own])[::SOME] for x in (pixels * exposure, case.truth))).mean())
    return {"halves": halves, "contrast": spread[0] / spread[1], "error": error, "swd": swd}


def patches(pixels: np.ndarray, mask: np.ndarray) -> list:
    """`measures.patch_quantiles` of linear pixels at half their size."""
    size = mask.shape[1] // 2, mask.shape[0] // 2
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    inside = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    return measures.patch_quantiles(srgb_from_linear(np.clip(small, 0, 1)), inside)


def judge(case: Case, texture, full: bool) -> dict:
    """Before: the photo as painted; after: the exemplar."""
    start = time.process_time()
    exemplar = cut_exemplar(case.photo, case.mask)
    seconds = time.process_time() - start
    rows, columns = np.flatnonzero(case.mask.any(1)), np.flatnonzero(case.mask.any(0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    pixels, kept = case.photo.copy(), np.zeros_like(case.mask)
    pixels[box], kept[box] = exemplar.pixels, exemplar.mask
    truth = patches(case.truth, case.mask)
    row = {f"{name}_before": value for name, value in _judged(case, case.photo, case.mask, truth).items()}
    row |= {f"{name}_after": value for name, value in _judged(case, pixels, kept, truth).items()}
    foreign = case.foreign.sum()
    photo = case.photo * np.exp(np.median(np.log(np.maximum(pixels, 1e-4) / np.maximum(case.photo, 1e-4))[kept]))
    changed = float(colour_difference(photo[kept][::SOME], pixels[kept][::SOME]).mean())
    lost = float((case.mask & ~case.foreign & ~kept).sum() / (case.mask & ~case.foreign).sum())
    shadow = any("cast shadow" in warning for warning in exemplar.warnings)
    row |= {
        "cpu_seconds": seconds,
        "megapixels": case.mask.sum() / 1e6,
        "foreign_before": float(foreign / case.mask.sum()),
        "foreign_after": float((kept & case.foreign).sum() / kept.sum()),
        "lost": lost,
        "shadow": float(shadow),
        "change": changed,
        "changed": float(changed > NOTICEABLE or lost > 0.02 or shadow),
    }
    return {key: "" if value != value else value for key, value in row.items()}


def make(family: str) -> Callable:
    """What `exemplar.py` calls for a photo of a texture; the photo's side is SIDE."""

    def photographed(texture, severity: float, random: np.random.Generator, side: int) -> Case:
        seed = int(random.integers(1 << 30))
        if family == "two tones":
            return case(two_tone(TWO_TONES[int(severity)], seed), "ramp", 1, seed)
        stranger = _neighbour(texture.folder) if family == "foreign" and severity else None
        return case(read_surface(texture.folder), family, severity, seed, stranger and read_surface(stranger))

    return photographed


def _neighbour(folder: Path) -> Path:
    """The next material of the set."""
    others = [other for other in sorted(folder.parent.iterdir()) if (other / "normal.jpg").exists()]
    return others[(others.index(folder) + 1) % len(others)]
