"""Engine `diffusion`: Stable Diffusion learns the region as a concept and samples a tileable texture of it.

The method of Lopes, Pizzati, de Charette (CVPR 2024), whole: crops -> LoRA-DreamBooth (`tuning`) -> noise rolling on
the torus of latents (`sampling`) -> pixels patch by patch (`decoding`) -> what border seam is left is closed, the
region's colour is matched, and of several samples the one nearest to the crops is kept. Needs weights and packages of
the user's (docs/diffusion.md); nothing of either is imported with this module.
"""

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch

from ... import torus
from ...errors import PaletteError
from ...tensors import read_tensors, write_tensors
from . import decoding, memory, sampling, tuning
from .model import Model, load, locate, require_packages
from .settings import DiffusionSettings

__all__ = ["Concept", "DiffusionSettings", "Engine", "Texture", "load_concept", "save_concept"]

Progress = Callable[[float, str], None]

PROMPTS = (
    "top view realistic texture of S*",
    "top view realistic S* texture",
    "high resolution realistic S* texture in top view",
    "realistic S* texture in top view",
)
QUALITY = {"draft": (25, 1), "balanced": (50, 1), "best": (50, 4)}  # steps, candidates
CROP_SIDES = {False: 256, True: 512}  # px that the model sees, by whether it is SDXL
LOADING = 0.05  # share of learning
CONCEPT_VERSION = 1


@dataclass
class Concept:
    """What is learnt of a region.

    lora: low-rank weights by their names in files; crops (n, c, c, 3) uint8 encoded; colour: mean and deviation (3,)
    of the region, encoded; crop_px: the crops' side in the exemplar; model: `Model.identity`; losses: every
    tuning.CHECK_EVERY steps.
    """

    lora: dict[str, np.ndarray]
    crops: np.ndarray
    crop_px: int
    colour: tuple[np.ndarray, np.ndarray]
    token: str
    model: str
    losses: list[float]
    warnings: list[str] = field(default_factory=list)


@dataclass
class Texture:
    """pixels (H, W, 3) float32 encoded, 0 to 1; latents (1, 4, h, w) they come from; distance to the crops, or None;
    warnings: the concept's."""

    pixels: np.ndarray
    latents: torch.Tensor
    prompt: str
    distance: float | None = None
    warnings: list[str] = field(default_factory=list)


class Engine:
    """The model in memory, for as many regions as there are; read when it is first needed.

    Raises PaletteError for settings that cannot be honoured, missing packages and a model that is not there.
    """

    LEARNING_SHARE = 0.5  # 800 steps with gradients, or 50 of four windows with guidance

    def __init__(self, settings: DiffusionSettings | None):
        self.settings = settings or DiffusionSettings()
        self.settings.check()
        require_packages()
        if not self.settings.online:
            locate(self.settings, lambda fraction, message: None)
        self.threads = torch.get_num_threads()
        self._model: Model | None = None

    def model(self, progress: Progress) -> Model:
        """The model with its low-rank weights added. Raises PaletteError as `model.load` does."""
        if self._model is None:
            model = load(self.settings, progress)
            tuning.add_lora(model)
            self._model = model
        return self._model

    def learn(self, pixels: np.ndarray, mask: np.ndarray, progress: Progress) -> Concept:
        """The concept of an exemplar, from the folder of concepts where it has been learnt before.

        pixels (h, w, 3) float32, perceptually encoded, 0 to 1; mask (h, w) bool, the region.
        """
        settings = self.settings
        with self._working():
            model = self.model(lambda fraction, message: progress(LOADING * fraction, message))
            side = settings.crop_size or CROP_SIDES[model.is_xl]
            side = max(model.factor * model.step, side // (model.factor * model.step) * model.factor * model.step)
            kept = self._kept(model, pixels, mask, side)
            if kept is not None and (kept / "concept.json").exists():
                progress(1.0, "this region's concept was learnt before")
                return load_concept(kept)
            crops, crop_px, warnings = tuning.cut_crops(pixels, mask, side)
            stated = memory.fit(model, settings, side // model.factor, tuning=True)
            progress(LOADING, f"learning the concept: {stated}")
            lora, losses = tuning.tune(
                model,
                crops,
                settings,
                lambda fraction, message: progress(LOADING + (1 - LOADING) * fraction, message),
                kept and kept.with_name(kept.name + ".state.safetensors"),
            )
        colour = sampling.colour_of(pixels[mask])
        concept = Concept(lora, crops, crop_px, colour, settings.token, model.identity, losses, warnings)
        if kept is not None:
            save_concept(concept, kept)
            kept.with_name(kept.name + ".state.safetensors").unlink(missing_ok=True)
        return concept

    def sample(
        self, concept: Concept, size: tuple[int, int], seed: int, progress: Progress, quality: str = "balanced"
    ) -> Texture:
        """A tileable texture of size (H, W) px. The same model, concept, settings and seed give the same texture."""
        settings = self.settings
        steps, candidates = QUALITY[quality]
        steps, candidates = settings.steps or steps, settings.candidates or candidates
        generator = torch.Generator().manual_seed(seed)
        with self._working(), torch.no_grad():
            model = self.model(lambda fraction, message: progress(0.0, message))
            if model.identity != concept.model:
                raise PaletteError("the concept was learnt with another model; choose that one, or learn it again")
            shape = latent_shape(model, size)
            seen = max(shape) if settings.roll == "feature" else model.window
            stated = memory.fit(model, settings, seen, shape=shape)
            progress(0.0, f"sampling: {stated}")
            tuning.set_lora(model, concept.lora)
            best = None
            for i in range(candidates):
                number = f"sample {i + 1} of {candidates}: " if candidates > 1 else ""

                def report(fraction, message, i=i, number=number):
                    progress((i + fraction) / candidates, number + message)

                prompt = settings.prompt or PROMPTS[int(torch.randint(len(PROMPTS), (1,), generator=generator))]
                prompt = prompt.replace("S*", concept.token)
                texture = self._sample_once(model, prompt, concept.colour, shape, steps, generator, report)
                if candidates > 1:
                    texture.distance = sampling.distance(texture.pixels, concept.crops)
                if best is None or texture.distance < best.distance:
                    best = texture
        best.pixels = torus.resize(best.pixels, size).clip(0, 1)
        best.warnings = concept.warnings
        progress(1.0, "sampled")
        return best

    def sample_prompt(
        self, prompt: str, size: tuple[int, int], seed: int, steps: int, progress: Progress = lambda f, m: None
    ) -> Texture:
        """A tileable texture (H, W) px of what the model itself knows by a prompt, in the colours that it has."""
        generator = torch.Generator().manual_seed(seed)
        with self._working(), torch.no_grad():
            model = self.model(progress)
            shape = latent_shape(model, size)
            memory.fit(model, self.settings, model.window, shape=shape)
            tuning.reset_lora(model)
            texture = self._sample_once(model, prompt, None, shape, steps, generator, progress)
        texture.pixels = torus.resize(texture.pixels, size).clip(0, 1)
        return texture

    def _sample_once(
        self, model: Model, prompt: str, colour: tuple | None, shape, steps, generator, progress
    ) -> Texture:
        with model.at_work(*model.encoders):
            text, nothing = model.encode([prompt]), model.nothing()
        with model.at_work("unet"):
            latents = sampling.sample_latents(
                model, text, nothing, shape, steps, generator, self.settings, lambda f, m: progress(0.9 * f, m)
            )
        pixels = decoding.decode(model, latents, lambda f, m: progress(0.9 + 0.09 * f, m))
        if colour is not None:
            pixels = sampling.match_colour(pixels, *colour)
        if torus.wrap_ratio(pixels) > torus.WRAP_GATE:
            progress(0.99, "closing the seam")
            pixels = torus.close_seam(torch.from_numpy(pixels)).clamp(0, 1).numpy()
        return Texture(pixels, latents, prompt)

    def _kept(self, model: Model, pixels: np.ndarray, mask: np.ndarray, side: int) -> Path | None:
        """Where this region's concept is kept: named by all that it depends on."""
        if not self.settings.concepts:
            return None
        digest = hashlib.sha256(np.rint(np.clip(pixels, 0, 1) * 65535).astype("<u2")[mask].tobytes())
        digest.update(np.packbits(mask).tobytes())
        asked = self.settings.tuning_steps, self.settings.early_stop, self.settings.token, self.settings.prediction
        digest.update(repr((CONCEPT_VERSION, mask.shape, model.identity, str(model.dtype), side, asked)).encode())
        return Path(self.settings.concepts).expanduser() / digest.hexdigest()[:24]

    @contextlib.contextmanager
    def _working(self):
        """All cores of the CPU, and memory that runs out said in words."""
        before = torch.get_num_threads()
        torch.set_num_threads(self.threads)
        try:
            yield
        except torch.OutOfMemoryError as error:
            raise PaletteError(f"the device's memory is full ({str(error).split('.')[0]}); {memory.WAY_OUT}") from error
        finally:
            torch.set_num_threads(before)


def latent_shape(model: Model, size: tuple[int, int]) -> tuple[int, int]:
    """Height and width of the latents for a texture of size (H, W) px: no less than half a window, below which the
    model makes no sense, and where less than a window in steps of what the UNet can halve."""
    sides = [max(-(-side // model.factor), model.window // 2) for side in size]
    return tuple(side if side >= model.window else -(-side // model.step) * model.step for side in sides)


def save_concept(concept: Concept, folder: Path) -> None:
    """Write concept.json, lora.safetensors (which diffusers' load_lora_weights reads) and crops.safetensors.

    The folder appears whole or not at all; an earlier one is replaced.
    """
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        about = asdict(concept)
        about["colour"] = [values.tolist() for values in concept.colour]
        about = {"version": CONCEPT_VERSION} | {k: v for k, v in about.items() if k not in ("lora", "crops")}
        (staging / "concept.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
        write_tensors(staging / "lora.safetensors", concept.lora, {"format": "pt"})
        write_tensors(staging / "crops.safetensors", {"crops": concept.crops})
        if folder.exists():
            shutil.rmtree(folder)
        os.rename(staging, folder)
    except OSError as error:
        raise PaletteError(f"the concept can't be kept in '{folder}': {error.strerror or error}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def load_concept(folder: Path) -> Concept:
    """Read what `save_concept` wrote. Raises PaletteError naming the file that is missing or damaged."""
    folder = Path(folder)
    path = folder / "concept.json"
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        if about.pop("version") != CONCEPT_VERSION:
            raise PaletteError(f"'{path}' is of another version; delete its folder, and the concept is learnt again")
        about["colour"] = tuple(np.array(values, np.float32) for values in about["colour"])
        lora, _ = read_tensors(folder / "lora.safetensors")
        crops, _ = read_tensors(folder / "crops.safetensors")
        return Concept(lora=lora, crops=crops["crops"], **about)
    except OSError as error:
        raise PaletteError(f"cannot read '{path}': {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise PaletteError(f"'{path}' is damaged ({error}); delete its folder to learn the concept again") from error
