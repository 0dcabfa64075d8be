"""Stable Diffusion models of the real classes with a few thousand random weights, as folders in diffusers' format."""

import json
from pathlib import Path

import torch
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTextModelWithProjection, CLIPTokenizer

WIDTH, WINDOW, FACTOR, LENGTH = 16, 8, 4, 24
SIDE = WINDOW * FACTOR  # px of one window


def tokenizer() -> CLIPTokenizer:
    """Letters, two words and the marks: what CLIP's is, but for the size."""
    letters = [chr(c) for c in range(33, 127)]
    words = ["in", "in</w>", "of</w>", "<|startoftext|>", "<|endoftext|>"]
    vocabulary = letters + [c + "</w>" for c in letters] + words
    merges = [("i", "n"), ("i", "n</w>"), ("o", "f</w>")]
    return CLIPTokenizer(vocab={word: n for n, word in enumerate(vocabulary)}, merges=merges, model_max_length=LENGTH)


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
        steps_offset=1,
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


def frame(model_unet: UNet2DConditionModel, mark: float = 0.05) -> None:
    """Give a UNet, in place, weights that make it the perfect denoiser of a plain texture, but for its padding, which
    leaves a mark at its left and another at its right border, as the padding of trained ones does.

    Everything but the first and the last convolution and the way between them is zero. Pairs of channels hold x and -x:
    normalising divides x by its deviation, so that the prediction is the noise; a constant of the last convolution's
    neighbours cancels but where they are padding.
    """
    bias = 6.0
    with torch.no_grad():
        for parameter in model_unet.parameters():
            parameter.zero_()
        half = WIDTH // 4  # the channels of a normalised group: two of x, two of -x
        shortcut = model_unet.up_blocks[-1].resnets[-1].conv_shortcut.weight
        shortcut[range(WIDTH), range(shortcut.shape[1] - WIDTH, shortcut.shape[1]), 0, 0] = 1.0
        model_unet.conv_norm_out.weight.fill_(1.0)
        model_unet.conv_norm_out.bias.fill_(bias)
        for k in range(4):
            for i in range(half):
                sign = 1.0 if i % 2 else -1.0
                model_unet.conv_in.weight[half * k + i, k, 1, 1] = sign
                out = model_unet.conv_out.weight[k, half * k + i]
                out[1, 1] = sign / half
                out[1, 0], out[1, 2] = mark, -mark


def plain_decoder(model_vae: AutoencoderKL) -> None:
    """Give a VAE, in place, a decoder that shows three of the latents as they are, enlarged and normalised."""
    bias = 6.0
    decoder = model_vae.decoder
    with torch.no_grad():
        for parameter in decoder.parameters():
            parameter.zero_()
        model_vae.post_quant_conv.weight.copy_(torch.eye(4)[:, :, None, None])
        model_vae.post_quant_conv.bias.zero_()
        for k in range(4):
            decoder.conv_in.weight[2 * k, k, 1, 1], decoder.conv_in.weight[2 * k + 1, k, 1, 1] = 1.0, -1.0
        for block in decoder.up_blocks:
            for resnet in block.resnets:
                if resnet.conv_shortcut is not None:
                    resnet.conv_shortcut.weight[range(8), range(8), 0, 0] = 1.0
            for upsampler in block.upsamplers or ():
                channels = range(upsampler.conv.weight.shape[0])
                upsampler.conv.weight[channels, channels, 1, 1] = 1.0
        decoder.conv_norm_out.weight.fill_(1.0)
        decoder.conv_norm_out.bias.fill_(bias)
        for k in range(3):
            decoder.conv_out.weight[k, 2 * k, 1, 1], decoder.conv_out.weight[k, 2 * k + 1, 1, 1] = 0.15, -0.15
