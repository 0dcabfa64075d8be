"""A Stable Diffusion model in parts, whatever it comes as, and what the engine asks of it: encode, predict, decode.

SD 1.x, 2.x (epsilon or v) and SDXL; a folder in diffusers' format, a single .safetensors file, or a hub id. Weights are
read from safetensors files only: a pickle can run code when it is opened.
"""

import contextlib
import hashlib
import inspect
import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch

from ... import dependencies
from ...errors import PaletteError
from . import checkpoint
from .settings import DiffusionSettings

Progress = Callable[[float, str], None]

PICKLES = (".ckpt", ".pt", ".pth", ".bin")
PARTS = ("unet", "vae", "text_encoder", "text_encoder_2")
CLASSES = {
    "unet": ("UNet2DConditionModel",),
    "vae": ("AutoencoderKL",),
    "text_encoder": ("CLIPTextModel",),
    "text_encoder_2": ("CLIPTextModelWithProjection",),
}
PRECISIONS = {"fp32": torch.float32, "fp16": torch.float16, "bf16": torch.bfloat16}
NOT_PICKLED = (
    "a pickle, which can run code when it is opened, so it is not. Most models are published as .safetensors too: "
    "take that file, or convert this one where you trust it (diffusers' scripts do)"
)


@dataclass
class Model:
    """parts: unet, vae, text_encoder(_2), tokenizer(_2); schedule: the scheduler's configuration.

    Latents are (n, 4, h, w), pixels / factor. window is the side of the latents that the UNet was trained on.
    """

    parts: dict
    schedule: dict
    zeros_for_empty: bool
    identity: str
    device: torch.device
    dtype: torch.dtype
    offload: bool = False
    beat: Callable[[], None] = field(default=lambda: None)

    @property
    def unet(self):
        return self.parts["unet"]

    @property
    def vae(self):
        return self.parts["vae"]

    @property
    def encoders(self) -> list[str]:
        return [name for name in ("text_encoder", "text_encoder_2") if name in self.parts]

    @property
    def is_xl(self) -> bool:
        return "text_encoder_2" in self.parts

    @property
    def factor(self) -> int:
        return 2 ** (len(self.vae.config.block_out_channels) - 1)

    @property
    def window(self) -> int:
        return self.unet.config.sample_size

    @property
    def step(self) -> int:
        """Sides of what the UNet is given are multiples of it: each of its levels halves the latents."""
        return 2 ** (len(self.unet.config.block_out_channels) - 1)

    def scheduler(self, name: str = ""):
        """The model's own scheduler, or diffusers' one of this name with the model's noise schedule."""
        import diffusers

        kind = getattr(diffusers, name or self.schedule["_class_name"], None)
        if not (inspect.isclass(kind) and issubclass(kind, diffusers.SchedulerMixin)):
            raise PaletteError(f"diffusers has no scheduler '{name}'; choose one, such as DPMSolverMultistepScheduler")
        return kind.from_config(self.schedule)

    @contextlib.contextmanager
    def at_work(self, *names: str):
        """These parts on the device; with offload no other is there."""
        for name in names:
            self.parts[name].to(self.device)
        try:
            with torch.autocast(self.device.type, self.dtype, enabled=self.dtype != torch.float32):
                yield
        finally:
            if self.offload:
                for name in names:
                    self.parts[name].to("cpu")

    def encode(self, prompts: list[str]) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Embeddings (n, tokens, d) and, of SDXL, pooled ones (n, p) for the UNet."""
        states, pooled = [], None
        for name in self.encoders:
            tokenizer, encoder = self.parts[name.replace("text_encoder", "tokenizer")], self.parts[name]
            length = min(tokenizer.model_max_length, encoder.config.max_position_embeddings)
            tokens = tokenizer(prompts, padding="max_length", max_length=length, truncation=True, return_tensors="pt")
            # SDXL was trained on the last but one layer of both encoders, and on the second one's pooled text
            out = encoder(tokens.input_ids.to(self.device), output_hidden_states=self.is_xl)
            states.append(out.hidden_states[-2] if self.is_xl else out[0])
            pooled = out[0] if name == "text_encoder_2" else pooled
        return torch.cat(states, -1), pooled

    def nothing(self) -> tuple[torch.Tensor, torch.Tensor | None]:
        """The embeddings of no prompt, (1, tokens, d) and (1, p), for classifier-free guidance."""
        states, pooled = self.encode([""])
        if self.zeros_for_empty and pooled is not None:
            states, pooled = torch.zeros_like(states), torch.zeros_like(pooled)
        return states, pooled

    def predict(self, latents, t, text, guidance: float | None = None) -> torch.Tensor:
        """The UNet's prediction (n, 4, h, w), float32, of noisy latents at time t; text as `encode` gives it."""
        states, pooled = (x if x is None else x.expand(len(latents), *x.shape[1:]) for x in text)
        more = {}
        if pooled is not None:
            h, w = (side * self.factor for side in latents.shape[2:])
            # original size, corner of the crop, target size
            sizes = torch.tensor([[h, w, 0, 0, h, w]], dtype=states.dtype, device=latents.device)
            more["added_cond_kwargs"] = {"text_embeds": pooled, "time_ids": sizes.expand(len(latents), 6)}
        if self.unet.config.time_cond_proj_dim is not None:
            # distilled models take the guidance as an input (Luo et al. 2023)
            size = self.unet.config.time_cond_proj_dim
            more["timestep_cond"] = _sinusoids(((guidance or 1) - 1) * 1000, size).to(states)
        return self.unet(latents.to(self.dtype), t, encoder_hidden_states=states.to(self.dtype), **more).sample.float()


def _sinusoids(value: float, size: int) -> torch.Tensor:
    """(1, size): a number as sines and cosines of falling frequency."""
    half = size // 2
    angles = value * torch.exp(torch.arange(half) * (-math.log(10000) / (half - 1)))
    return torch.cat([angles.sin(), angles.cos()])[None]


def load(settings: DiffusionSettings, progress: Progress) -> Model:
    """Read the model that the settings name onto the CPU; `Model.at_work` brings it to the device.

    Raises PaletteError when packages are missing, when the model is not there, is a pickle, is of another kind or is
    not whole, when it would have to be fetched without consent, and for a device that is not there.
    """
    require_packages()
    device = _device(settings.device)
    dtype = PRECISIONS[settings.precision] if settings.precision else _dtype(device)
    progress(0.0, "looking for the model")
    path = locate(settings, progress)
    progress(0.1, "reading the model")
    with _quiet():
        parts = checkpoint.load(path, dtype) if path.is_file() else _read_folder(path, dtype)
    for name in PARTS:
        if name in parts:
            parts[name].requires_grad_(False).eval()
    if parts["unet"].config.in_channels != parts["vae"].config.latent_channels:
        raise PaletteError(f"'{path}' is an inpainting or editing model; choose the base model of its family")
    parts["unet"].enable_gradient_checkpointing()
    if device.type == "mps":
        parts["unet"].set_attention_slice("auto")
    zeros = parts.pop("zeros_for_empty", "text_encoder_2" in parts)
    model = Model(parts, parts.pop("scheduler"), zeros, identity(path), device, dtype)
    if settings.prediction:
        model.schedule["prediction_type"] = settings.prediction
    elif not model.schedule.get("prediction_type"):
        model.schedule["prediction_type"] = _tried_prediction(model)
    for module in [*parts["unet"].modules(), *parts["vae"].modules()]:
        if type(module).__name__ == "ResnetBlock2D":
            # a look at the clock in every block: a step can take longer than a user who cancels waits
            module.register_forward_pre_hook(lambda *_: model.beat())
    return model


def require_packages() -> None:
    """Raise PaletteError naming the packages that are missing and the command that installs them."""
    lacking = dependencies.missing(dependencies.DIFFUSION)
    if lacking:
        names = ", ".join(entry.package for entry in lacking)
        raise PaletteError(
            f"the engine 'diffusion' needs packages that are missing: {names}. Install them with: "
            f"{dependencies.install_command(lacking)}"
        )


def locate(settings: DiffusionSettings, progress: Progress) -> Path:
    """The local file or folder of the model; a hub id is fetched where that is allowed."""
    name = settings.model
    path = Path(name).expanduser()
    if path.suffix.lower() in PICKLES:
        raise PaletteError(f"the model '{name}' is {NOT_PICKLED}")
    if path.is_file():
        if path.suffix.lower() != ".safetensors":
            raise PaletteError(f"the model '{name}' is no .safetensors file; choose one, or a folder")
        return path
    if path.is_dir():
        return path
    owner, slash, repository = name.partition("/")
    if not (owner.strip(".~") and slash and repository) or "/" in repository or "\\" in name or path.suffix:
        raise PaletteError(f"there is no model '{name}'; name a folder, a .safetensors file or a hub id (owner/name)")
    return _fetch(name, settings.online, progress)


def _fetch(name: str, online: bool, progress: Progress) -> Path:
    """The hub's model in the hub's own cache: what is there already, else fetched file by file."""
    from huggingface_hub import HfApi, hf_hub_download, snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    patterns = [f"{part}/*{end}" for part in PARTS for end in (".json", ".safetensors")]
    patterns += ["model_index.json", "scheduler/*.json", "tokenizer*/*.json", "tokenizer*/*.txt"]
    if not online:
        try:
            return Path(snapshot_download(name, allow_patterns=patterns, local_files_only=True))
        except (LocalEntryNotFoundError, HFValidationError):
            raise PaletteError(
                f"there is no folder or file '{name}', and as a hub id it would have to be fetched: allow it (headless "
                "--online; in Blender: Preferences > System > Allow Online Access), or name a local copy"
            ) from None
    try:
        from fnmatch import fnmatch

        names = HfApi().list_repo_files(name)
        names = [n for n in names if any(fnmatch(n, pattern) for pattern in patterns)]
        # of several precisions of one file the half one is enough; "non_ema" and the like are for training on
        halves = {n.replace(".fp16.", ".") for n in names if ".fp16." in n}
        names = [n for n in names if n not in halves and "non_ema" not in n]
        for i, file in enumerate(names):
            progress(0.1 * i / len(names), f"fetching {file} of {name}")
            path = hf_hub_download(name, file)
    except (HfHubHTTPError, HFValidationError, OSError) as error:
        raise PaletteError(
            f"the model '{name}' can't be fetched from the hub ({str(error).splitlines()[0]}); check the name and the "
            "connection, or name a local copy"
        ) from error
    if not names:
        raise PaletteError(f"the hub's '{name}' holds no model in diffusers' format with .safetensors files")
    return Path(path[: -len(file)])


def _read_folder(folder: Path, dtype: torch.dtype) -> dict:
    import diffusers
    import transformers

    try:
        index = json.loads((folder / "model_index.json").read_text(encoding="utf-8"))
        schedule = json.loads((folder / "scheduler" / "scheduler_config.json").read_text(encoding="utf-8"))
    except OSError as error:
        raise PaletteError(
            f"'{folder}' is no model in diffusers' format ({Path(error.filename).name} is missing); choose the folder "
            "that holds model_index.json, or a .safetensors file"
        ) from None
    except ValueError as error:
        raise PaletteError(f"'{folder}': model_index.json or the scheduler's is damaged ({error})") from None
    parts = {"scheduler": schedule, "zeros_for_empty": bool(index.get("force_zeros_for_empty_prompt"))}
    for name, allowed in CLASSES.items():
        library, kind = index.get(name) or (None, None)
        if kind is None and name == "text_encoder_2":
            continue
        if kind not in allowed:
            raise PaletteError(
                f"'{folder}' is no model of SD 1.x, 2.x or SDXL: its {name} is {kind or 'missing'}, not {allowed[0]}"
            )
        variant = _variant(folder / name)
        # SDXL's VAE overflows in half precision, and patches are small: the VAE works in full
        its = torch.float32 if name == "vae" else dtype
        with _whole(folder / name):
            parts[name] = getattr(diffusers if library == "diffusers" else transformers, kind).from_pretrained(
                folder / name, torch_dtype=its, use_safetensors=True, variant=variant, local_files_only=True
            )
        if name in ("text_encoder", "text_encoder_2"):
            tokens = name.replace("text_encoder", "tokenizer")
            with _whole(folder / tokens):
                parts[tokens] = transformers.CLIPTokenizer.from_pretrained(folder / tokens, local_files_only=True)
    return parts


@contextlib.contextmanager
def _whole(folder: Path):
    try:
        yield
    except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
        reason = str(error).splitlines()[0][:200]
        raise PaletteError(f"'{folder}' can't be read ({reason}); copy or download the model again") from error


def _variant(folder: Path) -> str | None:
    """None for plain files, else the word in their names, such as fp16. Raises PaletteError where there are none."""
    names = [path.name for path in folder.glob("*.safetensors") if "non_ema" not in path.name]
    if not names:
        if any(path.suffix in PICKLES for path in folder.glob("*")):
            raise PaletteError(f"'{folder}' holds its weights as {NOT_PICKLED}")
        raise PaletteError(f"'{folder}' holds no .safetensors file; copy or download the model again")
    words = {name.split(".")[1].split("-")[0] for name in names if name.count(".") > 1}
    plain = any(name.count(".") == 1 for name in names)
    return None if plain else sorted(words)[0]


def identity(path: Path) -> str:
    """Hash that changes with the model: of its files' names, sizes and first MB each."""
    digest = hashlib.sha256()
    files = (file for pattern in ("*.safetensors", "*.json") for file in sorted(path.glob(f"*/{pattern}")))
    for file in [path] if path.is_file() else files:
        digest.update(f"{file.name} {file.stat().st_size} ".encode())
        with file.open("rb") as content:
            digest.update(content.read(1 << 20))
    return digest.hexdigest()[:16]


def _device(name: str) -> torch.device:
    if not name:
        name = "cuda" if torch.cuda.is_available() else "mps" if torch.backends.mps.is_available() else "cpu"
    found = {"cuda": torch.cuda.is_available, "mps": torch.backends.mps.is_available, "cpu": lambda: True}
    if name.split(":")[0] not in found or not found[name.split(":")[0]]():
        here = ", ".join(kind for kind, there in found.items() if there())
        raise PaletteError(f"torch finds no device '{name}' here; choose one of: {here}")
    return torch.device(name)


def _dtype(device: torch.device) -> torch.dtype:
    """bf16 has the range of fp32, so its gradients need no scaling; older CUDA devices only have fp16."""
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.get_device_capability(device)[0] >= 8 else torch.float16
    return torch.float16 if device.type == "mps" else torch.float32


@torch.no_grad()
def _tried_prediction(model: Model) -> str:
    """What an SD 2.x file predicts is not written in it: at the last time step the latents are nearly all noise, which
    is what an epsilon model answers; a v model answers the negative of a picture, which no noise resembles."""
    side = model.window
    noise = torch.randn(1, 4, side, side, generator=torch.Generator().manual_seed(0)).to(model.device)
    with model.at_work("unet", *model.encoders):
        answer = model.predict(noise, torch.tensor(999, device=model.device), model.encode([""]))
    likeness = torch.corrcoef(torch.stack([noise.flatten(), answer.flatten()]))[0, 1]
    return "epsilon" if likeness > 0.5 else "v_prediction"


@contextlib.contextmanager
def _quiet():
    """The libraries draw bars and warn of image processors, which are not used; what fails is raised."""
    import diffusers
    import transformers

    os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")
    before = diffusers.logging.get_verbosity(), transformers.logging.get_verbosity()
    diffusers.logging.set_verbosity_error()
    transformers.logging.set_verbosity_error()
    diffusers.logging.disable_progress_bar()
    transformers.logging.disable_progress_bar()
    try:
        yield
    finally:
        diffusers.logging.set_verbosity(before[0])
        transformers.logging.set_verbosity(before[1])
