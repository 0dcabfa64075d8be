"""Shift-tolerant LPIPS: how different two pictures look, by the features of an AlexNet that hardly mind small shifts.

Source: Ghildyal and Liu 2022 (shift-tolerant LPIPS, the AlexNet variant), Zhang et al. 2018 (LPIPS). Weights and
their licence: models/stlpips_alex.md. Pixels are perceptually encoded (sRGB), 0 to 1.
"""

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
    pairs = zip(features(first), features(second), strict=True)
    return float(sum((a - b).square().sum(0).mean() for a, b in pairs))
