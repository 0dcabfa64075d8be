"""Shift-tolerant LPIPS: how different two pictures look, by the features of an AlexNet that hardly mind small shifts.

Source: Ghildyal and Liu 2022 (shift-tolerant LPIPS, the AlexNet variant), Zhang et al. 2018 (LPIPS). Weights and
their licence: models/stlpips_alex.md. Pixels are perceptually encoded (sRGB), 0 to 1.
"""

import math
from functools import cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from .tensors import read_tensors

WEIGHTS = Path(__file__).resolve().parent.parent / "models" / "stlpips_alex.safetensors"
PADDING = (2, 2, 1, 1, 1)  # of the convolutions
STRIDES = (2, 4, 8, 8, 8)  # px between neighbours of the five layers
CHANNELS = (64, 192, 384, 256, 256)
LEAST_SIDE = 32  # px


@cache
def _weights() -> dict[str, torch.Tensor]:
    tensors, _ = read_tensors(WEIGHTS)
    return {name: torch.from_numpy(array.astype(np.float32)) for name, array in tensors.items()}


def layers(images: torch.Tensor) -> list[torch.Tensor]:
    """The five layers (N, CHANNELS[i], h, w), one value every STRIDES[i] px, of images (N, 3, H, W) in 0 to 1.

    Differentiable. Takes about 350 bytes per pixel.
    """
    if min(images.shape[2:]) < LEAST_SIDE:
        raise ValueError(f"{images.shape[3]} x {images.shape[2]} px are too few; give {LEAST_SIDE} px at least")
    weights = _weights()
    x = (images * 2 - 1 - weights["shift"]) / weights["scale"]
    found = []
    for i, padding in enumerate(PADDING, 1):
        if i in (2, 3):
            x = _halved(F.max_pool2d(x, 3, 1))
        x = F.conv2d(x, weights[f"conv{i}.weight"], weights[f"conv{i}.bias"], padding=padding)
        x = F.relu(_halved(x) if i == 1 else x)
        found.append(x)
    return found


def _halved(x: torch.Tensor) -> torch.Tensor:
    """Every second value of the blurred x: what makes the network tolerate shifts."""
    binomial = torch.tensor([[1.0, 2.0, 1.0]])
    kernel = (binomial.T @ binomial / 16).expand(x.shape[1], 1, 3, 3)
    return F.conv2d(F.pad(x, (2, 2, 2, 2), mode="reflect"), kernel, stride=2, groups=x.shape[1])


@torch.no_grad()
def features(pixels: np.ndarray) -> list[torch.Tensor]:
    """The five layers (CHANNELS[i], h, w) of pixels (H, W, 3), scaled so that the mean over the positions of the
    squared difference, summed over channels and layers, is the distance."""
    return [x[0] for x in _scaled(layers(_batch(pixels)))]


def _scaled(found: list[torch.Tensor]) -> list[torch.Tensor]:
    """Unit length along the channels, times the root of the channel's learnt importance."""
    weights = _weights()
    return [
        x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10) * weights[f"importance{i}"].sqrt()[:, None, None]
        for i, x in enumerate(found, 1)
    ]


def _batch(pixels: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1), np.float32))[None]


def distance(first: np.ndarray, second: np.ndarray) -> float:
    """Shift-tolerant LPIPS of two pictures (H, W, 3) of one size: 0 for the same, about 0.5 for unrelated ones."""
    return between(features(first), features(second))


def between(first: list[torch.Tensor], second: list[torch.Tensor]) -> float:
    """The distance of two pictures of which `features` are known."""
    return float(sum((a - b).square().sum(0).mean() for a, b in zip(first, second, strict=True)))


class Crops:
    """Crops of an exemplar that textures are compared with."""

    SIDE = 64  # px
    MOST = 24

    def __init__(self, pixels: np.ndarray, mask: np.ndarray):
        """pixels (h, w, 3), mask (h, w) bool, the region; where no crop fits into it, `found` is False."""
        side = self.SIDE
        total = np.pad(mask.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        count = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
        corners = np.argwhere(count == side * side) if count.size else np.zeros((0, 2), int)
        self.found = len(corners) > 0
        if self.found:
            some = corners[np.linspace(0, len(corners) - 1, self.MOST).round().astype(int)]
            self._layers = _flat(_crops(pixels, some, side))

    @torch.no_grad()
    def distance(self, texture: np.ndarray) -> float:
        """Mean over crops of a tileable texture (H, W, 3) of the distance to the nearest of the exemplar's crops."""
        h, w = texture.shape[:2]
        # a grid over the torus; its first crop lies across the corner
        rows, columns = (np.arange(4) * n // 4 - self.SIDE // 2 for n in (h, w))
        corners = np.stack(np.meshgrid(rows, columns, indexing="ij"), -1).reshape(-1, 2)
        own = _flat(_crops(texture, corners, self.SIDE))
        return float(sum(torch.cdist(a, b).square() for a, b in zip(own, self._layers, strict=True)).min(1)[0].mean())

    @torch.no_grad()
    def apart(self, other: "Crops") -> float:
        """Mean over these crops of the distance to the nearest of the other's."""
        pairs = zip(self._layers, other._layers, strict=True)
        return float(sum(torch.cdist(a, b).square() for a, b in pairs).min(1)[0].mean())


def _crops(pixels: np.ndarray, corners: np.ndarray, side: int) -> torch.Tensor:
    h, w = pixels.shape[:2]
    local = np.arange(side)
    crops = [pixels[np.ix_((y + local) % h, (x + local) % w)] for y, x in corners]
    return torch.from_numpy(np.stack(crops).transpose(0, 3, 1, 2).astype(np.float32))


@torch.no_grad()
def _flat(images: torch.Tensor) -> list[torch.Tensor]:
    """The scaled layers (N, everything), so that squared Euclidean distances add up to the metric."""
    return [x.flatten(1) / math.sqrt(x[0, 0].numel()) for x in _scaled(layers(images))]
