"""Latents to pixels on the torus, in memory that does not grow with the texture.

A torus of one patch is decoded at once, its convolutions padded circularly: exactly what the decoder makes of the
endlessly repeated texture. A larger one is decoded patch by patch, each with a margin of latents around it that wraps.
Two things in the decoder look at all of the picture, and would leave every patch a tone of its own: the group
normalisations and the middle block's attention. What they have to know is found first, from squares evenly spread over
the torus, which go through the decoder side by side, layer by layer:

    mu, sigma of a group <- over the squares without their margins, of what the layers before make of them
    keys, values         <- from the tokens of the same places

then every patch is decoded with these. Up to two patches a side the squares cover all, and what is missing is only what
lies further away than the margin; a larger texture's statistics are those of this sample.

Sources: Lopes, Pizzati, de Charette 2024 (patches, margins that wrap, ramps); the order of the layers is that of the
decoder of Rombach et al. 2022, as diffusers has it.
"""

import contextlib
import functools
import itertools
from collections.abc import Callable

import numpy as np
import torch

from .model import Model

Progress = Callable[[float, str], None]

PATCH = 64  # latents, of a side at most
MARGIN = 8  # latents around a patch: with random weights what lies further away moves a pixel by 0.1 % of the contrast
BLEND = 1  # latents on either side of a border over which neighbours are blended
SQUARES = 4  # of half a patch, along a side at most, that the statistics are taken from


@torch.no_grad()
def decode(
    model: Model, latents: torch.Tensor, progress: Progress, patch: int = PATCH, margin: int = MARGIN
) -> np.ndarray:
    """The pixels (H, W, 3) float32 in [0, 1], encoded, of latents (1, 4, h, w); wraps.

    patch: side of what is decoded at once, margin: what is seen around it, both in latents.
    """
    config = model.vae.config
    z = latents / config.scaling_factor + (getattr(config, "shift_factor", None) or 0)
    try:
        with model.at_work("vae"), torch.autocast(model.device.type, enabled=False):
            if max(z.shape[2:]) <= patch:
                model.beat = lambda: progress(0.0, "decoding the texture")
                with _circular(model.vae):
                    picture = model.vae.decode(z.to(model.device), return_dict=False)[0][0].float().cpu()
            else:
                picture = _decode_patches(model, z, patch, margin, progress)
    finally:
        model.beat = lambda: None
    return picture.add_(1).div_(2).clamp_(0, 1).permute(1, 2, 0).contiguous().numpy()


def spans(length: int, longest: int) -> list[tuple[int, int]]:
    """(start, end) of as few equal parts of a circle as are no longer than this."""
    count = -(-length // longest)
    edges = [round(i * length / count) for i in range(count + 1)]
    return list(zip(edges[:-1], edges[1:], strict=True))


def _sample(length: int, longest: int) -> list[tuple[int, int]]:
    """(start, end) of at most SQUARES parts no longer than this, in the middle of as many equal parts of a circle."""
    count = min(SQUARES, -(-length // longest))
    found = [((start + end) // 2, min(longest, end - start)) for start, end in spans(length, -(-length // count))]
    return [(middle - side // 2, middle - side // 2 + side) for middle, side in found]


def waiting(model: Model, shape: tuple[int, int]) -> int:
    """Bytes in the computer's memory that the squares take at most, while a texture of latents (h, w) is decoded."""
    if max(shape) <= PATCH:
        return 0
    counts = [len(_sample(side, PATCH // 2)) for side in shape]
    pixels = ((PATCH // 2 + 2 * MARGIN) * model.factor) ** 2
    # the last level begins with the channels of the one before, in full precision
    return 4 * counts[0] * counts[1] * pixels * model.vae.config.block_out_channels[1]


@contextlib.contextmanager
def _circular(module: torch.nn.Module):
    """Convolutions that wrap."""
    convolutions = [m for m in module.modules() if isinstance(m, torch.nn.Conv2d) and m.kernel_size[0] > 1]
    try:
        for convolution in convolutions:
            convolution.padding_mode = "circular"
        yield
    finally:
        for convolution in convolutions:
            convolution.padding_mode = "zeros"


def _decode_patches(model: Model, z: torch.Tensor, patch: int, margin: int, progress: Progress) -> torch.Tensor:
    (h, w), f = z.shape[2:], model.factor
    blend = min(BLEND, margin)
    rows, columns = spans(h, patch), spans(w, patch)
    places = list(itertools.product(_sample(h, patch // 2), _sample(w, patch // 2)))
    before = len(places) / 4  # what the squares cost, in patches
    total = before + len(rows) * len(columns)

    def report(done):
        model.beat = lambda: progress(done / total, "decoding the texture")
        model.beat()

    def cut(row, column):
        r, c = (torch.arange(start - margin, end + margin) for start, end in (row, column))
        return z[:, :, (r % h)[:, None], c % w]

    picture = torch.zeros(3, h * f, w * f)
    with _seeing_all(model, [cut(*place) for place in places], margin, lambda f: report(f * before)):
        for i, row in enumerate(rows):
            y, weight_y = _ramped(*row, blend, f)
            band = torch.zeros(3, len(y), w * f)
            for j, column in enumerate(columns):
                report(before + i * len(columns) + j)
                x, weight_x = _ramped(*column, blend, f)
                pixels = model.vae.decode(cut(row, column).to(model.device), return_dict=False)[0][0].float().cpu()
                off = (margin - blend) * f
                pixels = pixels[:, off : off + len(y), off : off + len(x)]
                # columns of a patch as wide as the torus come twice: index_add_ adds both
                band.index_add_(2, x % (w * f), pixels * (weight_y[:, None] * weight_x))
            picture.index_add_(1, y % (h * f), band)
    return picture


def _ramped(start: int, end: int, blend: int, f: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Lines of a patch and of what it shares with its neighbours, in pixels, and their weights, which add up to 1."""
    lines = torch.arange((start - blend) * f, (end + blend) * f)
    if not blend:
        return lines, torch.ones(len(lines))
    nearest = torch.minimum(lines - lines[0], lines[-1] - lines) + 0.5
    return lines, (nearest / (2 * blend * f)).clamp_max(1)


class _Reached(Exception):
    """The layer whose input was wanted."""


@contextlib.contextmanager
def _seeing_all(model: Model, patches: list[torch.Tensor], margin: int, report: Callable[[float], None]):
    """The decoder with normalisations and attention that know the whole, as these patches (1, 4, h, w) show it.

    The patches wait for each other in the computer's memory; one is on the device at a time. report(fraction).
    """
    sides = [tuple(x.shape[2:]) for x in patches]
    changed = []

    def change(layer, forward):
        changed.append(layer)
        layer.forward = forward

    def core(x, i):
        """Patch i without its margin, (C, n), of (1, C, h, w) or, as attention has it, (1, C, h w)."""
        h, w = sides[i]
        scale = round((x[0, 0].numel() / (h * w)) ** 0.5)
        off = margin * scale
        x = x.reshape(x.shape[1], h * scale, w * scale)
        return x[:, off : h * scale - off, off : w * scale - off].flatten(1)

    def inputs(layer, norm):
        """What reaches a normalisation in a layer, patch by patch."""

        def stop(_, arguments):
            seen.append(arguments[0])
            raise _Reached

        seen, hook = [], norm.register_forward_pre_hook(stop)
        try:
            for i, x in enumerate(patches):
                with contextlib.suppress(_Reached):
                    _run(layer, x.to(model.device))
                yield core(seen.pop(), i)
        finally:
            hook.remove()

    def normalise(layer, norm):
        found = []
        for x in inputs(layer, norm):
            groups = x.reshape(norm.num_groups, -1)
            variance, mean = torch.var_mean(groups, 1, correction=0)
            found.append((groups.shape[1], mean.cpu().double(), variance.cpu().double()))
        count = sum(n for n, _, _ in found)
        mean = sum(n * m for n, m, _ in found) / count
        variance = sum(n * (v + (m - mean) ** 2) for n, m, v in found) / count
        each = norm.num_channels // norm.num_groups
        mean, deviation = (
            a.float().repeat_interleave(each).to(model.device) for a in (mean, (variance + norm.eps).sqrt())
        )
        scale = norm.weight / deviation
        offset = norm.bias - mean * scale
        change(norm, lambda x: torch.addcmul(_beside(offset, x), x, _beside(scale, x)))

    def attend(layer):
        # its normalisation is known by now, and what comes out of that is what keys and values are made of
        tokens = [layer.group_norm(x[None])[0].T for x in list(inputs(layer, layer.group_norm))]
        change(layer, functools.partial(layer.forward, encoder_hidden_states=torch.cat(tokens)[None]))

    try:
        layers = _layers(model.vae)
        for k, layer in enumerate(layers):
            report(k / len(layers))
            for norm in [inner for inner in layer.modules() if isinstance(inner, torch.nn.GroupNorm)]:
                normalise(layer, norm)
            if isinstance(getattr(layer, "group_norm", None), torch.nn.GroupNorm):
                attend(layer)
            for i, x in enumerate(patches if layer is not layers[-1] else ()):
                patches[i] = _run(layer, x.to(model.device)).cpu()
        yield
    finally:
        for layer in changed:
            del layer.forward


def _beside(values: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Values of the channels (C,) shaped to meet x (n, C, ...)."""
    return values.view(-1, *[1] * (x.dim() - 2))


def _layers(vae) -> list[torch.nn.Module]:
    """What the decoder does, one after the other, up to its last normalisation."""
    decoder, middle = vae.decoder, vae.decoder.mid_block
    layers = [vae.post_quant_conv] if vae.post_quant_conv is not None else []
    layers += [decoder.conv_in, middle.resnets[0]]
    for attention, resnet in zip(middle.attentions, middle.resnets[1:], strict=True):
        layers += [attention, resnet] if attention is not None else [resnet]
    for block in decoder.up_blocks:
        layers += [*block.resnets, *(block.upsamplers or ())]
    return [*layers, decoder.conv_norm_out]


def _run(layer: torch.nn.Module, x: torch.Tensor) -> torch.Tensor:
    # diffusers' blocks want the embedding of a time step, which decoders have none of
    return layer(x, None) if type(layer).__name__ == "ResnetBlock2D" else layer(x)
