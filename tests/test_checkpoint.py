"""Single-file checkpoints: the tiny model under the names that such files use, and what is refused."""

import re

import pytest
import torch
from textures import quiet

for package in ("diffusers", "transformers", "peft", "accelerate"):
    pytest.importorskip(package, reason="requirements-diffusion.txt is not installed")
import tiny_diffusion as tiny  # noqa: E402
from material_palette.core.engines.diffusion import DiffusionSettings, Engine, checkpoint  # noqa: E402
from material_palette.core.errors import PaletteError  # noqa: E402
from safetensors.torch import save_file  # noqa: E402

# a UNet of two levels with one layer each, the first with attention
UNET = {
    "conv_in": "input_blocks.0.0",
    "down_blocks.0.resnets.0": "input_blocks.1.0",
    "down_blocks.0.attentions.0": "input_blocks.1.1",
    "down_blocks.0.downsamplers.0.conv": "input_blocks.2.0.op",
    "down_blocks.1.resnets.0": "input_blocks.3.0",
    "mid_block.resnets.0": "middle_block.0",
    "mid_block.attentions.0": "middle_block.1",
    "mid_block.resnets.1": "middle_block.2",
    "up_blocks.0.resnets.0": "output_blocks.0.0",
    "up_blocks.0.resnets.1": "output_blocks.1.0",
    "up_blocks.0.upsamplers.0.conv": "output_blocks.1.1.conv",
    "up_blocks.1.resnets.0": "output_blocks.2.0",
    "up_blocks.1.attentions.0": "output_blocks.2.1",
    "up_blocks.1.resnets.1": "output_blocks.3.0",
    "up_blocks.1.attentions.1": "output_blocks.3.1",
    "time_embedding.linear_1": "time_embed.0",
    "time_embedding.linear_2": "time_embed.2",
    "conv_norm_out": "out.0",
    "conv_out": "out.2",
}
RESNET = {
    "norm1": "in_layers.0",
    "conv1": "in_layers.2",
    "time_emb_proj": "emb_layers.1",
    "norm2": "out_layers.0",
    "conv2": "out_layers.3",
    "conv_shortcut": "skip_connection",
}
VAE = (
    (r"down_blocks\.(\d)\.resnets\.(\d)", r"down.\1.block.\2"),
    (r"down_blocks\.(\d)\.downsamplers\.0", r"down.\1.downsample"),
    (r"up_blocks\.(\d)\.resnets\.(\d)", lambda m: f"up.{2 - int(m[1])}.block.{m[2]}"),
    (r"up_blocks\.(\d)\.upsamplers\.0", lambda m: f"up.{2 - int(m[1])}.upsample"),
    (r"mid_block\.resnets\.0", "mid.block_1"),
    (r"mid_block\.resnets\.1", "mid.block_2"),
    (r"mid_block\.attentions\.0\.group_norm", "mid.attn_1.norm"),
    (r"mid_block\.attentions\.0\.to_out\.0", "mid.attn_1.proj_out"),
    (r"mid_block\.attentions\.0\.to_(.)", r"mid.attn_1.\1"),
    ("conv_norm_out", "norm_out"),
    ("conv_shortcut", "nin_shortcut"),
)


def single_file(model, path):
    """The parts of a tiny SD 1.x under the names of single-file checkpoints."""
    tensors = {}
    for name, value in model.unet.state_dict().items():
        name = name.replace(".base_layer.", ".")
        if ".lora_" in name:
            continue
        start = max((start for start in UNET if name.startswith(start + ".")), key=len)
        rest = name[len(start) :]
        if "resnets" in start:
            rest = re.sub(r"^\.(\w+)", lambda m: "." + RESNET[m[1]], rest)
        tensors["model.diffusion_model." + UNET[start] + rest] = value
    for name, value in model.vae.state_dict().items():
        for pattern, replacement in VAE:
            name = re.sub(pattern, replacement, name)
        if ".attn_1." in name and name.endswith("weight") and "norm" not in name:
            value = value[:, :, None, None]
        tensors["first_stage_model." + name] = value
    for name, value in model.parts["text_encoder"].state_dict().items():
        if ".lora_" not in name:
            name = name.replace(".base_layer.", ".").removeprefix("text_model.")
            tensors["cond_stage_model.transformer.text_model." + name] = value
    save_file({name: value.contiguous().clone() for name, value in tensors.items()}, path)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tiny.write_model(tmp_path_factory.mktemp("model") / "tiny")


@pytest.fixture
def tiny_family(monkeypatch, folder):
    """The configurations of SD 1.x as those of the tiny model; the tokenizer's vocabulary too."""
    parts = {"unet": tiny.unet(), "vae": tiny.vae(), "text_encoder": tiny.text_encoder()}
    configurations = {
        name: dict(part.config.to_dict() if "text" in name else part.config) for name, part in parts.items()
    }
    family = checkpoint.FAMILIES["sd1"] | configurations
    monkeypatch.setitem(checkpoint.FAMILIES, "sd1", family)
    monkeypatch.setattr(checkpoint, "tokenizer", lambda padding: tiny.tokenizer())


def test_a_single_file_is_the_same_model_as_its_folder(folder, tmp_path, tiny_family):
    whole = Engine(DiffusionSettings(model=str(folder))).model(quiet)
    path = single_file(whole, tmp_path / "tiny.safetensors")
    assert checkpoint.family_of(path) == ("sd1", "epsilon")
    single = Engine(DiffusionSettings(model=str(path))).model(quiet)
    x, t = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(0)), torch.tensor(300)
    for name in ("unet", "vae", "text_encoder"):
        # a concept's own weights begin at random, and add nothing before it is learnt
        ours, theirs = (
            {key: value for key, value in model.parts[name].state_dict().items() if ".lora_" not in key}
            for model in (single, whole)
        )
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours), name

    def same(first, second):
        # some processors round otherwise where tensors lie otherwise in memory
        return torch.allclose(first, second, rtol=1e-4, atol=1e-5)

    with torch.no_grad():
        text = whole.encode(["some stone"])
        assert same(single.encode(["some stone"])[0], text[0])
        assert same(single.predict(x, t, text), whole.predict(x, t, text))
        assert same(single.vae.decode(x).sample, whole.vae.decode(x).sample)
        picture = torch.rand(1, 3, 32, 32)
        assert same(single.vae.encode(picture).latent_dist.mean, whole.vae.encode(picture).latent_dist.mean)


def names(*more):
    shapes = {
        "model.diffusion_model.input_blocks.0.0.weight": (8, 4, 3, 3),
        "first_stage_model.decoder.conv_in.bias": (1,),
    }
    return shapes | dict.fromkeys(more, (1,))


def write_names(path, shapes, metadata=None):
    save_file({name: torch.zeros(shape) for name, shape in shapes.items()}, path, metadata)
    return path


@pytest.mark.parametrize(
    "shapes, metadata, found",
    [
        (names("cond_stage_model.transformer.x"), None, ("sd1", "epsilon")),
        (names("cond_stage_model.model.x"), None, ("sd2", "")),
        (names("cond_stage_model.model.x"), {"modelspec.prediction_type": "v"}, ("sd2", "v_prediction")),
        (names("conditioner.embedders.1.model.x"), None, ("sdxl", "epsilon")),
        (names("conditioner.embedders.1.model.x", "v_pred"), None, ("sdxl", "v_prediction")),
    ],
)
def test_family_is_read_from_the_names(tmp_path, shapes, metadata, found):
    assert checkpoint.family_of(write_names(tmp_path / "m.safetensors", shapes, metadata)) == found


@pytest.mark.parametrize(
    "shapes, words",
    [
        ({"lora_unet_x.alpha": (1,)}, "no Stable Diffusion model.*LoRA"),
        (names() | {"model.diffusion_model.input_blocks.0.0.weight": (8, 9, 3, 3)}, "inpainting"),
        (names("conditioner.embedders.0.model.x"), "text encoder.*refiner"),
        ({"model.diffusion_model.input_blocks.0.0.weight": (8, 4, 3, 3), "cond_stage_model.model.x": (1,)}, "VAE"),
    ],
)
def test_files_that_are_no_base_model_are_refused(tmp_path, shapes, words):
    with pytest.raises(PaletteError, match=words):
        Engine(DiffusionSettings(model=str(write_names(tmp_path / "m.safetensors", shapes)))).model(quiet)


def test_damaged_file_is_named(tmp_path):
    path = write_names(tmp_path / "m.safetensors", names("cond_stage_model.model.x"))
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(PaletteError, match="m.safetensors.*cut off"):
        checkpoint.family_of(path)


@pytest.mark.parametrize(
    "family, part, count",
    [  # parameters as published
        ("sd1", "unet", 859_520_964),
        ("sd1", "vae", 83_653_863),
        ("sd1", "text_encoder", 123_060_480),
        ("sd2", "unet", 865_910_724),
        ("sd2", "text_encoder", 340_387_840),
        ("sdxl", "unet", 2_567_463_684),
        ("sdxl", "text_encoder_2", 694_659_840),
    ],
)
def test_configurations_are_those_of_the_published_models(family, part, count):
    import diffusers
    import transformers

    configuration = checkpoint.FAMILIES[family][part]
    with torch.device("meta"):
        if part == "unet":
            module = diffusers.UNet2DConditionModel.from_config(configuration)
        elif part == "vae":
            module = diffusers.AutoencoderKL.from_config(configuration)
        else:
            kind = transformers.CLIPTextModelWithProjection if part.endswith("2") else transformers.CLIPTextModel
            module = kind(transformers.CLIPTextConfig(**configuration))
    assert sum(parameter.numel() for parameter in module.parameters()) == count


def test_tokens_are_those_of_clip():
    tokenizer = checkpoint.tokenizer("!")
    ids = tokenizer(["a photo of a cat", "ohwx"], padding="max_length", max_length=8).input_ids
    assert ids[0] == [49406, 320, 1125, 539, 320, 2368, 49407, 0]
    assert ids[1][2] == 49407  # the rare word is one token
    assert len(tokenizer) == 49408


@pytest.mark.parametrize("prediction, sign", [("epsilon", 1.0), ("v_prediction", -0.2)])
def test_what_a_model_predicts_is_tried_where_nothing_says_it(folder, tmp_path, monkeypatch, prediction, sign):
    from material_palette.core.engines.diffusion import model

    monkeypatch.setattr(model.Model, "predict", lambda self, x, t, text: sign * x + 0.5 * torch.randn(x.shape))
    path = folder / "scheduler" / "scheduler_config.json"
    before = path.read_text()
    try:
        path.write_text(before.replace('"prediction_type": "epsilon"', '"prediction_type": ""'))
        assert Engine(DiffusionSettings(model=str(folder))).model(quiet).schedule["prediction_type"] == prediction
    finally:
        path.write_text(before)
