"""Single-file checkpoints of Stable Diffusion: what they hold is read from their names, nothing is fetched.

diffusers takes configurations and vocabulary from the hub; they are written down here, so that a file works offline.
"""

import gzip
import json
import tempfile
from pathlib import Path

import torch

from ...errors import PaletteError

CLIP_CONTEXT = 77  # tokens
VOCABULARY = 49408

_UNET = {
    "_class_name": "UNet2DConditionModel",
    "in_channels": 4,
    "out_channels": 4,
    "layers_per_block": 2,
    "block_out_channels": [320, 640, 1280, 1280],
    "down_block_types": ["CrossAttnDownBlock2D"] * 3 + ["DownBlock2D"],
    "up_block_types": ["UpBlock2D"] + ["CrossAttnUpBlock2D"] * 3,
    "attention_head_dim": 8,
}
_VAE = {
    "_class_name": "AutoencoderKL",
    "block_out_channels": [128, 256, 512, 512],
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
    "layers_per_block": 2,
    "latent_channels": 4,
    "sample_size": 512,
    "scaling_factor": 0.18215,
}
_TEXT = {
    "model_type": "clip_text_model",
    "vocab_size": VOCABULARY,
    "max_position_embeddings": CLIP_CONTEXT,
    "bos_token_id": 49406,
    "eos_token_id": 49407,
    "pad_token_id": 1,
}
_CLIP_L = _TEXT | {"hidden_size": 768, "intermediate_size": 3072, "num_hidden_layers": 12, "num_attention_heads": 12}
_CLIP_L = _CLIP_L | {"hidden_act": "quick_gelu", "projection_dim": 768}
_CLIP_H = _TEXT | {"hidden_size": 1024, "intermediate_size": 4096, "num_hidden_layers": 23, "num_attention_heads": 16}
_CLIP_H = _CLIP_H | {"hidden_act": "gelu", "projection_dim": 512}
_CLIP_G = _TEXT | {"hidden_size": 1280, "intermediate_size": 5120, "num_hidden_layers": 32, "num_attention_heads": 20}
_CLIP_G = _CLIP_G | {"hidden_act": "gelu", "projection_dim": 1280}
_SCHEDULE = {
    "_class_name": "DDIMScheduler",
    "num_train_timesteps": 1000,
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "steps_offset": 1,
    "clip_sample": False,
    "set_alpha_to_one": False,
}

# per family: the parts' configurations, and the padding token of each text encoder's tokenizer
FAMILIES = {
    "sd1": {
        "unet": _UNET | {"sample_size": 64, "cross_attention_dim": 768},
        "vae": _VAE,
        "text_encoder": _CLIP_L,
        "scheduler": _SCHEDULE,
        "padding": ["<|endoftext|>"],
    },
    "sd2": {
        "unet": _UNET
        | {
            "sample_size": 64,
            "cross_attention_dim": 1024,
            "attention_head_dim": [5, 10, 20, 20],
            "use_linear_projection": True,
            "upcast_attention": True,
        },
        "vae": _VAE | {"sample_size": 768},
        "text_encoder": _CLIP_H,
        "scheduler": _SCHEDULE,
        "padding": ["!"],
    },
    "sdxl": {
        "unet": _UNET
        | {
            "sample_size": 128,
            "cross_attention_dim": 2048,
            "block_out_channels": [320, 640, 1280],
            "down_block_types": ["DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"],
            "up_block_types": ["CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"],
            "transformer_layers_per_block": [1, 2, 10],
            "attention_head_dim": [5, 10, 20],
            "use_linear_projection": True,
            "addition_embed_type": "text_time",
            "addition_time_embed_dim": 256,
            "projection_class_embeddings_input_dim": 2816,
        },
        "vae": _VAE | {"sample_size": 1024, "scaling_factor": 0.13025},
        "text_encoder": _CLIP_L,
        "text_encoder_2": _CLIP_G,
        "scheduler": _SCHEDULE,
        "padding": ["<|endoftext|>", "!"],
    },
}


def header(path: Path) -> tuple[dict[str, tuple[int, ...]], dict[str, str]]:
    """Shape of every tensor in a safetensors file, and its metadata; the data is not read."""
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            if not 2 <= length <= path.stat().st_size - 8:
                raise ValueError("its header is longer than the file")
            content = json.loads(file.read(length))
        metadata = content.pop("__metadata__", {})
        end = max((entry["data_offsets"][1] for entry in content.values()), default=0)
        if 8 + length + end > path.stat().st_size:
            raise ValueError("it is cut off")
        return {name: tuple(entry["shape"]) for name, entry in content.items()}, metadata
    except OSError as error:
        raise PaletteError(f"cannot read the model '{path}': {error.strerror or error}") from error
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise PaletteError(f"'{path}' is not a whole safetensors file ({error}); copy or download it again") from error


def family_of(path: Path) -> tuple[str, str]:
    """(family, prediction) of a checkpoint: a key of FAMILIES; "epsilon", "v_prediction" or "" where it must be tried.

    Raises PaletteError for a file that is no whole Stable Diffusion model, and for inpainting models and refiners.
    """
    shapes, metadata = header(path)
    first = shapes.get("model.diffusion_model.input_blocks.0.0.weight")
    if first is None:
        raise PaletteError(
            f"'{path}' holds no Stable Diffusion model (no UNet in it; a LoRA, a VAE or another kind of model?); "
            "choose a whole checkpoint of SD 1.x, 2.x or SDXL"
        )
    if first[1] != 4:
        raise PaletteError(f"'{path}' is an inpainting or editing model; choose the base model of its family")
    if any(name.startswith("conditioner.embedders.1.") for name in shapes):
        family = "sdxl"
    elif any(name.startswith("cond_stage_model.model.") for name in shapes):
        family = "sd2"
    elif any(name.startswith("cond_stage_model.transformer.") for name in shapes):
        family = "sd1"
    else:
        raise PaletteError(
            f"'{path}' lacks the text encoder of SD 1.x, 2.x or SDXL; choose a whole checkpoint (a refiner is none)"
        )
    if not any(name.startswith("first_stage_model.decoder.") for name in shapes):
        raise PaletteError(f"'{path}' lacks the VAE; choose a whole checkpoint")
    said = metadata.get("modelspec.prediction_type") or metadata.get("modelspec.predict_key") or ""
    prediction = {"v": "v_prediction", "v_prediction": "v_prediction", "epsilon": "epsilon"}.get(said, "")
    if "v_pred" in shapes:  # how SDXL models that predict v are marked
        prediction = "v_prediction"
    return family, prediction or ("" if family == "sd2" else "epsilon")


def load(path: Path, dtype) -> dict:
    """The parts of a checkpoint by their names in diffusers' format, scheduler as a configuration; weights in dtype."""
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from diffusers.loaders.single_file_utils import create_diffusers_clip_model_from_ldm
    from safetensors.torch import load_file
    from transformers import CLIPTextModel, CLIPTextModelWithProjection

    family, prediction = family_of(path)
    configurations = FAMILIES[family]
    weights = load_file(path)
    parts = {"scheduler": configurations["scheduler"] | {"prediction_type": prediction}}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("unet", "vae", "text_encoder", "text_encoder_2"):
            if name in configurations:
                (Path(folder) / name).mkdir()
                (Path(folder) / name / "config.json").write_text(json.dumps(configurations[name]))
        options = {"config": folder, "local_files_only": True}
        for name, kind in (("unet", UNet2DConditionModel), ("vae", AutoencoderKL)):
            # the conversion empties the dictionary that it is given
            its = dtype if name == "unet" else torch.float32
            parts[name] = kind.from_single_file(dict(weights), subfolder=name, torch_dtype=its, **options)
        for number, padding in enumerate(configurations["padding"]):
            name = "text_encoder" if number == 0 else "text_encoder_2"
            kind = CLIPTextModelWithProjection if name == "text_encoder_2" else CLIPTextModel
            parts[name] = create_diffusers_clip_model_from_ldm(
                kind, weights, subfolder=name, torch_dtype=dtype, **options
            )
            parts[name.replace("text_encoder", "tokenizer")] = tokenizer(padding)
    return parts


def tokenizer(padding: str):
    """CLIP's tokenizer, from the merges beside this file."""
    from transformers import CLIPTokenizer

    text = gzip.decompress((Path(__file__).parent / "clip" / "merges.txt.gz").read_bytes()).decode("utf-8")
    merges = [tuple(line.split()) for line in text.split("\n")]
    # bytes that print stand for themselves, the others for characters from 256 on (GPT-2)
    printing = [*range(33, 127), *range(161, 173), *range(174, 256)]
    signs = [chr(byte) for byte in printing] + [chr(256 + n) for n in range(256 - len(printing))]
    words = signs + [sign + "</w>" for sign in signs] + ["".join(pair) for pair in merges]
    words += ["<|startoftext|>", "<|endoftext|>"]
    vocabulary = {word: number for number, word in enumerate(words)}
    return CLIPTokenizer(vocab=vocabulary, merges=merges, pad_token=padding, model_max_length=CLIP_CONTEXT)
