"""The network that decomposes a texture: what light did to the albedo, the slopes, how roughness varies.

A pretrained trunk recognises the material, a light decoder brings that back to every pixel; the photo's own pixels
enter at full resolution. Every head starts from "do nothing": albedo as photographed, flat, one roughness.
"""

import torch
import torch.nn.functional as F
from torch import nn

from .efficientnet_lite import CHANNELS, EfficientNetLite0

STRIDE = 32  # sides of what goes in are multiples of it
GLOBAL = 2 * CHANNELS[-1]  # mean and deviation of the deepest features
HEADS = {"gain": 3, "slope": 2, "roughness": 1}


class SvbrdfNet(nn.Module):
    def __init__(self, widths: tuple[int, ...] = (32, 48, 64, 96)):
        super().__init__()
        self.trunk = EfficientNetLite0()
        skips = (CHANNELS[0] + 12, *CHANNELS[1:4])
        self.context = nn.Linear(GLOBAL, widths[-1])
        self.mean_roughness = nn.Linear(
            GLOBAL, 1
        )  # fitted apart, in closed form: there are few materials to learn from
        self.up, self.mix = nn.ModuleList(), nn.ModuleList()
        below = 0
        for width, skip in zip(reversed(widths), reversed(skips), strict=True):
            self.up.append(nn.Conv2d(below + skip, width, 3, padding=1))
            self.mix.append(nn.Conv2d(width, width, 3, padding=1))
            below = width
        self.heads = nn.Conv2d(widths[0], 4 * sum(HEADS.values()), 3, padding=1)
        nn.init.zeros_(self.heads.weight)
        nn.init.zeros_(self.heads.bias)
        # the trunk stays as it was pretrained, the mean is not learnt by gradients
        self.trunk.requires_grad_(False)
        self.mean_roughness.requires_grad_(False)

    def forward(self, pixels: torch.Tensor, context: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """pixels (B, 3, H, W) sRGB-encoded in [0, 1], sides multiples of STRIDE; context (B, GLOBAL), of `describe`.

        Returns gain (B, 3, H, W), the logarithm of albedo over linear pixels; slope (B, 2, H, W), d height / dx and
        d height / d row per pixel; roughness (B, 1, H, W), its deviation from the material's mean.
        """
        with torch.no_grad():
            maps = self.trunk(pixels)
        if context is None:
            context = pooled(maps[-1])
        x = None
        skips = [torch.cat([maps[0], F.pixel_unshuffle(2 * pixels - 1, 2)], 1), *maps[1:4]]
        for up, mix, skip in zip(self.up, self.mix, reversed(skips), strict=True):
            if x is None:
                x = up(skip) + self.context(context)[..., None, None]
            else:
                x = up(torch.cat([F.interpolate(x, scale_factor=2, mode="nearest"), skip], 1))
            x = F.relu(x)
            x = x + F.relu(mix(x))
        out = F.pixel_shuffle(self.heads(x), 2)
        return dict(zip(HEADS, out.split(list(HEADS.values()), 1), strict=True))

    @torch.no_grad()
    def describe(self, pixels: torch.Tensor) -> torch.Tensor:
        """What the material is, (B, GLOBAL), of pixels as in `forward`."""
        return pooled(self.trunk(pixels)[-1])


def pooled(features: torch.Tensor) -> torch.Tensor:
    return torch.cat([features.mean((2, 3)), features.std((2, 3))], 1)
