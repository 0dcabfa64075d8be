"""The network that decomposes a texture: what light did to the albedo, the slopes, how rough the material is.

A small U-Net learns what shading does from pixel to pixel. Features of a pretrained trunk, seen at half resolution,
tell it what it looks at, and what all of the picture has in common (the material, where the light comes from) scales
and shifts its features. What is shaded slopes along the light, whose direction is found first: one head is multiplied
by it. Every head starts from "do nothing": albedo as photographed, flat. Roughness is one number.
"""

import torch
import torch.nn.functional as F
from torch import nn

from .efficientnet_lite import CHANNELS, EfficientNetLite0

STRIDE = 64  # sides of what goes in are multiples of it
MATERIAL = 2 * CHANNELS[-1]  # mean and deviation of the trunk's deepest features
TEXTURE = 2 * sum(CHANNELS[2:4])  # and of those before: less of what it is, more of what it is made of
WIDTHS = (32, 48, 64, 96)  # at 1/2, 1/4, 1/8, 1/16
LIGHT = 2 * sum(WIDTHS[1:])  # mean and deviation of the U-Net's own
HEADS = {"gain": 3, "slope": 2, "shade": 1}
WHOLE = 128


class SvbrdfNet(nn.Module):
    def __init__(self):
        super().__init__()
        self.trunk = EfficientNetLite0()
        self.down, self.along, self.across, self.up = (nn.ModuleList() for _ in range(4))
        below = 12
        for level, width in enumerate(WIDTHS):
            # the trunk's features lie at 1/4, 1/8, 1/16
            beside = CHANNELS[level - 1] if level else 0
            self.down.append(nn.Conv2d(below, width, 3, 1 if level == 0 else 2, 1))
            self.across.append(nn.Conv2d(beside, width, 1) if beside else nn.Identity())
            self.along.append(nn.Conv2d(width, width, 3, padding=1))
            below = width
        self.material = nn.Linear(MATERIAL, 64)
        self.light = nn.Linear(LIGHT, 64)
        self.lamp = nn.Linear(WHOLE, 2)
        self.scale = nn.Linear(WHOLE, 2 * sum(WIDTHS))
        self.lift = nn.ModuleList(nn.Conv2d(WIDTHS[i + 1], WIDTHS[i], 1) for i in range(3))
        for width in WIDTHS:
            self.up.append(nn.ModuleList(nn.Conv2d(width, width, 3, padding=1) for _ in range(2)))
        self.heads = nn.Conv2d(WIDTHS[0], 4 * sum(HEADS.values()), 3, padding=1)
        # fitted apart, in closed form: there are few materials to learn from
        self.mean_roughness = nn.Linear(TEXTURE, 1)
        for layer in (self.heads, self.scale, self.mean_roughness):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        nn.init.constant_(self.mean_roughness.bias, 0.6)  # until it is fitted
        self.trunk.requires_grad_(False)
        self.mean_roughness.requires_grad_(False)

    def forward(self, pixels: torch.Tensor, whole: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
        """pixels (B, 3, H, W) sRGB-encoded in [0, 1], sides multiples of STRIDE; whole (B, 128), of `describe`.

        Returns gain (B, 3, H, W), the logarithm of albedo over linear pixels; slope (B, 2, H, W), d height / dx and
        d height / d row per pixel; lamp (B, 2), where the light comes from, along x and down, as a share of all light.
        """
        maps = self._trunk(pixels, 3 if whole is not None else 5)
        levels = self._encode(pixels, maps)
        if whole is None:
            whole = self._whole(levels, pooled(maps[-1:]))
        scales = self.scale(whole)[..., None, None].split([2 * w for w in WIDTHS], 1)
        x = None
        for level in (3, 2, 1, 0):
            x = levels[level] if x is None else levels[level] + F.interpolate(x, scale_factor=2, mode="nearest")
            gain, shift = scales[level].chunk(2, 1)
            x = x * (1 + gain) + shift
            for convolution in self.up[level]:
                x = x + F.relu(convolution(x))
            if level:
                x = self.lift[level - 1](x)
        gain, slope, shade = F.pixel_shuffle(self.heads(x), 2).split(list(HEADS.values()), 1)
        lamp = self.lamp(whole)
        return {"gain": gain, "slope": slope + shade * lamp[..., None, None], "lamp": lamp}

    @torch.no_grad()
    def describe(self, samples: torch.Tensor, material: torch.Tensor) -> torch.Tensor:
        """What all of a picture has in common, (1, 128), of samples (N, 3, H, W) of it and of its `material`."""
        return self._whole(self._encode(samples, self._trunk(samples, 3)), material, joined=True)

    @torch.no_grad()
    def recognise(self, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What the material is, (B, MATERIAL), and its texture, (B, TEXTURE), of pixels as in `forward`."""
        maps = self._trunk(pixels, 5)
        return pooled(maps[4:]), pooled(maps[2:4])

    @torch.no_grad()
    def _trunk(self, pixels: torch.Tensor, depth: int) -> list[torch.Tensor]:
        return self.trunk(F.avg_pool2d(pixels, 2), depth)

    def _encode(self, pixels: torch.Tensor, maps: list[torch.Tensor]) -> list[torch.Tensor]:
        x, levels = F.pixel_unshuffle(2 * pixels - 1, 2), []
        for level, (down, along, across) in enumerate(zip(self.down, self.along, self.across, strict=True)):
            x = down(x)
            if level:
                x = x + across(maps[level - 1])
            x = F.relu(x)
            x = x + F.relu(along(x))
            levels.append(x)
        return levels

    def _whole(self, levels: list[torch.Tensor], material: torch.Tensor, joined: bool = False) -> torch.Tensor:
        light = pooled(levels[1:], joined)
        return F.relu(torch.cat([self.material(material), self.light(light)], 1))


def pooled(maps: list[torch.Tensor], joined: bool = False) -> torch.Tensor:
    """Mean and deviation of features over each picture, or over all of them joined."""
    parts = []
    for x in maps:
        x = x.transpose(0, 1).flatten(1)[None] if joined else x.flatten(2)
        parts += [x.mean(2), (x.var(2, correction=0) + 1e-6).sqrt()]
    return torch.cat(parts, 1)
