"""What a material does not need: the smallest maps whose rendering cannot be told from that of the full ones.

Claim: every map becomes a value, or as few texels and bits as do, and the tile as few periods, so that no window of the
tile differs by more than a mean FLIP of VISIBLE under any of LIGHTS, seen at a pixel per texel. One map after the other
is made smaller, with what was decided before it in place:

    tile       its k-th part: the mean over the k x k parts, which repeats without a seam
    normal     flat, or fewer texels: slopes s are averaged, and the variance that they lose widens the lobe,
               alpha^2 += E|s|^2 - |E s|^2
    basecolor  its mean, or fewer texels
    roughness  its mean, or fewer texels
    height     the normals' texels; no renderer loads it until the relief is bump or displacement

Sources: Andersson et al. 2020 (FLIP); Toksvig 2005, Kaplanyan et al. 2016 (normals' variance as roughness).
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch

from .brdf import shade
from .flip import flip
from .image import linear_from_srgb, srgb_from_linear
from .material import SVBRDF
from .torus import frequencies, resize

VISIBLE = 0.02  # FLIP, mean over a window
WINDOW = 128  # px, two degrees of the view
LEAST_SIDE = 16  # px
MOST_PARTS = 4
FAR = 0.02  # mean difference of maps that is seen without rendering them
# (light, view), of any length: a sun from the side, a low one, and one that the viewer sees mirrored
LIGHTS = (((-0.6, 0.5, 0.8), (0, 0, 1)), ((0.9, 0.3, 0.35), (0, 0, 1)), ((0.1, 0.9, 0.7), (0, -0.9, 0.7)))
FLAT = np.array([0, 0, 1], np.float32)
KINDS = ("normal", "basecolor", "roughness")  # in the order of the search
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
) -> Reduction:
    """The least maps that look like the given ones, which are constants or square, and what they save.

    visible: the error that may be made, FLIP in [0, 1]. parts: that the tile may be divided into, along each axis.
    """
    full = maps_of(svbrdf)
    found = Reduction(svbrdf)

    def note(kind: str, change: str, before: Maps, after: Maps, error: float) -> None:
        saved = texture_bytes(before, found.bits) - texture_bytes(after, found.bits)
        found.ledger.append({"map": kind, "change": change, "bytes": saved, "flip": round(error, 4)})

    for k in range(parts, 1, -1):
        progress(0.1 * (parts - k) / parts, "looking for periods")
        folded = _folded(full, k)
        if folded is None:
            continue
        error = _error(full, _tiled(folded, k))
        if error <= visible / 4:
            note("tile", f"1/{k} along each side", full, folded, error)
            full, found.parts, visible = folded, k, visible - error
            break
    maps = full
    for i, kind in enumerate(KINDS):
        side = _side(maps[kind])
        sizes = [0, *(side >> n for n in range(12) if side >> n >= min(side, LEAST_SIDE))] if side else []
        least, error = None, 0.0
        for step, size in enumerate(sizes):
            progress(0.1 + 0.9 * (i + min(step, 4) / 5) / len(KINDS), f"reducing the {kind}")
            candidate = _with(maps, full, kind, size)
            of_it = _error(full, candidate)
            if of_it <= visible:
                least, error = candidate, of_it
            if (size == 0) == (of_it <= visible):  # a constant does, or fewer texels don't
                break
        if least is None:
            least = maps
            if side:
                found.bits[kind] = 16  # 8 alone are seen
        if (size := _side(least[kind])) < side or not side:
            note(kind, _said(kind, least[kind]), {kind: full[kind]}, {kind: least[kind]}, error)
        maps = least
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
    return [f"{e['map']}: {e['change']}" + (f", -{e['bytes'] / 1e6:.2f} MB" if e["bytes"] else "") for e in ledger]


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


def _with(maps: Maps, full: Maps, kind: str, side: int) -> Maps:
    """`maps` with one of them made from its full self at `side` texels, 0 for a constant, as 8 bits hold it."""
    changed = dict(maps)
    if kind == "normal":
        normal, variance = _shrunk_normal(full["normal"], side)
        changed["normal"] = normal
        changed["roughness"] = _wider(full["roughness"], variance)
    else:
        # the roughness from here on is that which the normals left
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
    small = _resampled(value.reshape(*value.shape[:2], -1), side).reshape(side, side, *value.shape[2:])
    return np.clip(small, value.min(), value.max())


def _resampled(value: np.ndarray, side: int) -> np.ndarray:
    """Square texels (n, n, C) on the torus at a smaller side: all that it can hold of the spectrum, unchanged. A blur
    against aliasing before it would show where the texels are as large as pixels."""
    n = len(value)
    spectrum = torch.fft.rfft2(torch.from_numpy(np.ascontiguousarray(value.transpose(2, 0, 1))))
    most = (side - 1) // 2
    kept = torch.zeros(value.shape[2], side, side // 2 + 1, dtype=spectrum.dtype)
    kept[:, : most + 1, : most + 1] = spectrum[:, : most + 1, : most + 1]
    kept[:, -most:, : most + 1] = spectrum[:, -most:, : most + 1]
    # texels lie at the centres of their squares, which become larger
    v, u = frequencies(side, side)
    kept = kept * torch.exp(0.5j * (1 - side / n) * (v + u)) * (side / n) ** 2
    return np.ascontiguousarray(torch.fft.irfft2(kept, s=(side, side)).permute(1, 2, 0).numpy())


def _shrunk_normal(normal: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Normals at `side` texels, 0 for flat, and what the slopes' variance within a texel has become (side, side)."""
    if not _side(normal) or side == _side(normal):
        return normal, np.zeros((), np.float32)
    slopes = normal[..., :2] / np.maximum(normal[..., 2:], 0.05)
    both = np.concatenate([slopes, np.square(slopes).sum(-1, keepdims=True)], -1)
    if side == 0:
        return FLAT, both[..., 2].mean(dtype=np.float64).astype(np.float32)
    small = _resampled(both, side)
    smooth = np.concatenate([small[..., :2], np.ones_like(small[..., :1])], -1)
    variance = np.maximum(small[..., 2] - np.square(small[..., :2]).sum(-1), 0)
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


def _error(full: Maps, maps: Maps) -> float:
    """FLIP, mean over a window, the worst of the lights and of the windows in which one of the maps changes most."""
    side = max(_side(value) for value in full.values())
    worst = 0.0
    corners = {_changed_most(kind, full[kind], maps[kind], side) for kind in KINDS if full[kind] is not maps[kind]}
    for corner in sorted(corners):
        pairs = zip(_rendered(full, corner, side), _rendered(maps, corner, side), strict=True)
        worst = max(worst, *(float(flip(a, b).mean()) for a, b in pairs))
    return worst


def _changed_most(kind: str, full: np.ndarray, other: np.ndarray, side: int) -> tuple[int, int]:
    """Row and column of the window, of those side by side, in which two maps differ most."""
    window = min(WINDOW, side)
    # every second texel of both axes tells where
    a, b = (_texels(x, (0, 0), side, side, 2) for x in (full, other))
    if kind == "basecolor":
        a, b = np.sqrt(a), np.sqrt(b)
    change = np.square(a - b).reshape(len(a), len(a), -1).sum(-1)
    n, half = side // window, window // 2
    sums = change[: n * half, : n * half].reshape(n, half, n, half).sum((1, 3))
    row, column = np.unravel_index(sums.argmax(), sums.shape)
    return int(row) * window, int(column) * window


def _texels(value: np.ndarray, corner: tuple[int, int], count: int, side: int, step: int = 1) -> np.ndarray:
    """Every step-th of count x count texels of a map from `corner` on, shown at `side` texels to the tile as renderers
    do: bilinear."""
    size = _side(value)
    if size == side:
        return value[tuple(slice(c, c + count, step) for c in corner)]
    rows, columns = (((c + np.arange(0, count, step) + 0.5) * size / side - 0.5).astype(np.float32) for c in corner)
    if size == 0:
        return np.broadcast_to(value, (len(rows), len(columns), *np.shape(value)))
    return cv2.remap(value, *np.meshgrid(columns, rows), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def _rendered(maps: Maps, corner: tuple[int, int], side: int) -> list[np.ndarray]:
    """Pictures (WINDOW, WINDOW, 3), encoded, of a window of the tile under each of LIGHTS, a white plane being 1."""
    window = min(WINDOW, side)
    albedo, normal, roughness = (
        torch.from_numpy(np.array(_texels(maps[kind], corner, window, side), np.float32))
        for kind in ("basecolor", "normal", "roughness")
    )
    normal = torch.nn.functional.normalize(normal, dim=-1)
    pictures = []
    for light, view in LIGHTS:
        light, view = (
            torch.nn.functional.normalize(torch.tensor(x, dtype=torch.float32), dim=0) for x in (light, view)
        )
        shaded = shade(albedo, normal, roughness, light.expand_as(normal), view.expand_as(normal)) / light[2]
        pictures.append(srgb_from_linear(shaded.clamp(0, 1).numpy()))
    return pictures
