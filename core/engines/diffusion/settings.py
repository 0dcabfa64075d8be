"""What the user chooses of the engine `diffusion`; the defaults are the paper's."""

from dataclasses import dataclass
from pathlib import Path

from ...errors import PaletteError

PRECISIONS = ("fp32", "fp16", "bf16")
ROLLS = ("noise", "feature", "none")
PREDICTIONS = ("epsilon", "v_prediction")


@dataclass(frozen=True)
class DiffusionSettings:
    """model: a folder in diffusers' format, a single .safetensors checkpoint, or a hub id, which is fetched only if
    `online`. concepts: folder where learnt concepts are kept; none are kept without one. An empty device, precision,
    scheduler or prediction means the one that fits the machine or belongs to the model.

    Learning: at most tuning_steps, fewer if early_stop finds the loss settled; on crops of crop_size px (None: 256, for
    SDXL 512), with `token` for the region in every prompt. Sampling: steps and candidates (None: by quality) of
    `prompt` (one of the paper's where empty; S* stands for the token), with classifier-free guidance. roll: what is
    rolled on the torus against seams, from the fraction roll_from of the steps on. batch: windows denoised at once.
    offload: only the part at work stays on the device (None: where memory is short).
    """

    model: str = ""
    online: bool = False
    concepts: str = ""
    device: str = ""
    precision: str = ""
    offload: bool | None = None
    tuning_steps: int = 800
    early_stop: bool = True
    crop_size: int | None = None
    token: str = "ohwx"
    prompt: str = ""
    steps: int | None = None
    guidance: float = 7.5
    scheduler: str = ""
    prediction: str = ""
    roll: str = "noise"
    roll_from: float = 0.0
    candidates: int | None = None
    batch: int = 1

    def check(self) -> None:
        """Raise PaletteError naming the first setting that cannot be honoured. Looks at no file."""
        if not self.model:
            raise PaletteError(
                "the engine 'diffusion' needs a model: name a folder in diffusers' format, a .safetensors checkpoint "
                "or a hub id (docs/diffusion.md says which)"
            )
        choices = (
            ("precision", self.precision, ("", *PRECISIONS)),
            ("roll", self.roll, ROLLS),
            ("prediction", self.prediction, ("", *PREDICTIONS)),
        )
        for name, value, known in choices:
            if value not in known:
                raise PaletteError(f"{name} '{value}' is unknown; choose one of: {', '.join(filter(None, known))}")
        for name, least in (("tuning_steps", 1), ("steps", 1), ("candidates", 1), ("batch", 1), ("crop_size", 8)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise PaletteError(f"{name} is {value}; choose a whole number from {least}")
        if not 0 <= self.roll_from <= 1:
            raise PaletteError(f"roll_from is {self.roll_from}; choose a fraction of the steps, 0 to 1")
        if self.guidance < 0:
            raise PaletteError(f"guidance is {self.guidance}; choose 0 or more")
        if not self.token.strip():
            raise PaletteError("the token is empty; choose a rare word, such as ohwx")
        if self.prompt and "S*" not in self.prompt:
            raise PaletteError(f"the prompt '{self.prompt}' does not name the region; put S* where it belongs")
        if self.concepts and Path(self.concepts).is_file():
            raise PaletteError(f"the folder of concepts '{self.concepts}' is a file; name a folder")
