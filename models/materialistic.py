"""Materialistic (Sharma et al. 2023): how much every pixel is of the material that was clicked on.

DINO's ViT-B/8 (Caron et al. 2021) sees the photo; four of its layers, each with its class token, become maps of four
scales; at each, the vector under the click weights all others ("cross-similarity"); the maps are fused from coarse to
fine (as in DPT, Ranftl et al. 2021), and a small network turns each pixel's vector into a score. Written from the paper
so that the parameters have the names they have in the authors' public code, after "net.":

    dino_model.<names of DINO's vision_transformer>
    spatial_transform_<1 to 4>.0.project.0, spatial_transform_<1 to 4>.2
    cross_attention_<1 to 4>.<LayerNorm|query|key|value|out|out_norm>
    cross_attention_<1 to 4>.get_reference_embedding.reference_feature_extractor.<0|2>
    fusion_<1 to 4>.<resConfUnit1|resConfUnit2>.<conv1|conv2>, fusion_<1 to 4>.out_conv, out_conv.<0|2|4|6>

The names are those the code gives; no checkpoint was at hand to confirm them, so every name and shape is checked.
Neither weights nor code of the authors are included.
"""

import torch
import torch.nn.functional as F
from torch import nn

PATCH = 8  # px
LAYERS = (2, 5, 8, 11)  # of the transformer
SCALES = (4, 2, 1, 1)  # of each layer's map, in patches
HEADS = 16  # of the cross-similarity
ROWS = 32  # of the photo, scored at once


def named(**children: nn.Module) -> nn.Module:
    """A module that only gives its children their names."""
    module = nn.Module()
    for name, child in children.items():
        module.add_module(name, child)
    return module


class Block(nn.Module):
    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = nn.LayerNorm(width, 1e-6), nn.LayerNorm(width, 1e-6)
        self.attn = named(qkv=nn.Linear(width, 3 * width), proj=nn.Linear(width, width))
        self.mlp = named(fc1=nn.Linear(width, 4 * width), fc2=nn.Linear(4 * width, width))

    def forward(self, x):
        batch, count, width = x.shape
        q, k, v = self.attn.qkv(self.norm1(x)).view(batch, count, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(batch, count, width)
        x = x + self.attn.proj(mixed)
        return x + self.mlp.fc2(F.gelu(self.mlp.fc1(self.norm2(x))))


class Dino(nn.Module):
    """The vision transformer, up to its last norm: what `LAYERS` put out, (B, 1 + patches, width) each."""

    def __init__(self, width: int, heads: int, depth: int, grid: int):
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + grid * grid, width))
        self.patch_embed = named(proj=nn.Conv2d(3, width, PATCH, PATCH))
        self.blocks = nn.ModuleList([Block(width, heads) for _ in range(depth)])
        self.norm = nn.LayerNorm(width, 1e-6)  # in the checkpoint; the layers are taken before it

    def forward(self, pixels, tick):
        x = self.patch_embed.proj(pixels)
        places = self._places(*x.shape[2:])
        x = x.flatten(2).transpose(1, 2)
        x = torch.cat([self.cls_token.expand(len(x), -1, -1), x], 1) + places
        found = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            tick()
            if index in LAYERS:
                found.append(x)
        return found

    def _places(self, rows, columns):
        width = self.pos_embed.shape[2]
        grid = round((self.pos_embed.shape[1] - 1) ** 0.5)
        if (rows, columns) == (grid, grid):
            return self.pos_embed
        square = self.pos_embed[:, 1:].reshape(1, grid, grid, width).permute(0, 3, 1, 2)
        # the original's tenth of a patch, which shifts where the bicubic samples
        scale = (rows + 0.1) / grid, (columns + 0.1) / grid
        square = F.interpolate(square, scale_factor=scale, mode="bicubic")
        return torch.cat([self.pos_embed[:, :1], square.flatten(2).transpose(1, 2)], 1)


class Context(nn.Sequential):
    """A layer's tokens, each with the class token, as a map (B, channels, h, w)."""

    def __init__(self, width: int, channels: int):
        super().__init__(
            named(project=nn.Sequential(nn.Linear(2 * width, width))), nn.Identity(), nn.Conv2d(width, channels, 1)
        )

    def forward(self, tokens, shape, scale):
        everywhere = tokens[:, :1].expand_as(tokens[:, 1:])
        x = self[0].project(torch.cat([tokens[:, 1:], everywhere], -1))
        x = self[2](x.transpose(1, 2).unflatten(2, shape))
        return F.interpolate(x, scale_factor=scale, mode="bilinear", align_corners=True) if scale > 1 else x


class CrossSimilarity(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.LayerNorm, self.out_norm = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.get_reference_embedding = named(
            reference_feature_extractor=nn.Sequential(
                nn.Linear(channels + 2, 2 * channels), nn.ReLU(), nn.Linear(2 * channels, channels)
            )
        )
        self.query, self.key, self.value, self.out = (nn.Linear(channels, channels) for _ in range(4))

    def forward(self, context, place, stride):
        """context (1, C, h, w), place (row, column) in px, stride px per value of the map."""
        channels, *shape = context.shape[1:]
        x = self.LayerNorm(context.flatten(2).transpose(1, 2))
        row, column = place[0] // stride, place[1] // stride
        # where in its cell the click lies, -1 to 1
        local = [(p - (p // stride * stride + (stride - 1) / 2)) / ((stride - 1) / 2 + 1e-4) for p in place]
        clicked = torch.cat([x[0, row * shape[1] + column], x.new_tensor(local)])
        clicked = self.get_reference_embedding.reference_feature_extractor(clicked)
        query = self.query(clicked).view(HEADS, -1)
        key, value = (linear(x).view(-1, HEADS, channels // HEADS) for linear in (self.key, self.value))
        alike = torch.sigmoid((key * query).sum(-1, keepdim=True) * (channels // HEADS) ** -0.5)
        x = self.out_norm(self.out((alike * value).flatten(1)))
        return x.T.reshape(1, channels, *shape)


class Residual(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)

    def forward(self, x):
        return x + self.conv2(F.relu(self.conv1(F.relu(x))))


class Fusion(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.out_conv = nn.Conv2d(channels, channels, 1)
        self.resConfUnit1, self.resConfUnit2 = Residual(channels), Residual(channels)
        self.layer_norm_1 = nn.LayerNorm(channels)  # in the checkpoint, without use

    def forward(self, x, coarser=None, scale=1):
        if coarser is not None:
            x = x + self.resConfUnit1(coarser)
        x = self.resConfUnit2(x)
        if scale > 1:
            x = F.interpolate(x, scale_factor=scale, mode="bilinear", align_corners=True)
        return self.out_conv(x)


class Materialistic(nn.Module):
    def __init__(self, width: int = 768, heads: int = 12, depth: int = 12, grid: int = 28, channels: int = 256):
        """As published by default; less for tests."""
        super().__init__()
        self.dino_model = Dino(width, heads, depth, grid)
        for index in range(1, 5):
            self.add_module(f"spatial_transform_{index}", Context(width, channels))
            self.add_module(f"cross_attention_{index}", CrossSimilarity(channels))
            self.add_module(f"fusion_{index}", Fusion(channels))
        sizes = (channels, channels, channels // 2, channels // 2, 1)
        steps = [x for a, b in zip(sizes, sizes[1:], strict=False) for x in (nn.Linear(a, b), nn.ReLU())]
        self.out_conv = nn.Sequential(*steps[:-1])

    def look(self, pixels: torch.Tensor, tick=lambda: None) -> list[torch.Tensor]:
        """The four maps of (1, 3, H, W) pixels, normalised as for ImageNet, H and W multiples of PATCH; `tick` is
        called after each layer."""
        shape = pixels.shape[2] // PATCH, pixels.shape[3] // PATCH
        layers = self.dino_model(pixels, tick)
        return [
            getattr(self, f"spatial_transform_{index}")(tokens, shape, scale)
            for index, (tokens, scale) in enumerate(zip(layers, SCALES, strict=True), 1)
        ]

    def score(self, maps: list[torch.Tensor], place: tuple[int, int]) -> torch.Tensor:
        """(H, W) similarity, 0 to 1, to the material at `place` (row, column), of maps as `look` gives them."""
        path = None
        for index in (4, 3, 2, 1):
            stride = PATCH // SCALES[index - 1]
            similar = getattr(self, f"cross_attention_{index}")(maps[index - 1], place, stride)
            path = getattr(self, f"fusion_{index}")(similar, path, 1 if index == 4 else 2)
        rows = path[0].permute(1, 2, 0).split(ROWS)  # the last layers are wide, in float32 a gigabyte for a photo
        return torch.cat([torch.sigmoid(self.out_conv(part))[..., 0] for part in rows])
