"""Networks of others, trained on our data, as opponents of ours in `svbrdf.py`.

`DeepMaterials`: U-Net with a global track, after Deschaintre et al. 2018 (Single-Image SVBRDF Capture with a
Rendering-Aware Deep Network), at half its width and six levels of eight, for crops of 128 px. Trained by
`training/train.py --network deep-materials`.
"""

from functools import cache
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..core.errors import PaletteError
from ..core.image import srgb_from_linear
from ..core.material import SVBRDF
from ..core.tensors import read_tensors
from ..core.torus import integrate, normal_from_height

WIDTHS = (32, 64, 128, 256, 256, 256)
STRIDE = 2 ** len(WIDTHS)
HEADS = {"albedo": 3, "slope": 2, "roughness": 1}
MARGIN = 128  # px repeated around a texture, so that it is seen as a torus


class _Level(nn.Module):
    """A convolution of the U-Net, and the track beside it: it hears each level's mean, and is added to the next."""

    def __init__(self, layer: nn.Module, track: int, width: int, normed: bool = True):
        super().__init__()
        self.layer = layer
        self.norm = nn.InstanceNorm2d(width, affine=True) if normed else nn.Identity()
        self.heard = nn.Linear(track, width)
        self.track = nn.Linear(2 * width, width)

    def forward(self, x: torch.Tensor, track: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x = self.layer(F.leaky_relu(x, 0.2))
        mean = x.mean((2, 3))
        told = self.heard(track)
        x = self.norm(x) + told[..., None, None]
        return x, F.selu(self.track(torch.cat([mean, told], 1)))


class DeepMaterials(nn.Module):
    def __init__(self):
        super().__init__()
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        below, track = 3, 3
        for i, width in enumerate(WIDTHS):
            conv = nn.Conv2d(below, width, 4, 2, 1)
            # one pixel has no deviation to be divided by
            self.down.append(_Level(conv, track, width, normed=0 < i < len(WIDTHS) - 1))
            below = track = width
        for width, beside in zip((*WIDTHS[-2::-1], 32), (*WIDTHS[-2::-1], 0), strict=True):
            layer = nn.Sequential(nn.Upsample(scale_factor=2), nn.Conv2d(below, width, 3, padding=1))
            self.up.append(_Level(layer, track, width))
            below, track = width + beside, width
        self.head = nn.Conv2d(below, sum(HEADS.values()), 3, padding=1)

    def forward(self, pixels: torch.Tensor) -> dict[str, torch.Tensor]:
        """pixels (B, 3, H, W) sRGB-encoded, sides multiples of STRIDE: linear albedo (B, 3, H, W), slope (B, 2, H, W)
        as of `SvbrdfNet`, roughness (B, 1, H, W)."""
        x, track, beside = 2 * pixels - 1, pixels.mean((2, 3)), []
        for level in self.down:
            x, track = level(x, track)
            beside.append(x)
        beside.pop()
        for level in self.up:
            x, track = level(x, track)
            if beside:
                x = torch.cat([x, beside.pop()], 1)
        albedo, slope, roughness = self.head(F.leaky_relu(x, 0.2)).split(list(HEADS.values()), 1)
        return {"albedo": torch.sigmoid(albedo) ** 2.2, "slope": slope, "roughness": torch.sigmoid(roughness)}


@cache
def load(path: Path) -> DeepMaterials:
    """The network with the weights of a safetensors file; PaletteError where they are not this network's."""
    tensors, _ = read_tensors(path)
    net = DeepMaterials().eval()
    try:
        net.load_state_dict({name: torch.from_numpy(x.astype(np.float32)) for name, x in tensors.items()})
    except RuntimeError as error:
        raise PaletteError(f"'{path}' does not hold the weights of {type(net).__name__}") from error
    return net


def deep_materials(texture: np.ndarray, weights: Path) -> SVBRDF:
    """The SVBRDF that it finds of a texture (H, W, 3) float32 linear, which wraps, with the weights of a file."""
    net = load(weights)
    encoded = srgb_from_linear(np.clip(texture, 0, 1)).astype(np.float32)
    h, w = encoded.shape[:2]
    rows, columns = (np.arange(-MARGIN, -(-n // STRIDE) * STRIDE + MARGIN) % n for n in (h, w))
    with torch.no_grad():
        found = net(torch.from_numpy(encoded[rows[:, None], columns[None]]).permute(2, 0, 1)[None])
    albedo, slope, roughness = (
        found[name][0, :, MARGIN : MARGIN + h, MARGIN : MARGIN + w].permute(1, 2, 0) for name in HEADS
    )
    height = integrate(slope[..., 0].contiguous(), slope[..., 1].contiguous()) / w
    return SVBRDF(albedo.numpy(), normal_from_height(height).numpy(), roughness[..., 0].numpy(), height.numpy())
