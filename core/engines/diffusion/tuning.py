"""Concept tuning: the region's crops, and LoRA-DreamBooth on them.

For every crop x with the prompt "an object with S* texture": z = encode(x), eps ~ N(0, I), t uniform,
z_t = sqrt(abar_t) z + sqrt(1 - abar_t) eps, and the low-rank weights (they alone) descend on |predict(z_t, t) - y|^2,
y = eps, or v = sqrt(abar_t) eps - sqrt(1 - abar_t) z for models that predict it.

Sources: Lopes, Pizzati, de Charette 2024 (crops, hyper-parameters), Ruiz et al. 2023 (DreamBooth), Hu et al. 2022
(LoRA).
"""

import json
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from ...errors import Cancelled, PaletteError
from ...tensors import read_tensors, write_tensors
from .model import Model
from .settings import DiffusionSettings

Progress = Callable[[float, str], None]

CROP_SIZES = (512, 256, 192, 128, 64)  # px of the exemplar, the largest that fits is used
SMALLER_SIZES = (48, 32)  # where none of these fits
INSIDE = 0.99  # of a crop has to lie in the region
MOST_CROPS = 100
FEW_CROPS = 4  # below it the stride is halved

TRAINING_PROMPT = "an object with S* texture"
RANK = 16
ALPHA = {"unet": 27, "text_encoder": 17, "text_encoder_2": 17}
TARGETS = {"unet": ["to_q", "to_v"], "text_encoder": ["q_proj", "v_proj"], "text_encoder_2": ["q_proj", "v_proj"]}
LEARNING_RATE = 1e-4
WEIGHT_DECAY = 1e-2
LARGEST_GRADIENT = 1.0

# the loss of one step is mostly noise; these few, of fixed noise and time, show whether it still falls
CHECKS = 8
CHECK_EVERY = 50  # steps
SETTLED = 0.01  # relative fall below which a check counts as none
PATIENCE = 4  # checks without a fall
SAVE_EVERY = 100  # steps


def cut_crops(pixels: np.ndarray, mask: np.ndarray, side: int) -> tuple[np.ndarray, int, list[str]]:
    """Square crops (n, side, side, 3) uint8 of the region, the side in px that they had, and what is worth a warning.

    pixels (h, w, 3) float32 encoded, 0 to 1; mask (h, w) bool. The paper's rule: the largest of CROP_SIZES at which any
    crop lies in the region, every size // 5 px, at most MOST_CROPS of them. Where none fits or few do, none is dropped:
    the steps between them get shorter, then the crops smaller, and at last the fullest square has its gaps painted in.
    """
    warnings = []
    inside = cv2.integral(mask.astype(np.uint8))
    for size in CROP_SIZES + SMALLER_SIZES:
        if size > min(mask.shape):
            continue
        stride = size // 5
        corners = _corners(inside, size, stride)
        while len(corners) < FEW_CROPS and stride > 1:
            stride //= 2
            corners = _corners(inside, size, stride)
        if len(corners):
            break
    if len(corners := corners if min(mask.shape) >= SMALLER_SIZES[-1] else []):
        if size in SMALLER_SIZES:
            warnings.append(f"no crop of {CROP_SIZES[-1]} px fits into the region; crops of {size} px are used")
        if len(corners) < FEW_CROPS:
            warnings.append(f"only {len(corners)} crops of {size} px fit into the region; the concept may be poor")
        if len(corners) > MOST_CROPS:
            corners = corners[np.sort(np.random.default_rng(0).permutation(len(corners))[:MOST_CROPS])]
    else:
        size = int(min(max(SMALLER_SIZES[-1], math.sqrt(mask.sum())), *mask.shape))
        corners, pixels = _fullest(inside, size), _filled(pixels, mask)
        top, left = corners[0]
        missing = 1 - mask[top : top + size, left : left + size].mean()
        warnings.append(
            f"no square of {SMALLER_SIZES[-1]} px fits into the region; one of {size} px is used, "
            f"{missing:.0%} of it painted in from its neighbours"
        )
    how = cv2.INTER_AREA if size > side else cv2.INTER_CUBIC
    crops = [cv2.resize(pixels[y : y + size, x : x + size], (side, side), interpolation=how) for y, x in corners]
    return np.rint(np.clip(np.stack(crops), 0, 1) * 255).astype(np.uint8), size, warnings


def _counts(inside: np.ndarray, size: int) -> np.ndarray:
    return inside[size:, size:] - inside[:-size, size:] - inside[size:, :-size] + inside[:-size, :-size]


def _corners(inside: np.ndarray, size: int, stride: int) -> np.ndarray:
    """(n, 2) row and column of the crops that lie in the region."""
    return np.argwhere(_counts(inside, size)[::stride, ::stride] >= INSIDE * size * size) * stride


def _fullest(inside: np.ndarray, size: int) -> np.ndarray:
    counts = _counts(inside, size)
    return np.argwhere(counts == counts.max())[:1]


def _filled(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The pixels with those outside the region painted in from its border (Telea 2004)."""
    encoded = np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)
    return cv2.inpaint(encoded, (~mask).astype(np.uint8), 3, cv2.INPAINT_TELEA).astype(np.float32) / 255


# ---------------------------------------------------------------- low-rank weights


def add_lora(model: Model) -> None:
    """Give the UNet and the text encoders low-rank weights that change nothing yet. Done once for a model."""
    from peft import LoraConfig, inject_adapter_in_model

    for part in ("unet", *model.encoders):
        config = LoraConfig(r=RANK, lora_alpha=ALPHA[part], target_modules=TARGETS[part])
        inject_adapter_in_model(config, model.parts[part], "concept")
    for parameter in lora_parameters(model).values():
        parameter.data = parameter.data.float()


def lora_parameters(model: Model) -> dict[str, torch.nn.Parameter]:
    """The low-rank weights under the names that diffusers and peft give them in files."""
    found = {}
    for part in ("unet", *model.encoders):
        for name, parameter in model.parts[part].named_parameters():
            if ".lora_" in name:
                # newer versions of transformers have left this level out, the files keep it
                if part == "text_encoder" and not name.startswith("text_model."):
                    name = "text_model." + name
                found[f"{part}.{name.replace('.concept.', '.')}"] = parameter
    return found


def _scale(name: str) -> float:
    """Other tools take alpha for the rank where a file does not say it: in files B holds alpha / rank itself."""
    return ALPHA[name.split(".")[0]] / RANK if ".lora_B." in name else 1.0


def lora_of(model: Model) -> dict[str, np.ndarray]:
    """The low-rank weights as they stand in files."""
    return {n: p.detach().float().cpu().numpy() * np.float32(_scale(n)) for n, p in lora_parameters(model).items()}


@torch.no_grad()
def set_lora(model: Model, lora: dict[str, np.ndarray]) -> None:
    """Raises PaletteError when the weights do not fit the model."""
    parameters = lora_parameters(model)
    if {n: p.shape for n, p in parameters.items()} != {n: a.shape for n, a in lora.items()}:
        raise PaletteError("the concept was learnt with another kind of model; choose that one, or learn it again")
    for name, parameter in parameters.items():
        parameter.copy_(torch.from_numpy(lora[name] / np.float32(_scale(name))))


@torch.no_grad()
def reset_lora(model: Model, seed: int = 0) -> None:
    """To weights that change nothing: A uniform as a linear layer's, B zero."""
    generator = torch.Generator().manual_seed(seed)
    for name, parameter in lora_parameters(model).items():
        if ".lora_A." in name:
            bound = 1 / math.sqrt(parameter.shape[1])
            parameter.copy_(torch.rand(parameter.shape, generator=generator) * 2 * bound - bound)
        else:
            parameter.zero_()


# ---------------------------------------------------------------- training


class _Loss:
    """The denoising loss on a concept's crops; noise, time, crop and flip depend on the step's number alone, so that a
    run that goes on is the run that was not interrupted."""

    def __init__(self, model: Model, crops: np.ndarray, settings: DiffusionSettings):
        import diffusers

        self.model, self.crops, self.moments = model, crops, {}
        self.schedule = diffusers.DDPMScheduler.from_config(model.schedule)
        self.prompt = TRAINING_PROMPT.replace("S*", settings.token)

    def __call__(self, step: int) -> torch.Tensor:
        model, schedule = self.model, self.schedule
        generator = torch.Generator().manual_seed(step)
        crop, flip = (int(torch.randint(n, (1,), generator=generator)) for n in (len(self.crops), 4))
        mean, std = self._encoded(crop, flip)
        z = mean + std * torch.randn(mean.shape, generator=generator)
        noise = torch.randn(z.shape, generator=generator)
        t = torch.randint(schedule.config.num_train_timesteps, (1,), generator=generator)
        noisy = schedule.add_noise(z, noise, t).to(model.device)
        is_v = schedule.config.prediction_type == "v_prediction"
        target = (schedule.get_velocity(z, noise, t) if is_v else noise).to(model.device)
        text = model.encode([self.prompt])
        return F.mse_loss(model.predict(noisy, t.to(model.device), text), target)

    @torch.no_grad()
    def _encoded(self, crop: int, flip: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and deviation (1, 4, h, w) of a crop's latents, computed when they are first wanted."""
        if (crop, flip) not in self.moments:
            model = self.model
            axes = [axis for bit, axis in ((1, 2), (2, 3)) if flip & bit]
            x = torch.from_numpy(self.crops[crop].transpose(2, 0, 1)[None].copy()).float().flip(axes) / 127.5 - 1
            with model.at_work("vae"), torch.autocast(model.device.type, enabled=False):
                found = model.vae.encode(x.to(model.device)).latent_dist
            scale = model.vae.config.scaling_factor
            self.moments[crop, flip] = (found.mean * scale).cpu(), (found.std * scale).cpu()
        return self.moments[crop, flip]

    @torch.no_grad()
    def settled_value(self) -> float:
        """The mean over a few fixed draws, of times spread over the schedule."""
        return float(np.mean([self(-1 - i).item() for i in range(CHECKS)]))


def tune(
    model: Model,
    crops: np.ndarray,
    settings: DiffusionSettings,
    progress: Progress,
    state: Path | None = None,
    only: tuple[str, ...] = tuple(TARGETS),
) -> tuple[dict[str, np.ndarray], list[float]]:
    """Learn a concept from crops (n, c, c, 3) uint8: the low-rank weights, and the loss every CHECK_EVERY steps.

    The model has its low-rank weights (`add_lora`); no other weight changes. state: file that the run is kept in while
    it is not done, and goes on from when it is there. Cancelling ends it within one step and keeps the state. only: the
    parts that learn.
    """
    parameters = {name: p for name, p in lora_parameters(model).items() if name.split(".")[0] in only}
    for parameter in parameters.values():
        parameter.requires_grad_(True)
    optimiser = torch.optim.AdamW(parameters.values(), LEARNING_RATE, (0.9, 0.999), weight_decay=WEIGHT_DECAY)
    scaler = torch.amp.GradScaler(model.device.type, enabled=model.dtype == torch.float16)
    loss_of = _Loss(model, crops, settings)
    reset_lora(model)
    step, checks = 0, []
    try:
        with model.at_work("unet", *model.encoders):
            if state is not None and state.exists():
                step, checks = _read_state(state, parameters, optimiser, scaler)
            model.beat = lambda: progress(step / settings.tuning_steps, _message(step, settings, checks))
            while True:
                if step % CHECK_EVERY == 0 and len(checks) <= step // CHECK_EVERY:
                    checks.append(loss_of.settled_value())
                if step >= settings.tuning_steps or settings.early_stop and _has_settled(checks):
                    break
                model.beat()
                loss = loss_of(step)
                if not torch.isfinite(loss):
                    raise PaletteError(
                        f"the loss is not finite after {step} steps of learning; use the precision fp32 or bf16"
                    )
                optimiser.zero_grad(set_to_none=True)
                scaler.scale(loss).backward()
                scaler.unscale_(optimiser)
                torch.nn.utils.clip_grad_norm_(parameters.values(), LARGEST_GRADIENT)
                scaler.step(optimiser)
                scaler.update()
                step += 1
                if state is not None and step % SAVE_EVERY == 0:
                    _write_state(state, parameters, optimiser, scaler, step, checks)
    except Cancelled:
        if state is not None and step:
            _write_state(state, parameters, optimiser, scaler, step, checks)
        raise
    finally:
        model.beat = lambda: None
        for parameter in parameters.values():
            parameter.requires_grad_(False)
    progress(1.0, f"learnt in {step} steps, loss {checks[-1]:.4f}")
    return lora_of(model), checks


def _message(step: int, settings: DiffusionSettings, checks: list[float]) -> str:
    loss = f", loss {checks[-1]:.4f}" if checks else ""
    return f"learning the concept, step {step} of {settings.tuning_steps}{loss}"


def _has_settled(checks: list[float]) -> bool:
    """Whether the last PATIENCE checks brought no real fall below the best before them."""
    if len(checks) <= PATIENCE:
        return False
    return min(checks[-PATIENCE:]) > (1 - SETTLED) * min(checks[:-PATIENCE])


def _write_state(path: Path, parameters, optimiser, scaler, step: int, checks: list[float]) -> None:
    tensors = {name: parameter.detach().cpu().numpy() for name, parameter in parameters.items()}
    for name, parameter in parameters.items():
        for moment in ("exp_avg", "exp_avg_sq"):
            tensors[f"{moment}.{name}"] = optimiser.state[parameter][moment].cpu().numpy()
    about = {"step": step, "checks": checks, "scale": scaler.get_scale()}
    path.parent.mkdir(parents=True, exist_ok=True)
    # written whole or not at all
    write_tensors(path.with_suffix(".part"), tensors, {"state": json.dumps(about)})
    path.with_suffix(".part").replace(path)


@torch.no_grad()
def _read_state(path: Path, parameters, optimiser, scaler) -> tuple[int, list[float]]:
    tensors, metadata = read_tensors(path)
    try:
        about = json.loads(metadata["state"])
        for name, parameter in parameters.items():
            parameter.copy_(torch.from_numpy(tensors[name]))
            optimiser.state[parameter] = {
                "step": torch.tensor(float(about["step"])),
                **{
                    moment: torch.from_numpy(tensors[f"{moment}.{name}"]).to(parameter.device)
                    for moment in ("exp_avg", "exp_avg_sq")
                },
            }
        if scaler.is_enabled():
            scaler.load_state_dict(scaler.state_dict() | {"scale": about["scale"]})
        return int(about["step"]), list(about["checks"])
    except (KeyError, ValueError, RuntimeError) as error:
        raise PaletteError(f"'{path}' can't be gone on from ({error}); delete it to start again") from error
