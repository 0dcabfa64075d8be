"""What a run will need of the device's memory: said before it starts, refused with a way out where it does not fit."""

import math

import torch

from ...errors import PaletteError
from . import decoding
from .model import PARTS, Model
from .settings import DiffusionSettings

GB = 1e9
# bytes of activations per pixel of the latents, per channel of the UNet's first block, per byte of the precision
SAMPLING = 60.0
TUNING = 120.0
# bytes per pixel and channel of the VAE's first block, in full precision
DECODING = 45.0
ENCODING = 25.0
RESERVE = 0.3 * GB  # the device's own, and what the libraries hold
WAY_OUT = (
    "close other programs, or lower: batch to 1, precision to fp16 or bf16, the model to one of SD 1.x; roll to noise; "
    "or take the device cpu"
)


def needed(
    model: Model, settings: DiffusionSettings, side: int, tuning: bool = False, shape: tuple[int, int] | None = None
) -> tuple[float, float]:
    """Bytes at the peak with all parts on the device, and with only the part at work there (offload).

    side: of the latents that the UNet sees at once; shape: of all latents, None: one window.
    """
    weights = {name: _bytes(model.parts[name]) for name in PARTS if name in model.parts}
    per_pixel = model.unet.config.block_out_channels[0] * torch.finfo(model.dtype).bits // 8
    # with guidance two pictures at once
    pictures = 1 if tuning else settings.batch * (2 if settings.guidance > 1 else 1)
    unet = (TUNING if tuning else SAMPLING) * side**2 * per_pixel * pictures
    shape = shape or (side, side)
    if tuning:
        vae = ENCODING * (side * model.factor) ** 2
    elif max(shape) <= decoding.PATCH:
        vae = DECODING * math.prod(shape) * model.factor**2
    else:
        vae = DECODING * ((decoding.PATCH + 2 * decoding.MARGIN) * model.factor) ** 2
    vae *= model.vae.config.block_out_channels[0]
    if model.device.type == "cpu" and not tuning:
        vae += decoding.waiting(model, shape)
    # learning, the text encoders work together with the UNet
    with_unet = weights["unet"] + unet + (sum(weights[name] for name in model.encoders) if tuning else 0)
    return sum(weights.values()) + max(unet, vae) + RESERVE, max(with_unet, weights["vae"] + vae) + RESERVE


def _bytes(module) -> int:
    return sum(parameter.numel() * parameter.element_size() for parameter in module.parameters())


def free(model: Model) -> float:
    """Bytes on the model's device that are free or held by this program."""
    if model.device.type == "cuda":
        return torch.cuda.mem_get_info(model.device)[0] + torch.cuda.memory_reserved(model.device)
    if model.device.type == "mps":
        return torch.mps.recommended_max_memory()
    import psutil  # comes with accelerate

    return psutil.virtual_memory().available + sum(_bytes(model.parts[name]) for name in PARTS if name in model.parts)


def fit(
    model: Model, settings: DiffusionSettings, side: int, tuning: bool = False, shape: tuple[int, int] | None = None
) -> str:
    """Decide on offloading and say what the run will need. Raises PaletteError when it does not fit."""
    whole, alone = needed(model, settings, side, tuning, shape)
    there = free(model)
    # on the CPU the weights have nowhere else to go
    may_offload = model.device.type != "cpu"
    model.offload = may_offload and (whole > there if settings.offload is None else settings.offload)
    need = alone if model.offload else whole
    if need > there:
        raise PaletteError(
            f"{'learning' if tuning else 'sampling'} needs about {need / GB:.1f} GB of memory on {model.device}, "
            f"{there / GB:.1f} GB are free: {WAY_OUT}"
        )
    how = ", one part at a time" if model.offload else ""
    return f"needs about {need / GB:.1f} GB of {there / GB:.1f} GB free on {model.device}{how}"
