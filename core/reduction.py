"""What a material does not need: the smallest maps whose rendering cannot be told from that of the full ones.

Claim: every map becomes a value, or as few texels and bits as do, and the tile as few periods, so that no window of the
tile differs by more than a mean FLIP of VISIBLE in the mean of LIGHTS, nor by WORST times as much under one of them,
seen at a pixel per texel, or at as many pixels as a scene shows of it. The maps are made smaller together, and then
each as far as the others leave it room:

    tile       its k-th part: the mean over the k x k parts, which repeats without a seam
    normal     flat, or fewer texels: slopes s are averaged, and the variance that they lose widens the lobe,
               alpha^2 += E|s|^2 - |E s|^2
    basecolor  its mean, or fewer texels
    roughness  its mean, or fewer texels
    height     the normals' texels; no renderer loads it until the relief is bump or displacement

Sources: Andersson et al. 2020 (FLIP); Toksvig 2005, Kaplanyan et al. 2016 (normals' variance as roughness); Irani and
Peleg 1991 (back-projection).
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch

from .brdf import shade
from .exemplar import LUMINANCE
from .flip import flip
from .image import linear_from_srgb, srgb_from_linear
from .material import SVBRDF
from .torus import resize

VISIBLE = 0.023  # FLIP, mean over a window; whole pictures then differ by less than 0.02 (benchmarks/needs.py)
WORST = 2.0
WINDOW = 128  # px, two degrees of the view
LEAST_SIDE = 16  # px
MOST_PARTS = 4
TEXELS_PER_PIXEL = tuple(float(f) for f in np.geomspace(0.5, 2.9, 16))  # tried where a scene is known
PIXEL = 1.5  # px, width of a renderer's pixel filter
SAMPLES = 4  # along a pixel's side, at most
GREY = 0.18  # linear luminance that a close-up shows at least
DARKEST = 0.004
FAR = 0.02  # mean difference of maps that is seen without rendering them
# (light, view), of any length: a sun from the side, a low one, and one that the viewer sees mirrored
LIGHTS = (((-0.6, 0.5, 0.8), (0, 0, 1)), ((0.9, 0.3, 0.35), (0, 0, 1)), ((0.1, 0.9, 0.7), (0, -0.9, 0.7)))
FLAT = np.array([0, 0, 1], np.float32)
KINDS = ("normal", "basecolor", "roughness")
CHANNELS = {"basecolor": 4, "normal": 4, "roughness": 1}  # as renderers hold them: three channels are padded to four

Progress = Callable[[float, str], None]
Maps = dict[str, np.ndarray]  # by KINDS: (H, W, 3) or (3,), and (H, W) or () for the roughness


@dataclass
class Reduction:
    """svbrdf: each map with a side of its own, or constant; its height is in units of the new tile's width. parts: into
    how many the tile was divided along each axis. bits: of the maps that are pictures. ledger: a line per change,
    {"map", "change", "bytes": that it saves of a renderer's memory, "flip": the worst window's error with it}."""

    svbrdf: SVBRDF
    parts: int = 1
    bits: dict[str, int] = field(default_factory=lambda: dict.fromkeys(KINDS, 8))
    ledger: list[dict] = field(default_factory=list)


def reduce(
    svbrdf: SVBRDF,
    progress: Progress = lambda fraction, message: None,
    visible: float = VISIBLE,
    parts: int = MOST_PARTS,
    pixels: float | None = None,
) -> Reduction:
    """The least maps that look like the given ones, which are constants or square, and what they save.

    visible: the error that may be made, FLIP in [0, 1]. parts: that the tile may be divided into, along each axis.
    pixels: length of a tile in the picture; None: a pixel per texel.
    """
    found = Reduction(svbrdf)
    full = maps_of(svbrdf)
    most = max(map(_side, full.values()))
    if pixels is not None and most > SAMPLES * pixels:
        # more than a picture can tell, and no more is rendered here
        full = maps_of(shrink(svbrdf, _eights(SAMPLES * pixels)))

    def note(kind: str, change: str, before: Maps, after: Maps, error: float) -> None:
        saved = texture_bytes(before, found.bits) - texture_bytes(after, found.bits)
        found.ledger.append({"map": kind, "change": change, "bytes": saved, "flip": round(error, 4)})

    for k in range(parts, 1, -1):
        progress(0.1 * (parts - k) / parts, "looking for periods")
        folded = _folded(full, k)
        if folded is None:
            continue
        error = _Judge(full, pixels)(_tiled(folded, k))
        if error <= visible / 4:
            note("tile", f"1/{k} along each side", full, folded, error)
            full, found.parts, visible = folded, k, visible - error
            break
    judge = _Judge(full, pixels)
    maps, errors = _least(full, pixels, judge, visible, progress)
    given = maps_of(svbrdf) if found.parts == 1 else full
    for kind in KINDS:
        if maps[kind] is full[kind] and _side(full[kind]):
            rounded = dict(maps, **{kind: _rounded(kind, maps[kind])})
            if judge(rounded) > visible:
                found.bits[kind] = 16  # 8 alone are seen
        if _side(maps[kind]) < max(_side(given[kind]), 1):
            note(kind, _said(kind, maps[kind]), {kind: given[kind]}, {kind: maps[kind]}, errors[kind])
    height = svbrdf.height
    if _side(maps["normal"]) == 0:
        # the normal is the height's gradient: without slope there is no relief to displace
        if height is not None:
            found.ledger.append({"map": "height", "change": "flat", "bytes": 0, "flip": 0.0})
        height = None
    elif height is not None:
        if found.parts > 1:
            height = _mean_part(height, found.parts) * found.parts
        height = _shrunk(height, _side(maps["normal"]))
    roughness = maps["roughness"]
    found.svbrdf = SVBRDF(
        maps["basecolor"], maps["normal"], roughness if roughness.ndim else float(roughness), height, svbrdf.metallic
    )
    progress(1.0, "reduced")
    return found


def texture_bytes(maps: Maps, bits: dict[str, int]) -> int:
    """What a renderer holds of maps in memory; constants are free."""
    return sum(_side(value) ** 2 * CHANNELS[kind] * bits[kind] // 8 for kind, value in maps.items())


def say(ledger: list[dict]) -> list[str]:
    """The ledger's lines, for people."""
    return [f"{e['map']}: {e['change']}" + (f", {-e['bytes'] / 1e6:+.2f} MB" if e["bytes"] else "") for e in ledger]


def shrink(svbrdf: SVBRDF, side: int) -> SVBRDF:
    """The SVBRDF with maps of at most `side` texels along each axis, as a picture that shows no more of it averages
    them: what the normals lose widens the roughness, which may become a map by it."""

    def at_most(value):
        return _shrunk(value, min(side, _side(value)))

    normal, variance = _shrunk_normal(svbrdf.normal, min(side, _side(svbrdf.normal)))
    roughness = _wider(at_most(np.asarray(svbrdf.roughness, np.float32)), variance)
    height = None if svbrdf.height is None else at_most(svbrdf.height)
    roughness = roughness if roughness.ndim else float(roughness)
    return SVBRDF(at_most(svbrdf.albedo), normal, roughness, height, svbrdf.metallic)


def maps_of(svbrdf: SVBRDF) -> Maps:
    return {"basecolor": svbrdf.albedo, "normal": svbrdf.normal, "roughness": np.asarray(svbrdf.roughness, np.float32)}


def largest(svbrdf: SVBRDF) -> int:
    """Side of its largest map in texels, 0 where all are constants."""
    return max(map(_side, maps_of(svbrdf).values()))


def _side(value: np.ndarray) -> int:
    return 0 if np.ndim(value) < 2 else value.shape[0]


def _said(kind: str, value: np.ndarray) -> str:
    if _side(value):
        return f"{_side(value)} px"
    return {"normal": "flat", "basecolor": "one colour"}.get(kind) or f"{float(value):.2f} everywhere"


def _least(full: Maps, pixels: float | None, judge: "_Judge", visible: float, progress: Progress):
    """The smallest maps whose error is at most `visible`, and the error when each of them was last made smaller.

    First all together, then each alone: that leads to a quarter less memory than one map after the other, where the
    first takes all the room there is.
    """
    most = max(map(_side, full.values()))
    sizes = [*_sizes(most, pixels), most]
    sides, maps, errors = dict.fromkeys(KINDS, most), full, dict.fromkeys(KINDS, 0.0)
    for i, kinds in enumerate((KINDS, *((kind,) for kind in KINDS))):
        if not most:
            break

        def passes(size: int, i=i, kinds=kinds) -> bool:
            nonlocal sides, maps
            progress(0.1 + 0.9 * i / (1 + len(KINDS)), f"reducing the {' and '.join(kinds)}")
            tried = sides | dict.fromkeys(kinds, size)
            candidate = full
            for kind in KINDS:
                if _side(candidate[kind]) > tried[kind]:
                    candidate = _with(candidate, full, kind, tried[kind])
            error = judge(candidate)
            if error <= visible:
                sides, maps = tried, candidate
                errors.update(dict.fromkeys(kinds, error))
            return error <= visible

        # a value has no rounding, so it may do where few texels do not
        end = sizes.index(sides[kinds[0]])
        if end and not passes(0):
            bisect_left(sizes, True, 1, end, key=passes)
    return maps, errors


def _eights(length: float) -> int:
    """A side of at least so many texels that is a multiple of 8."""
    return max(LEAST_SIDE, 8 * math.ceil(length / 8))


def _sizes(side: int, pixels: float | None) -> list[int]:
    """The sides that a map of `side` texels may get instead, the least first, 0 for a value."""
    if pixels is None:
        smaller = {side >> n for n in range(1, 12) if side >> n >= LEAST_SIDE}
    else:
        smaller = {_eights(pixels * factor) for factor in TEXELS_PER_PIXEL}
    return [0, *sorted(size for size in smaller if size < side)] if side else []


def _with(maps: Maps, full: Maps, kind: str, side: int) -> Maps:
    """`maps` with one of them made from its full self at `side` texels, 0 for a constant, as 8 bits hold it."""
    changed = dict(maps)
    if kind == "normal":
        normal, variance = _shrunk_normal(full["normal"], side)
        changed["normal"] = normal
        changed["roughness"] = _wider(full["roughness"], variance)
    else:
        # the roughness is that which the normals left
        changed[kind] = _shrunk(maps[kind], side)
    if side:
        changed[kind] = _rounded(kind, changed[kind])
    return changed


def _shrunk(value: np.ndarray, side: int) -> np.ndarray:
    """A map at `side` texels, 0 for its mean; constants stay."""
    if not _side(value):
        return value
    if side == 0:
        return value.mean((0, 1), dtype=np.float64).astype(np.float32)
    if side == _side(value):
        return value
    return _resampled(value, side, value.min(), value.max())


def _resampled(value: np.ndarray, side: int, least: float, most: float) -> np.ndarray:
    """Square texels on the torus at a smaller side, in [least, most]: so that the mean over each of them, once they are
    shown, is nearly that of what it replaces. Showing them is bilinear, which blurs; their own means would show less.
    """
    means = small = _means(value, side)
    for _ in range(2):  # further ones sharpen what the first have clipped
        small = np.clip(small + means - _texels(small, (0, 0), side, side), least, most)
    return small


def _means(value: np.ndarray, side: int) -> np.ndarray:
    return cv2.resize(value, (side, side), interpolation=cv2.INTER_AREA)


def _shrunk_normal(normal: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Normals at `side` texels, 0 for flat, and what the slopes' variance within a texel has become (side, side)."""
    if not _side(normal) or side == _side(normal):
        return normal, np.zeros((), np.float32)
    slopes = normal[..., :2] / np.maximum(normal[..., 2:], 0.05)
    squares = np.square(slopes).sum(-1)
    if side == 0:
        return FLAT, squares.mean(dtype=np.float64).astype(np.float32)
    variance = np.maximum(_means(squares, side) - np.square(_means(slopes, side)).sum(-1), 0)
    small = _resampled(slopes, side, -20.0, 20.0)
    smooth = np.concatenate([small, np.ones_like(small[..., :1])], -1)
    return smooth / np.linalg.norm(smooth, axis=-1, keepdims=True), variance


def _wider(roughness: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Roughness with the variance of slopes in it, at the side of the larger of the two."""
    if not variance.any():
        return roughness
    side = max(_side(roughness), _side(variance))
    roughness, variance = (resize(x[..., None], (side, side))[..., 0] if _side(x) else x for x in (roughness, variance))
    return np.clip(roughness**4 + np.maximum(variance, 0), 0, 1) ** 0.25


def _rounded(kind: str, value: np.ndarray) -> np.ndarray:
    """A map as 8 bits hold it."""
    if kind == "roughness":
        return np.rint(value * 255) / np.float32(255)
    if kind == "normal":
        return np.rint((value + 1) * 127.5) / np.float32(127.5) - 1
    return linear_from_srgb(np.rint(srgb_from_linear(value) * 255) / np.float32(255))


def _mean_part(value: np.ndarray, k: int) -> np.ndarray:
    n = _side(value) // k
    return value.reshape(k, n, k, n, *value.shape[2:]).mean((0, 2)) if n else value


def _tiled(maps: Maps, k: int) -> Maps:
    return {kind: np.tile(value, (k, k, 1)[: value.ndim]) if _side(value) else value for kind, value in maps.items()}


def _folded(full: Maps, k: int) -> Maps | None:
    """The mean over the k x k parts of the tile; None where that can't be meant."""
    sides = {_side(value) for value in full.values()} - {0}
    if len(sides) != 1 or min(sides) % k or min(sides) < k * LEAST_SIDE:
        return None
    folded = {kind: _mean_part(value, k) for kind, value in full.items()}
    if _side(full["normal"]):
        folded["normal"] = folded["normal"] / np.linalg.norm(folded["normal"], axis=-1, keepdims=True)
    # most textures end here, without a rendering
    tiled = _tiled(folded, k)
    return folded if all(np.abs(tiled[kind] - full[kind]).mean() < FAR for kind in KINDS) else None


class _Judge:
    """The error of maps instead of the full ones: FLIP, mean over a window, in the worst of the windows in which one of
    the maps changes most; the lights' mean, or their worst by WORST. `pixels` are the length of a tile in a picture,
    whose white is a white plane; None: a pixel per texel, in a close-up that is exposed for the material if it is dark.
    """

    def __init__(self, full: Maps, pixels: float | None):
        self._full, self._pictures = full, {}
        self._side = max(map(_side, full.values()))
        self._across = self._side if pixels is None else max(1, round(pixels))
        self._samples = max(1, math.ceil(self._side / self._across)) if self._side else 1
        self._window = min(WINDOW, self._across)
        luminance = float((np.reshape(full["basecolor"], (-1, 3)) @ LUMINANCE).mean())
        self._gain = max(1.0, GREY / max(luminance, DARKEST)) if pixels is None else 1.0

    def __call__(self, maps: Maps) -> float:
        full, worst = self._full, 0.0
        corners = {self._changed_most(kind, full[kind], maps[kind]) for kind in KINDS if full[kind] is not maps[kind]}
        for corner in sorted(corners):
            if corner not in self._pictures:
                self._pictures[corner] = self._rendered(full, corner)
            pairs = zip(self._pictures[corner], self._rendered(maps, corner), strict=True)
            errors = [float(flip(a, b).mean()) for a, b in pairs]
            worst = max(worst, sum(errors) / len(errors), max(errors) / WORST)
        return worst

    def _changed_most(self, kind: str, full: np.ndarray, other: np.ndarray) -> tuple[int, int]:
        """Row and column in pixels of the window, of as few as cover the tile, in which two maps differ most."""
        half = max(self._side // 2, 1)  # tells where
        a, b = (_texels(x, (0, 0), half, half, looks=1) for x in (full, other))
        if kind == "basecolor":
            a, b = np.sqrt(a), np.sqrt(b)
        change = np.square(a - b).reshape(len(a), len(a), -1).sum(-1)
        count = math.ceil(self._across / self._window)
        windows = _means(change, count)
        row, column = np.unravel_index(windows.argmax(), windows.shape)
        return int(row) * self._across // count, int(column) * self._across // count

    def _rendered(self, maps: Maps, corner: tuple[int, int]) -> list[np.ndarray]:
        """Pictures (window, window, 3), encoded, of a window under each of LIGHTS, a white plane being 1."""
        n, window = self._samples, self._window
        albedo, normal, roughness = (
            torch.from_numpy(
                np.array(_texels(maps[kind], [n * c for c in corner], n * window, n * self._across), np.float32)
            )
            for kind in ("basecolor", "normal", "roughness")
        )
        normal = torch.nn.functional.normalize(normal, dim=-1)
        pictures = []
        for light, view in LIGHTS:
            light, view = (
                torch.nn.functional.normalize(torch.tensor(x, dtype=torch.float32), dim=0) for x in (light, view)
            )
            shaded = shade(albedo, normal, roughness, light, view) * (self._gain / light[2])
            pictures.append(srgb_from_linear(filtered(shaded.clamp(0, 1).numpy(), n)))
        return pictures


def filtered(samples: np.ndarray, n: int) -> np.ndarray:
    """Pixels (H, W, C) of samples (n H, n W, C), by the Blackman-Harris window that Cycles uses, PIXEL px wide."""
    margin = math.ceil((PIXEL - 1) / 2 * n)
    x = (np.arange(-margin, n + margin) - (n - 1) / 2) / (PIXEL * n) + 0.5
    turns = 2 * np.pi * np.clip(x, 0, 1)
    weights = 0.35875 - 0.48829 * np.cos(turns) + 0.14128 * np.cos(2 * turns) - 0.01168 * np.cos(3 * turns)
    kernel = (weights / weights.sum()).astype(np.float32)
    # the window begins with the pixel's own samples less the margin
    whole = cv2.sepFilter2D(samples, -1, kernel, kernel, anchor=(margin, margin), borderType=cv2.BORDER_REPLICATE)
    return whole[::n, ::n]


def _texels(value: np.ndarray, corner: Sequence[int], count: int, side: int, looks: int = 2) -> np.ndarray:
    """count x count places of a map from `corner` on, shown at `side` places to the tile as renderers do: the mean of
    looks x looks bilinear looks at each. So a map at its own resolution is blurred too, as it is in every picture."""
    size = _side(value)
    if size == 0:
        return np.broadcast_to(value, (count, count, *np.shape(value)))
    steps = (np.arange(looks * count) + 0.5) / looks
    rows, columns = (((c + steps) * size / side - 0.5).astype(np.float32) for c in corner)
    seen = cv2.remap(value, *np.meshgrid(columns, rows), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return seen if looks == 1 else cv2.resize(seen, (count, count), interpolation=cv2.INTER_AREA)
