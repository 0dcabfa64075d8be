"""Sampling on the torus: a texture that tiles from a model that knows nothing of tiling.

The latents of a texture of k x k windows are one torus. Before every denoising step they are rolled by a random shift,
so that the borders of the windows, where the UNet's padding shows, never lie twice at the same place:

    x_t     <- roll(x_t, s)                        s uniform on the torus
    e       <- fold(predict(unfold(x_t), t))       window by window
    x_(t-1) <- step(roll(e, -s), t, x_t)           any scheduler

Few steps leave few shifts. There, features are rolled instead: every convolution gets a shift of its own, so that its
padding lies elsewhere; the UNet then sees the whole torus at once. Last, the pixels: `decoding`.

Sources: Lopes, Pizzati, de Charette 2024 (noise rolling); Vecchio 2024, StableMaterials (feature rolling);
Ho and Salimans 2022 (guidance).
"""

import contextlib
import inspect
from collections.abc import Callable

import numpy as np
import torch

from ... import perceptual
from .decoding import spans
from .model import Model
from .settings import DiffusionSettings

Progress = Callable[[float, str], None]

COMPARED = 8  # crops, to choose between samples
TAIL = 0.005  # of the grey values at either end, left out when colours are matched


def windows(shape: tuple[int, int], window: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Rows and columns of windows of one size that cover a torus, in reading order; they overlap where they must."""
    h, w = shape
    rows, columns = (
        [(torch.arange(min(window, side)) + start) % side for start, _ in spans(side, window)] for side in (h, w)
    )
    return [(r, c) for r in rows for c in columns]


@torch.no_grad()
def sample_latents(
    model: Model,
    text: tuple,
    nothing: tuple,
    shape: tuple[int, int],
    steps: int,
    generator: torch.Generator,
    settings: DiffusionSettings,
    progress: Progress,
) -> torch.Tensor:
    """Latents (1, 4, *shape) of a texture on the CPU; text and nothing are what `Model.encode` gives.

    shape is at least one window's, or less in multiples of `Model.step`. The same generator gives the same latents.
    """
    scheduler = model.scheduler(settings.scheduler)
    scheduler.set_timesteps(steps)
    takes_generator = "generator" in inspect.signature(scheduler.step).parameters
    more = {"generator": generator} if takes_generator else {}
    # the schedule and its noise stay on the CPU, where they are the same on every machine
    x = torch.randn(1, model.unet.config.in_channels, *shape, generator=generator) * scheduler.init_noise_sigma
    whole = settings.roll == "feature"
    places = windows(shape, max(shape) if whole else model.window)
    if whole and len(places) > 1:
        places = [(torch.arange(shape[0]), torch.arange(shape[1]))]
    times = scheduler.timesteps
    for i, t in enumerate(times):
        model.beat = lambda i=i: progress(i / len(times), f"denoising, step {i + 1} of {len(times)}")
        model.beat()
        rolling = settings.roll != "none" and i >= settings.roll_from * len(times)
        shift = [0, 0]
        if rolling and not whole:
            shift = [int(torch.randint(side, (1,), generator=generator)) for side in shape]
        scaled = scheduler.scale_model_input(x, t).roll(shift, (2, 3))
        with _rolled_features(model.unet, generator) if rolling and whole else contextlib.nullcontext():
            e = _predict_windows(model, scaled, t, text, nothing, places, settings)
        e = e.roll([-s for s in shift], (2, 3))
        x = scheduler.step(e, t, x, **more, return_dict=False)[0]
    model.beat = lambda: None
    return x.float()


def _predict_windows(model: Model, x, t, text, nothing, places, settings: DiffusionSettings) -> torch.Tensor:
    """The guided prediction for the whole torus, (1, 4, h, w), from windows; where they overlap, their mean."""
    out, count = torch.zeros_like(x, dtype=torch.float32), torch.zeros(x.shape[2:])
    distilled = model.unet.config.time_cond_proj_dim is not None
    guided = settings.guidance > 1 and not distilled
    t = t.to(model.device)
    pairs = [None if a is None else (a, b) for a, b in zip(nothing, text, strict=True)]
    for first in range(0, len(places), settings.batch):
        some = places[first : first + settings.batch]
        batch = torch.cat([x[:, :, r[:, None], c] for r, c in some]).to(model.device)
        if guided:
            both = [p and torch.cat([x.expand(len(batch), *x.shape[1:]) for x in p]) for p in pairs]
            e0, e = model.predict(torch.cat([batch, batch]), t, both).chunk(2)
            e = e0 + settings.guidance * (e - e0)
        else:
            e = model.predict(batch, t, text, settings.guidance)
        for (r, c), part in zip(some, e.cpu(), strict=True):
            out[0][:, r[:, None], c] += part
            count[r[:, None], c] += 1
    return out / count


@contextlib.contextmanager
def _rolled_features(unet, generator: torch.Generator):
    """Every convolution of the UNet sees its input rolled by a shift of its own, and its output is rolled back."""
    shifts, hooks = {}, []

    def before(module, args):
        x, stride = args[0], module.stride[0]
        sides = (side // stride for side in x.shape[2:])
        shift = shifts[module] = [int(torch.randint(side, (1,), generator=generator)) for side in sides]
        return (x.roll([s * stride for s in shift], (2, 3)), *args[1:])

    def after(module, args, out):
        return out.roll([-s for s in shifts.pop(module)], (2, 3))

    try:
        for module in unet.modules():
            if isinstance(module, torch.nn.Conv2d) and module.kernel_size[0] > 1:
                hooks += [module.register_forward_pre_hook(before), module.register_forward_hook(after)]
        yield
    finally:
        for hook in hooks:
            hook.remove()


def distance(texture: np.ndarray, crops: np.ndarray) -> float:
    """Shift-tolerant LPIPS between a texture (H, W, 3) float32 and crops (n, c, c, 3) uint8: the mean over a few places
    of the texture and a few of the crops, at the size that the model sees the crops at."""
    side = crops.shape[1]
    h, w = texture.shape[:2]
    places = [((i * h // 2 + np.arange(side)) % h, (j * w // 2 + np.arange(side)) % w) for i in (0, 1) for j in (0, 1)]
    of_texture = [perceptual.features(texture[r[:, None], c]) for r, c in places]
    total = 0.0
    some = crops[:: -(-len(crops) // COMPARED)]
    for crop in some:
        of_crop = perceptual.features(crop.astype(np.float32) / 255)
        for found in of_texture:
            total += sum(float((a - b).square().sum(0).mean()) for a, b in zip(found, of_crop, strict=True))
    return total / (len(some) * len(places))


def match_colour(pixels: np.ndarray, mean: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """The texture (H, W, 3) with the mean and deviation (3,) per channel that `colour_of` has found of a region."""
    of_texture = colour_of(pixels.reshape(-1, 3))
    scale = deviation / np.maximum(of_texture[1], 1e-4)
    return np.clip((pixels - of_texture[0]) * scale + mean, 0, 1).astype(np.float32)


def colour_of(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation (3,) of pixels (n, 3) whose grey value is none of the most extreme."""
    grey = pixels.mean(1)
    low, high = np.quantile(grey, (TAIL, 1 - TAIL))
    some = pixels[(grey >= low) & (grey <= high)].astype(np.float64)
    return some.mean(0).astype(np.float32), some.std(0).astype(np.float32)
