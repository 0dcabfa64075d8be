"""The engine `diffusion` on tiny random models of the real classes: what holds for any weights."""

import contextlib
import json
import math
import shutil

import numpy as np
import pytest
import torch
from textures import pebbles, quiet

for package in ("diffusers", "transformers", "peft", "accelerate"):
    pytest.importorskip(package, reason="requirements-diffusion.txt is not installed")
import tiny_diffusion as tiny  # noqa: E402
from material_palette.core import torus  # noqa: E402
from material_palette.core.engines import diffusion  # noqa: E402
from material_palette.core.engines.diffusion import (  # noqa: E402
    DiffusionSettings,
    Engine,
    decoding,
    memory,
    sampling,
    tuning,
)
from material_palette.core.errors import Cancelled, PaletteError  # noqa: E402

KINDS = {"epsilon": {}, "v": {"prediction": "v_prediction"}, "xl": {"xl": True}}
PHOTO = pebbles(96, 120)
FULL = np.ones(PHOTO.shape[:2], bool)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("models")
    return {name: tiny.write_model(root / name, **more) for name, more in KINDS.items()}


@pytest.fixture
def open_engine(folders):
    def open_engine(kind="epsilon", **more):
        return Engine(DiffusionSettings(model=str(folders[kind]), **{"crop_size": 16, "tuning_steps": 4, **more}))

    return open_engine


@pytest.fixture(scope="module")
def concept(folders):
    """Of the epsilon model, after a few steps at a rate that makes them matter."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuning, "LEARNING_RATE", 1e-2)
        return Engine(DiffusionSettings(model=str(folders["epsilon"]), crop_size=16, tuning_steps=10)).learn(
            PHOTO, FULL, quiet
        )


def sample_latents(model, k=1, steps=10, seed=0, shape=None, **more):
    settings = DiffusionSettings(model="-", guidance=1, batch=16, **more)
    text, nothing = model.encode(["a"]), model.nothing()
    generator = torch.Generator().manual_seed(seed)
    shape = shape or (k * model.window, k * model.window)
    return sampling.sample_latents(model, text, nothing, shape, steps, generator, settings, quiet)


# ---------------------------------------------------------------- crops


def test_crops_are_of_the_largest_size_that_fits_and_lie_in_the_region():
    pixels = np.full((400, 500, 3), 0.25, np.float32)
    mask = np.zeros((400, 500), bool)
    mask[10:390, 20:230] = True  # 192 px fit, 256 do not
    pixels[~mask] = 1.0
    crops, size, warnings = tuning.cut_crops(pixels, mask, 64)
    assert size == 192 and not warnings
    # every 38 px, in the region up to a hundredth
    assert len(crops) == sum(
        mask[y : y + 192, x : x + 192].mean() >= 0.99 for y in range(0, 209, 38) for x in range(0, 309, 38)
    )
    assert crops.shape[1:] == (64, 64, 3) and crops.mean() < 0.27 * 255


def test_no_more_crops_than_the_paper_takes():
    crops, size, _ = tuning.cut_crops(np.zeros((900, 900, 3), np.float32), np.ones((900, 900), bool), 32)
    assert size == 512 and len(crops) == 16  # corners at 0, 102, 204 and 306 px
    crops, size, _ = tuning.cut_crops(np.zeros((500, 500, 3), np.float32), np.ones((500, 500), bool), 32)
    assert size == 256 and len(crops) == 25
    crops, size, _ = tuning.cut_crops(np.zeros((190, 900, 3), np.float32), np.ones((190, 900), bool), 32)
    assert size == 128 and len(crops) == 93
    crops, size, _ = tuning.cut_crops(np.zeros((190, 1200, 3), np.float32), np.ones((190, 1200), bool), 32)
    assert len(crops) == tuning.MOST_CROPS


@pytest.mark.parametrize(
    "height, width, size, words",
    [(64, 64, 64, "only 1 crop"), (50, 200, 48, "crops of 48 px are used"), (20, 300, 20, "painted in")],
)
def test_small_and_thin_regions_are_used_and_reported(height, width, size, words):
    pixels, mask = np.zeros((320, 320, 3), np.float32), np.zeros((320, 320), bool)
    mask[5 : 5 + height, 7 : 7 + width] = True
    pixels[mask] = 0.5
    crops, found, warnings = tuning.cut_crops(pixels, mask, 32)
    assert len(crops) and words in " ".join(warnings)
    assert found == size or found > 32
    # nothing of the photo outside the region shows
    assert abs(crops.astype(float).mean() / 255 - 0.5) < 0.01


# ---------------------------------------------------------------- learning


SLOW_KINDS = ["epsilon", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("v", "xl"))]


@pytest.mark.parametrize("kind", SLOW_KINDS)
def test_learning_lowers_the_loss_and_changes_only_low_rank_weights(open_engine, monkeypatch, kind):
    monkeypatch.setattr(tuning, "LEARNING_RATE", 1e-2)
    monkeypatch.setattr(tuning, "CHECK_EVERY", 20)
    engine = open_engine(kind, tuning_steps=20, early_stop=False)
    model = engine.model(quiet)
    low_rank = {id(p) for p in tuning.lora_parameters(model).values()}

    def others():
        parts = [model.unet, model.vae, *(model.parts[name] for name in model.encoders)]
        tensors = [t for part in parts for t in [*part.parameters(), *part.buffers()] if id(t) not in low_rank]
        return [t.clone() for t in tensors]

    before = others()
    learnt = engine.learn(PHOTO, FULL, quiet)
    assert learnt.losses[-1] < 0.99 * learnt.losses[0]
    assert all(torch.equal(a, b) for a, b in zip(before, others(), strict=True))
    parts = {name.split(".")[0] for name, array in learnt.lora.items() if np.abs(array).max() > 0 and "lora_B" in name}
    assert parts == {"unet", *model.encoders}


def test_what_is_learnt_is_what_the_paper_says(open_engine):
    names = tuning.lora_parameters(open_engine("xl").model(quiet))
    layers = {(name.split(".")[0], name.split(".")[-3]) for name in names}
    texts = {(part, layer) for part in ("text_encoder", "text_encoder_2") for layer in ("q_proj", "v_proj")}
    assert layers == {("unet", "to_q"), ("unet", "to_v")} | texts
    assert all(16 in parameter.shape for parameter in names.values())


def test_saved_concept_gives_the_same_texture(open_engine, concept, tmp_path):
    diffusion.save_concept(concept, tmp_path / "stone")
    loaded = diffusion.load_concept(tmp_path / "stone")
    first = open_engine(steps=3).sample(concept, (32, 32), 1, quiet)
    again = open_engine(steps=3).sample(loaded, (32, 32), 1, quiet)
    assert np.array_equal(first.pixels, again.pixels)
    other = open_engine(steps=3).sample(concept, (32, 32), 2, quiet)
    assert not np.array_equal(first.pixels, other.pixels)
    # and the concept matters
    loaded.lora = {name: np.zeros_like(array) for name, array in loaded.lora.items()}
    assert not torch.equal(open_engine(steps=3).sample(loaded, (32, 32), 1, quiet).latents, first.latents)


def test_lora_file_is_read_by_diffusers_alone(open_engine, concept, folders, tmp_path):
    from diffusers import StableDiffusionPipeline

    diffusion.save_concept(concept, tmp_path / "stone")
    model = open_engine().model(quiet)
    tuning.set_lora(model, concept.lora)
    pipeline = StableDiffusionPipeline.from_pretrained(folders["epsilon"], safety_checker=None, feature_extractor=None)
    x, t = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(0)), torch.tensor(500)

    def theirs():
        ids = pipeline.tokenizer(
            ["a"], padding="max_length", max_length=tiny.LENGTH, truncation=True, return_tensors="pt"
        ).input_ids
        return pipeline.unet(x, t, encoder_hidden_states=pipeline.text_encoder(ids)[0]).sample

    with torch.no_grad():
        ours, without = model.predict(x, t, model.encode(["a"])), theirs()
        pipeline.load_lora_weights(tmp_path / "stone" / "lora.safetensors")
        assert torch.allclose(ours, theirs(), atol=1e-5)
        assert not torch.allclose(ours, without, atol=1e-4)


def test_learning_that_was_interrupted_goes_on_as_if_it_had_not_been(open_engine, tmp_path):
    whole = open_engine(tuning_steps=6, concepts=str(tmp_path / "a")).learn(PHOTO, FULL, quiet)
    seen = []

    def stop_at_step_4(fraction, message):
        seen.append(message)
        if "step 4" in message:
            raise Cancelled

    engine = open_engine(tuning_steps=6, concepts=str(tmp_path / "b"))
    with pytest.raises(Cancelled):
        engine.learn(PHOTO, FULL, stop_at_step_4)
    assert [path.suffixes[-2:] for path in (tmp_path / "b").iterdir()] == [[".state", ".safetensors"]]
    seen.clear()
    resumed = open_engine(tuning_steps=6, concepts=str(tmp_path / "b")).learn(
        PHOTO, FULL, lambda fraction, message: seen.append(message)
    )
    assert not any("step 3 " in message for message in seen) and any("step 5 " in message for message in seen)
    assert all(np.array_equal(whole.lora[name], array) for name, array in resumed.lora.items())
    assert [path.suffix for path in (tmp_path / "b").iterdir()] == [""]


def test_a_region_is_learnt_once(open_engine, tmp_path, monkeypatch):
    first = open_engine(concepts=str(tmp_path)).learn(PHOTO, FULL, quiet)
    monkeypatch.setattr(tuning, "tune", lambda *a: pytest.fail("learnt again"))
    engine = open_engine(concepts=str(tmp_path))
    again = engine.learn(PHOTO, FULL, quiet)
    assert all(np.array_equal(first.lora[name], again.lora[name]) for name in first.lora)
    assert np.array_equal(first.crops, again.crops) and first.losses == again.losses
    mask = FULL.copy()
    mask[0, 0] = False
    with pytest.raises(pytest.fail.Exception):
        engine.learn(PHOTO, mask, quiet)


def test_damaged_concept_is_named(open_engine, tmp_path):
    open_engine(concepts=str(tmp_path)).learn(PHOTO, FULL, quiet)
    (folder,) = tmp_path.iterdir()
    (folder / "lora.safetensors").write_bytes(b"no")
    with pytest.raises(PaletteError, match="lora.safetensors"):
        open_engine(concepts=str(tmp_path)).learn(PHOTO, FULL, quiet)


def test_learning_stops_when_the_loss_has_settled(open_engine, monkeypatch):
    assert not tuning._has_settled([1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4])
    assert tuning._has_settled([1.0, 0.5, 0.5, 0.51, 0.499, 0.5])
    assert not tuning._has_settled([1.0, 0.5, 0.5])
    monkeypatch.setattr(tuning, "CHECK_EVERY", 1)
    monkeypatch.setattr(tuning, "CHECKS", 1)
    monkeypatch.setattr(tuning, "LEARNING_RATE", 0.0)
    assert len(open_engine(tuning_steps=20).learn(PHOTO, FULL, quiet).losses) == tuning.PATIENCE + 1
    assert len(open_engine(tuning_steps=7, early_stop=False).learn(PHOTO, FULL, quiet).losses) == 8


# ---------------------------------------------------------------- sampling


def test_rolling_and_cutting_into_windows_lose_nothing(open_engine, monkeypatch):
    """A prediction that looks at one place only is the same wherever windows and shifts put it."""
    model = open_engine().model(quiet)
    monkeypatch.setattr(type(model), "predict", lambda self, x, t, text, guidance=None: torch.tanh(x))
    for shape in ((8, 8), (16, 16), (32, 32), (8, 24), (13, 18)):
        plain = sample_latents(model, shape=shape, roll="none")
        assert torch.equal(sample_latents(model, shape=shape, roll="noise"), plain)
        assert plain.shape[2:] == shape


def window_seams(latents, window):
    """Mean step across the columns where windows meet over the mean of the others."""
    x = latents[0].numpy()
    steps = np.abs(x - np.roll(x, 1, 2)).mean((0, 1))
    return steps[::window].mean() / np.delete(steps, range(0, len(steps), window)).mean()


@pytest.mark.parametrize("k", [1, 2, pytest.param(4, marks=pytest.mark.slow)])
def test_rolling_takes_the_seams_that_are_there_without(open_engine, k):
    model = open_engine().model(quiet)
    tiny.frame(model.unet)
    tiny.plain_decoder(model.vae)
    seeds = range({1: 3, 2: 2, 4: 1}[k])
    found = {}
    for roll in ("none", "noise", "feature"):
        latents = [sample_latents(model, k, 15, seed, roll=roll) for seed in seeds]
        seams = np.median([window_seams(z, model.window) for z in latents])
        images = [decoding.decode(model, z, quiet, 8, 1) for z in latents]
        found[roll] = seams, np.median([torus.wrap_ratio(z[0].permute(1, 2, 0).numpy()) for z in latents])
        found[roll] += (np.median([torus.wrap_ratio(image) for image in images]),)
    assert found["none"][0] > 3
    for roll in ("noise", "feature"):
        assert found[roll][0] < 1.8
        assert max(found[roll][1:]) <= torus.WRAP_GATE
    if k == 1:  # with more windows the seams within hide the one at the border from the gate
        assert min(found["none"][1:]) > torus.WRAP_GATE


def test_rolling_can_start_late(open_engine):
    model = open_engine().model(quiet)
    tiny.frame(model.unet)
    never, all_over = sample_latents(model, 2, roll="none"), sample_latents(model, 2, roll="noise")
    late = sample_latents(model, 2, roll="noise", roll_from=0.5)
    assert torch.equal(sample_latents(model, 2, roll="noise", roll_from=1.0), never)
    assert not torch.equal(late, never) and not torch.equal(late, all_over)


def test_feature_rolling_leaves_the_unet_as_it_was(open_engine):
    model = open_engine().model(quiet)
    before = sample_latents(model, roll="none")
    assert not torch.equal(sample_latents(model, roll="feature"), before)
    assert torch.equal(sample_latents(model, roll="none"), before)


@pytest.mark.parametrize("prediction", ["epsilon", "v_prediction"])
@pytest.mark.parametrize("scheduler", ["", "EulerAncestralDiscreteScheduler", "DPMSolverMultistepScheduler"])
def test_both_predictions_lead_to_the_latents_that_the_model_means(open_engine, monkeypatch, prediction, scheduler):
    model = open_engine(prediction=prediction).model(quiet)
    levels = model.scheduler("DDPMScheduler").alphas_cumprod
    meant = torch.tensor([0.5, -1.0, 0.0, 2.0])[None, :, None, None]

    def perfect(self, x, t, text, guidance=None):
        a = np.interp(float(t), np.arange(len(levels)), levels)
        if "Euler" in scheduler:  # whose x is scaled by scale_model_input to unit variance, as the others' is
            assert x.std() < 3
        noise = (x - math.sqrt(a) * meant) / math.sqrt(1 - a)
        return noise if prediction == "epsilon" else math.sqrt(a) * noise - math.sqrt(1 - a) * meant

    monkeypatch.setattr(type(model), "predict", perfect)
    latents = sample_latents(model, steps=20, scheduler=scheduler)
    assert (latents - meant).abs().mean() < 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_without_rolling_one_window_is_what_diffusers_samples(open_engine, folders, kind):
    import diffusers

    model = open_engine(kind).model(quiet)
    settings = DiffusionSettings(model="-", roll="none", guidance=3.0)
    prompt = ["some stone"]
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(1, 4, 8, 8, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        ours = sampling.sample_latents(
            model, model.encode(prompt), model.nothing(), (8, 8), 5, generator, settings, quiet
        )
    if kind == "xl":
        pipeline = diffusers.StableDiffusionXLPipeline.from_pretrained(folders[kind], add_watermarker=False)
        pipeline.register_to_config(force_zeros_for_empty_prompt=False)
    else:
        pipeline = diffusers.StableDiffusionPipeline.from_pretrained(
            folders[kind], safety_checker=None, feature_extractor=None
        )
    pipeline.set_progress_bar_config(disable=True)
    theirs = pipeline(
        prompt, num_inference_steps=5, guidance_scale=3.0, latents=noise.clone(), output_type="latent"
    ).images
    assert torch.allclose(ours, theirs, atol=1e-4 * float(theirs.abs().max()))


def test_few_steps_of_a_distilled_model(folders, tmp_path):
    folder = tiny.write_model(tmp_path / "distilled", time_cond_proj_dim=16)
    engine = Engine(DiffusionSettings(model=str(folder), crop_size=16, scheduler="LCMScheduler", roll="feature"))
    model = engine.model(quiet)
    assert torch.isfinite(sample_latents(model, 2, 4, scheduler="LCMScheduler", roll="feature")).all()
    text, x, t = model.encode(["a"]), torch.randn(1, 4, 8, 8), torch.tensor(400)
    with torch.no_grad():
        assert not torch.equal(model.predict(x, t, text, 8.0), model.predict(x, t, text, 1.0))


def test_the_best_of_several_samples_is_kept(open_engine, concept, monkeypatch):
    distances = iter([0.5, 0.2, 0.4])
    seen = []

    def distance(texture, crops):
        seen.append(texture)
        return next(distances)

    monkeypatch.setattr(sampling, "distance", distance)
    best = open_engine(steps=2, candidates=3).sample(concept, (32, 32), 0, quiet)
    assert best.distance == 0.2 and np.array_equal(best.pixels, seen[1]) and len(seen) == 3


def test_distance_tells_a_texture_from_another():
    one, other = pebbles(96, 96, 1), pebbles(96, 96, 2)
    crops = np.rint(np.stack([one[:64, :64], one[32:, 32:]]) * 255).astype(np.uint8)
    noise = np.random.default_rng(0).random((96, 96, 3), np.float32)
    assert sampling.distance(other, crops) < 0.7 * sampling.distance(noise, crops)


def test_a_step_ends_when_the_user_cancels(open_engine, concept):
    calls = []

    def stop(fraction, message):
        calls.append(message)
        if "step 2 " in message:
            raise Cancelled

    with pytest.raises(Cancelled):
        open_engine(steps=5).sample(concept, (32, 32), 0, stop)
    assert not any("step 3 " in message for message in calls)
    # within a step the clock is looked at as well
    assert sum("step 1 " in message for message in calls) > 3


@pytest.mark.parametrize("size", [(32, 32), (50, 70), (12, 32)])
def test_any_size_is_made_and_tiles(open_engine, concept, size):
    texture = open_engine(steps=2).sample(concept, size, 0, quiet)
    assert texture.pixels.shape == (*size, 3) and texture.pixels.dtype == np.float32
    assert torus.wrap_ratio(texture.pixels) <= torus.WRAP_GATE
    assert texture.pixels.min() >= 0 and texture.pixels.max() <= 1


# ---------------------------------------------------------------- decoding and colour


def latents_that_change(side):
    """Noise whose mean and contrast change across the torus, as a texture's do: no patch is like another."""
    turn = torch.arange(side) * (2 * math.pi / side)
    noise = torch.randn(1, 4, side, side, generator=torch.Generator().manual_seed(0))
    return noise * (1 + 0.7 * turn.sin()[:, None]) + turn.cos()


@pytest.mark.parametrize("side, tolerance", [(16, 0.003), (32, 0.1)])
def test_decoding_in_patches_is_decoding_at_once(open_engine, side, tolerance):
    """In patches of 8 latents, with statistics of all of the torus or, when it is larger, of a quarter."""
    model = open_engine().model(quiet)
    z, largest = latents_that_change(side), []
    hook = model.vae.decoder.conv_in.register_forward_hook(lambda m, x, out: largest.append(out[0, 0].numel()))
    tiled = decoding.decode(model, z, quiet, 8)
    assert max(largest) == 24 * 24  # a patch and its margins, however large the texture is
    hook.remove()
    whole = decoding.decode(model, z, quiet, side)
    error = np.abs(tiled - whole).mean(-1) / whole.std()
    at_borders = np.minimum(np.arange(4 * side) % 32, 31 - np.arange(4 * side) % 32) < 4
    assert error.mean() < tolerance and error[at_borders].mean() < tolerance
    # the same at every place of the torus: the decoder is left as it was
    assert np.array_equal(decoding.decode(model, z, quiet, side), whole)


def test_the_sample_covers_small_textures_and_is_spread_over_large_ones():
    for length in (9, 13, 16):
        assert sorted(i for start, end in decoding._sample(length, 4) for i in range(start, end)) == list(range(length))
    assert decoding._sample(32, 4) == [(2, 6), (10, 14), (18, 22), (26, 30)]


def test_each_patch_for_itself_is_not_decoding_at_once(open_engine, monkeypatch):
    """What the statistics are for: without them patches get a tone of their own."""
    model = open_engine().model(quiet)
    monkeypatch.setattr(decoding, "_seeing_all", lambda *a: contextlib.nullcontext())
    z = latents_that_change(16)
    tiled, whole = decoding.decode(model, z, quiet, 8), decoding.decode(model, z, quiet, 16)
    assert np.abs(tiled - whole).mean() > 0.03 * whole.std()


@pytest.mark.parametrize("patch", [16, 8])
def test_decoded_textures_roll_with_their_latents(open_engine, monkeypatch, patch):
    model = open_engine().model(quiet)
    z = latents_that_change(16)
    picture = decoding.decode(model, z, quiet, patch)
    rolled = decoding.decode(model, z.roll((8, 8), (2, 3)), quiet, patch)
    assert np.allclose(rolled, np.roll(picture, (32, 32), (0, 1)), atol=1e-5)
    assert torus.wrap_ratio(picture) <= torus.WRAP_GATE


def test_a_patch_decoder_without_context_is_seamless(open_engine):
    """With nothing global in the decoder the blend of patches is the whole picture, border and all."""
    model = open_engine().model(quiet)
    tiny.plain_decoder(model.vae)
    model.vae.decoder.conv_norm_out = torch.nn.Identity()
    model.vae.decoder.conv_act = torch.nn.Identity()
    z = torch.randn(1, 4, 13, 24, generator=torch.Generator().manual_seed(0)) * 0.02
    tiled = decoding.decode(model, z, quiet, 8, 1)
    whole = (z[0, :3] / model.vae.config.scaling_factor * 0.3).repeat_interleave(4, 1).repeat_interleave(4, 2)
    assert np.allclose(tiled, (whole.permute(1, 2, 0).numpy() + 1) / 2, atol=1e-5)


def test_colour_is_that_of_the_region():
    random = np.random.default_rng(0)
    region = (random.normal([0.6, 0.4, 0.3], [0.05, 0.04, 0.03], (5000, 3))).astype(np.float32)
    region[:20] = 1.0  # glints
    texture = random.normal(0.5, 0.1, (64, 64, 3)).astype(np.float32)
    matched = sampling.match_colour(texture, *sampling.colour_of(region)).reshape(-1, 3)
    assert np.allclose(matched.mean(0), [0.6, 0.4, 0.3], atol=0.004)
    assert np.allclose(matched.std(0), [0.05, 0.04, 0.03], atol=0.004)


# ---------------------------------------------------------------- models


def test_text_is_encoded_as_diffusers_does(open_engine, folders):
    import diffusers

    pipeline = diffusers.StableDiffusionXLPipeline.from_pretrained(folders["xl"], add_watermarker=False)
    theirs = pipeline.encode_prompt("some stone", device="cpu", do_classifier_free_guidance=False)
    with torch.no_grad():
        states, pooled = open_engine("xl").model(quiet).encode(["some stone"])
    assert torch.allclose(states, theirs[0], atol=1e-6) and torch.allclose(pooled, theirs[2], atol=1e-6)


def test_pickles_are_refused_with_the_way_out(folders, tmp_path):
    (tmp_path / "model.ckpt").write_bytes(b"")
    with pytest.raises(PaletteError, match=r"pickle.*safetensors"):
        Engine(DiffusionSettings(model=str(tmp_path / "model.ckpt")))
    folder = shutil.copytree(folders["epsilon"], tmp_path / "old")
    weights = folder / "unet" / "diffusion_pytorch_model.safetensors"
    weights.rename(weights.with_suffix(".bin"))
    with pytest.raises(PaletteError, match=r"unet.*pickle.*safetensors"):
        Engine(DiffusionSettings(model=str(folder))).model(quiet)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda f: (f / "model_index.json").unlink(), "model_index.json is missing"),
        (lambda f: (f / "model_index.json").write_text("{"), "damaged"),
        (lambda f: (f / "model_index.json").write_text('{"unet": ["diffusers", "FluxTransformer"]}'), "SD 1.x"),
        (lambda f: next((f / "vae").glob("*.safetensors")).write_bytes(b"x"), "vae.*can't be read"),
        (lambda f: next((f / "text_encoder").glob("*.safetensors")).unlink(), "no .safetensors file"),
    ],
)
def test_a_folder_that_is_no_whole_model_is_named(folders, tmp_path, change, words):
    folder = shutil.copytree(folders["epsilon"], tmp_path / "copy")
    change(folder)
    with pytest.raises(PaletteError, match=words):
        Engine(DiffusionSettings(model=str(folder))).model(quiet)


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"model": ""}, "needs a model"),
        ({"model": "no/such/folder"}, "there is no model"),
        ({"model": "somebody/some-model"}, "allow it"),
        ({"model": ".", "precision": "fp8"}, "precision 'fp8'"),
        ({"model": ".", "roll": "sideways"}, "roll 'sideways'"),
        ({"model": ".", "prompt": "stone"}, "does not name the region"),
        ({"model": ".", "steps": 0}, "steps is 0"),
    ],
)
def test_settings_that_cannot_be_honoured(settings, words):
    with pytest.raises(PaletteError, match=words):
        Engine(DiffusionSettings(**settings))


def test_wrong_choices_that_need_the_model(open_engine, concept):
    with pytest.raises(PaletteError, match="no scheduler 'Nonesuch'"):
        open_engine(scheduler="Nonesuch").sample(concept, (32, 32), 0, quiet)
    with pytest.raises(PaletteError, match="no device 'cuda'|choose one of"):
        open_engine(device="tpu").model(quiet)
    with pytest.raises(PaletteError, match="another model"):
        open_engine("v").sample(concept, (32, 32), 0, quiet)


def test_packages_that_are_missing_are_named(folders, monkeypatch):
    from material_palette.core import dependencies

    monkeypatch.setattr(dependencies, "_found", lambda module: module != "peft")
    with pytest.raises(PaletteError, match="missing: peft.*pip install"):
        Engine(DiffusionSettings(model=str(folders["epsilon"])))


def test_memory_is_stated_and_too_little_of_it_refused(open_engine, concept, monkeypatch):
    engine, said = open_engine(steps=1), []
    engine.sample(concept, (32, 32), 0, lambda fraction, message: said.append(message))
    assert any("needs about" in message and "GB free on cpu" in message for message in said)
    monkeypatch.setattr(memory, "free", lambda model: 1e6)
    with pytest.raises(PaletteError, match=r"sampling needs about .* GB .*lower"):
        engine.sample(concept, (32, 32), 0, quiet)
    with pytest.raises(PaletteError, match="learning needs about"):
        engine.learn(PHOTO, FULL, quiet)


def test_offloading_is_chosen_where_memory_is_short(open_engine, monkeypatch):
    model = open_engine().model(quiet)
    whole, alone = memory.needed(model, DiffusionSettings(model="-"), 8)
    assert alone < whole
    model.device = torch.device("meta")  # any that is not the CPU
    monkeypatch.setattr(memory, "free", lambda model: (whole + alone) / 2)
    assert "one part at a time" in memory.fit(model, DiffusionSettings(model="-"), 8) and model.offload


def test_half_precision(open_engine):
    engine = open_engine(precision="bf16", tuning_steps=2, steps=2)
    learnt = engine.learn(PHOTO, FULL, quiet)
    assert all(array.dtype == np.float32 and np.isfinite(array).all() for array in learnt.lora.values())
    texture = engine.sample(learnt, (32, 32), 0, quiet)
    assert np.isfinite(texture.pixels).all() and texture.pixels.std() > 0
    assert engine.model(quiet).unet.dtype == torch.bfloat16 and engine.model(quiet).vae.dtype == torch.float32


def test_concept_file_says_what_it_is(concept, tmp_path):
    diffusion.save_concept(concept, tmp_path / "stone")
    about = json.loads((tmp_path / "stone" / "concept.json").read_text())
    assert about["version"] == 1 and about["token"] == "ohwx" and about["losses"] and about["crop_px"] == 64
    assert sorted(path.name for path in (tmp_path / "stone").iterdir()) == [
        "concept.json",
        "crops.safetensors",
        "lora.safetensors",
    ]


# ---------------------------------------------------------------- commands that use the engine


def load_script(path):
    import importlib.util
    from pathlib import Path

    file = Path(__file__).resolve().parent.parent / path
    spec = importlib.util.spec_from_file_location(file.stem + "_script", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_texsd_makes_every_class_and_goes_on(folders, tmp_path, capsys):
    texsd = load_script("training/texsd.py")
    assert len(set(texsd.CLASSES)) == 130
    arguments = ["--model", str(folders["epsilon"]), "-o", str(tmp_path), "--classes", "red brick", "sand"]
    arguments += ["--resolution", "32", "--steps", "2", "--per-class"]
    assert texsd.main([*arguments, "1"]) == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.png")}
    assert {path.parent.name for path in before} == {"red_brick", "sand"}
    assert texsd.main([*arguments, "2"]) == 0
    assert len(list(tmp_path.rglob("*.png"))) == 4 and all(path.read_bytes() == b for path, b in before.items())
    content = json.loads((tmp_path / "texsd.json").read_text())["textures"]
    assert len({entry["seed"] for entry in content.values()}) == 4
    assert "red brick" in content["red_brick/0000.png"]["prompt"]
    assert texsd.main([*arguments, "2", "--seed", "1"]) == 2 and "name another folder" in capsys.readouterr().err


@pytest.mark.slow
def test_ablation_fills_both_tables(folders, tmp_path, capsys, monkeypatch):
    import cv2

    ablation = load_script("benchmarks/diffusion.py")
    monkeypatch.setattr(diffusion, "CROP_SIDES", {False: 32, True: 32})
    cv2.imwrite(str(tmp_path / "photo.png"), np.rint(PHOTO * 255).astype(np.uint8))
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "stone.png"), np.full(PHOTO.shape[:2], 255, np.uint8))
    arguments = ["--model", str(folders["epsilon"]), "--photo", str(tmp_path / "photo.png"), "--masks"]
    arguments += [str(tmp_path / "masks"), "-o", str(tmp_path / "out"), "--seeds", "1", "--resolution", "32"]
    assert ablation.main([*arguments, "--tuning-steps", "1", "--steps", "1"]) == 0
    said = capsys.readouterr().out
    assert all(f"| {name} |" in said for name in (*ablation.INVERSIONS, *ablation.WORDINGS))
    assert len(json.loads((tmp_path / "out" / "ablation.json").read_text())["rows"]) == 8 + 3 * 4
