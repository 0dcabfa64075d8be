"""Decomposer `resnet101`: runs the checkpoint that the authors of Material Palette publish, for those who have it.

The network is a ResNet-101 whose batch norms became instance norms without parameters, and three decoders (albedo,
normals, roughness) of the U-Net kind with skips. Written from the description of the architecture (Lopes et al. 2024;
He et al. 2016; Godard et al. 2019) so that the parameters have the names they have in the authors' public code:

    model.0.encoder.<torchvision's names of a ResNet-101, convolutions only; fc.* is left aside>
    model.1.decoders.<albedo|normals|roughness>.decoder.<0 to 9>.block.0.conv.<weight|bias>
    model.1.decoders.<albedo|normals|roughness>.decoder.10.conv.<weight|bias>

The names are those the code gives; no checkpoint was at hand to confirm them, so every name and shape is checked.
Neither weights nor code of the authors are included.
"""

from collections.abc import Callable
from functools import lru_cache
from itertools import count
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from ..core.errors import PaletteError
from ..core.image import srgb_from_linear
from ..core.material import SVBRDF
from ..core.torus import integrate, normal_from_height
from .published import differences, read_state

BLOCKS = (3, 4, 23, 3)
WIDTHS = (16, 32, 64, 128, 256)  # of the decoder, from full resolution down
SKIPS = (64, 256, 512, 1024, 2048)  # channels of the encoder at 1/2, 1/4 ... 1/32
HEADS = {"albedo": 3, "normals": 2, "roughness": 1}
STRIDE = 32
STEEPEST = 3.0  # slope at which the normals saturate, as trained
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet
# a white plane under the lamp of their renderings: 10 / (pi 2.197^2); ours is 1
EXPOSURE = 0.66


def wrapped(channels: int, width: int, side: int, stride: int = 1, bias: bool = False) -> nn.Conv2d:
    """A convolution that takes its input for a torus, where the original pads with zeros or mirrors."""
    return nn.Conv2d(channels, width, side, stride, side // 2, bias=bias, padding_mode="circular")


class Bottleneck(nn.Module):
    def __init__(self, channels: int, width: int, stride: int):
        super().__init__()
        self.conv1 = wrapped(channels, width, 1)
        self.conv2 = wrapped(width, width, 3, stride)
        self.conv3 = wrapped(width, 4 * width, 1)
        if stride > 1 or channels != 4 * width:
            self.downsample = nn.Sequential(wrapped(channels, 4 * width, 1, stride))

    def forward(self, x):
        y = F.relu(F.instance_norm(self.conv1(x)))
        y = F.relu(F.instance_norm(self.conv2(y)))
        y = F.instance_norm(self.conv3(y))
        return F.relu(y + (F.instance_norm(self.downsample(x)) if hasattr(self, "downsample") else x))


class Encoder(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv1 = wrapped(3, 64, 7, 2)
        channels = 64
        for i, depth in enumerate(BLOCKS):
            blocks = []
            for k in range(depth):
                blocks.append(Bottleneck(channels, 64 << i, 2 if i and not k else 1))
                channels = 256 << i
            self.add_module(f"layer{i + 1}", nn.Sequential(*blocks))

    def forward(self, x):
        x = F.relu(F.instance_norm(self.conv1(x)))
        maps = [x]
        x = F.max_pool2d(F.pad(x, (1, 1, 1, 1), mode="circular"), 3, 2)
        for i in range(len(BLOCKS)):
            x = getattr(self, f"layer{i + 1}")(x)
            maps.append(x)
        return maps


def named(**children: nn.Module) -> nn.Module:
    """A module that only gives its children their names."""
    module = nn.Module()
    for name, child in children.items():
        module.add_module(name, child)
    return module


class Decoder(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        pairs, below = [], SKIPS[-1]
        for level in reversed(range(len(WIDTHS))):
            skip = SKIPS[level - 1] if level else 0
            pairs += [(below, WIDTHS[level]), (WIDTHS[level] + skip, WIDTHS[level])]
            below = WIDTHS[level]
        steps = [named(block=nn.Sequential(named(conv=wrapped(a, b, 3, bias=True)))) for a, b in pairs]
        self.decoder = nn.ModuleList([*steps, named(conv=wrapped(below, channels, 3, bias=True))])

    def forward(self, maps):
        x = maps[-1]
        for level in reversed(range(len(WIDTHS))):
            before, after = self.decoder[2 * (len(WIDTHS) - 1 - level) : 2 * (len(WIDTHS) - level)]
            x = F.interpolate(F.elu(before.block[0].conv(x)), scale_factor=2, mode="nearest")
            if level:
                x = torch.cat([x, maps[level - 1]], 1)
            x = F.elu(after.block[0].conv(x))
        return self.decoder[-1].conv(x)


class Resnet101(nn.Module):
    def __init__(self):
        super().__init__()
        decoders = nn.ModuleDict({name: Decoder(channels) for name, channels in HEADS.items()})
        self.model = nn.Sequential(named(encoder=Encoder()), named(decoders=decoders))

    def forward(self, pixels: torch.Tensor) -> dict[str, torch.Tensor]:
        """pixels (B, 3, H, W) sRGB-encoded in [0, 1], on a torus, sides multiples of STRIDE.

        Returns albedo (B, 3, H, W) linear and roughness (B, 1, H, W) in [0, 1], normals (B, 3, H, W) unit, +Y up.
        """
        mean, deviation = (pixels.new_tensor(x)[:, None, None] for x in (MEAN, DEVIATION))
        maps = self.model[0].encoder((pixels - mean) / deviation)
        out = {name: torch.tanh(decoder(maps)) for name, decoder in self.model[1].decoders.items()}
        slope = STEEPEST * out["normals"]
        normals = F.normalize(torch.cat([slope, torch.ones_like(slope[:, :1])], 1), dim=1)
        return {"albedo": out["albedo"] / 2 + 0.5, "normals": normals, "roughness": out["roughness"] / 2 + 0.5}


@lru_cache(maxsize=1)
def load(path: Path) -> Resnet101:
    """The network with the weights of a checkpoint of PyTorch Lightning, a state dict, or a safetensors file.

    Raises PaletteError where the file cannot be read without running code from it, or is of another network.
    """
    path = Path(path)
    try:
        state = read_state(path)
    except OSError as error:
        raise PaletteError(f"can't read the checkpoint '{path}': {error.strerror or error}") from error
    with torch.device("meta"):
        net = Resnet101()
    found = {
        name: x for name, x in state.items() if name.startswith("model.") and not name.startswith("model.0.encoder.fc.")
    }
    expected = net.state_dict()
    if wrong := differences(found, expected):
        raise PaletteError(
            f"'{path}' is not Material Palette's decomposition network ({len(wrong)} of its {len(expected)} tensors "
            f"differ: {'; '.join(wrong[:3])}). Choose the model.ckpt that its authors publish"
        )
    net.load_state_dict(found, assign=True)
    return net.eval().requires_grad_(False)


def decompose(texture: np.ndarray, progress: Callable[[float, str], None], weights: Path) -> SVBRDF:
    """The SVBRDF of a texture (H, W, 3) float32 linear, which wraps, by the weights of a file.

    In one pass, since instance norms look at the whole image. Where the sides are multiples of 32 px, the network sees
    a torus, else it wraps around by a margin. Rolling the texture by multiples of 32 px rolls the maps. Normals are the
    gradient of the height nearest to them.
    """
    net = load(Path(weights))
    height, width = texture.shape[:2]
    progress(0.0, "decomposing")
    encoded = srgb_from_linear(np.clip(texture * EXPOSURE, 0, 1)).astype(np.float32)
    margins = [0 if side % STRIDE == 0 else STRIDE for side in (height, width)]
    ends = [-(-(side + 2 * m) // STRIDE) * STRIDE - m for side, m in zip((height, width), margins, strict=True)]
    rows, columns = (np.arange(-m, end) for m, end in zip(margins, ends, strict=True))
    pixels = torch.from_numpy(encoded[(rows % height)[:, None], (columns % width)[None]])
    convolutions = [module for module in net.modules() if isinstance(module, nn.Conv2d)]
    done = count()

    def tick(*_):
        progress(0.8 * next(done) / len(convolutions), "decomposing")

    hooks = [module.register_forward_pre_hook(tick) for module in convolutions]
    try:
        with torch.inference_mode():
            out = net(pixels.permute(2, 0, 1)[None].contiguous())
    finally:
        for hook in hooks:
            hook.remove()
    albedo, normal, roughness = (
        out[name][0, :, margins[0] : margins[0] + height, margins[1] : margins[1] + width].permute(1, 2, 0).clone()
        for name in ("albedo", "normals", "roughness")
    )
    progress(0.8, "integrating the height")
    relief = integrate(-normal[..., 0] / normal[..., 2], normal[..., 1] / normal[..., 2]) / width
    normal = normal_from_height(relief)
    progress(1.0, "integrating the height")
    return SVBRDF(albedo.numpy(), normal.numpy(), roughness[..., 0].numpy(), relief.numpy())
