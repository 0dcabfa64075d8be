"""Stable Diffusion models of the real classes with a few thousand random weights, as folders in diffusers' format."""

import json
from pathlib import Path

import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

WIDTH, WINDOW, FACTOR, LENGTH = 16, 16, 4, 24
SIDE = WINDOW * FACTOR  # px of one window


def tokenizer() -> CLIPTokenizer:
    """Letters, two words and the marks: what CLIP's is, but for the size."""
    letters = [chr(c) for c in range(33, 127)]
    vocabulary = letters + [c + "</w>" for c in letters] + ["in", "in</w>", "of</w>", "<|startoftext|>", "<|endoftext|>"]
    merges = [("i", "n"), ("i", "n</w>"), ("o", "f</w>")]
    return CLIPTokenizer(
        vocab={word: n for n, word in enumerate(vocabulary)}, merges=merges, model_max_length=LENGTH
    )


def text_encoder(kind=CLIPTextModel):
    marks = tokenizer()
    configuration = CLIPTextConfig(
        vocab_size=len(marks),
        hidden_size=WIDTH,
        intermediate_size=2 * WIDTH,
        num_hidden_layers=2,
        num_attention_heads=2,
        max_position_embeddings=LENGTH,
        projection_dim=WIDTH,
        bos_token_id=marks.bos_token_id,
        eos_token_id=marks.eos_token_id,
        pad_token_id=marks.pad_token_id,
    )
    return kind(configuration)


def unet(xl: bool = False, **more) -> UNet2DConditionModel:
    configuration = {
        "sample_size": WINDOW,
        "block_out_channels": (WIDTH, 2 * WIDTH),
        "down_block_types": ("CrossAttnDownBlock2D", "DownBlock2D"),
        "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D"),
        "layers_per_block": 1,
        "cross_attention_dim": 2 * WIDTH if xl else WIDTH,
        "attention_head_dim": 8,
        "norm_num_groups": 8,
    }
    if xl:
        configuration |= {
            "addition_embed_type": "text_time",
            "addition_time_embed_dim": 8,
            "projection_class_embeddings_input_dim": 6 * 8 + WIDTH,
            "use_linear_projection": True,
        }
    return UNet2DConditionModel(**configuration | more)


def vae() -> AutoencoderKL:
    return AutoencoderKL(
        block_out_channels=(8, 8, 16),
        down_block_types=("DownEncoderBlock2D",) * 3,
        up_block_types=("UpDecoderBlock2D",) * 3,
        latent_channels=4,
        norm_num_groups=4,
        sample_size=SIDE,
    )


def write_model(folder: Path, prediction: str = "epsilon", xl: bool = False, seed: int = 0, **more) -> Path:
    """A model in diffusers' format. prediction: epsilon or v_prediction; more: of the UNet's configuration."""
    torch.manual_seed(seed)
    schedule = DDIMScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        clip_sample=False,
        set_alpha_to_one=False,
        prediction_type=prediction,
    )
    parts = {"unet": unet(xl, **more), "vae": vae(), "text_encoder": text_encoder(), "tokenizer": tokenizer()}
    if xl:
        parts |= {"text_encoder_2": text_encoder(CLIPTextModelWithProjection), "tokenizer_2": tokenizer()}
    index = {"_class_name": "StableDiffusionXLPipeline" if xl else "StableDiffusionPipeline"}
    for name, part in (parts | {"scheduler": schedule}).items():
        part.save_pretrained(folder / name)
        library = "diffusers" if name in ("unet", "vae", "scheduler") else "transformers"
        index[name] = [library, type(part).__name__]
    (folder / "model_index.json").write_text(json.dumps(index))
    return folder
