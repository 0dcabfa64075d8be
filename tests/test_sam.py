"""The adapter loads models of transformers' own classes, tiny and random, and places prompts as they expect them."""

import json

import numpy as np
import pytest
from material_palette.core.errors import PaletteError
from material_palette.core.segmentation import sam, segment
from material_palette.core.segmentation.pick import Click


@pytest.fixture(scope="module")
def photo():
    return np.random.default_rng(0).random((40, 80, 3), np.float32)


def tiny(kind, folder):
    transformers = pytest.importorskip("transformers", reason="optional: Segment Anything")
    import torch

    torch.manual_seed(0)
    prompt = {"hidden_size": 32, "image_size": 64, "patch_size": 16, "mask_input_channels": 4}
    decoder = {"hidden_size": 32, "mlp_dim": 32, "num_attention_heads": 4, "iou_head_hidden_dim": 32}
    if kind == "sam":
        vision = {
            "hidden_size": 32,
            "output_channels": 32,
            "num_hidden_layers": 2,
            "num_attention_heads": 4,
            "image_size": 64,
            "patch_size": 16,
            "window_size": 2,
            "global_attn_indexes": [1],
            "num_pos_feats": 16,
            "mlp_dim": 32,
        }
        configs = {"vision_config": vision, "prompt_encoder_config": prompt, "mask_decoder_config": decoder}
        config = transformers.SamConfig(**configs)
        model = transformers.SamModel(config)
    else:
        backbone = {
            "hidden_size": 8,
            "image_size": [64, 64],
            "blocks_per_stage": [1, 1, 2, 1],
            "embed_dim_per_stage": [8, 16, 32, 64],
            "num_attention_heads_per_stage": [1, 1, 2, 2],
            "window_size_per_stage": [4, 4, 2, 2],
            "global_attention_blocks": [3],
            "window_positional_embedding_background_size": [4, 4],
        }
        vision = {
            "backbone_config": {"model_type": "sam2_hiera_det_model", **backbone},
            "backbone_channel_list": [64, 32, 16, 8],
            "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
            "fpn_hidden_size": 32,
        }
        configs = {"vision_config": vision, "prompt_encoder_config": prompt, "mask_decoder_config": decoder}
        config = transformers.Sam2Config(**configs)
        model = transformers.Sam2Model(config)
    model.save_pretrained(folder)
    return model.eval()


@pytest.fixture(scope="module", params=["sam", "sam2"])
def loaded(request, tmp_path_factory, photo):
    folder = tmp_path_factory.mktemp(request.param)
    model = tiny(request.param, folder)
    found = sam.Sam(folder)
    found.look(photo)
    return request.param, folder, model, found


def test_the_weights_of_the_folder_are_used(loaded):
    _, _, model, found = loaded
    ours = found.model.state_dict()
    assert all((tensor == ours[name]).all() for name, tensor in model.state_dict().items())


def test_a_click_gives_the_models_best_mask(loaded, photo):
    """Against the model called by hand with the click placed in its square."""
    import torch

    kind, _, model, found = loaded
    mask = found.select([Click(60, 12)])
    assert mask.shape == photo.shape[:2] and mask.dtype == bool
    point = (60 * 64 / 80, 12 * 64 / 80) if kind == "sam" else (60 * 64 / 80, 12 * 64 / 40)
    with torch.inference_mode():
        out = model(
            image_embeddings=found.embedding,
            input_points=torch.tensor([[[point]]]),
            input_labels=torch.tensor([[[1]]]),
            multimask_output=True,
        )
    best = out.pred_masks[0, 0, out.iou_scores[0, 0].argmax()].numpy()
    assert (mask == (found._full(best) > 0)).all()


def test_boxes_and_negative_clicks_reach_the_model(loaded):
    found = loaded[3]
    prompts = []
    whole = found._masks
    found._masks = lambda **given: prompts.append(given) or whole(**given)
    found.select([Click(10, 10), Click(70, 30, positive=False)], box=(5, 5, 75, 35))
    del found._masks
    assert prompts[0]["input_labels"].tolist() == [[[1, 0]]]
    left, top, right, bottom = prompts[0]["input_boxes"][0, 0].tolist()
    assert 0 < left < right <= 64 and 0 < top < bottom <= 64
    assert not found.select([]).any()


def test_everything_is_disjoint(loaded, photo, monkeypatch):
    monkeypatch.setattr(sam, "LEAST_SCORE", -1e9)
    monkeypatch.setattr(sam, "LEAST_STABILITY", 0.0)
    monkeypatch.setattr(sam, "GRID", 4)
    fractions = []
    masks = loaded[3].everything(lambda fraction, message: fractions.append(fraction))
    assert fractions[-1] == 1
    assert np.sum(masks, 0).max() <= 1 if masks else True
    areas = [mask.sum() for mask in masks]
    assert areas == sorted(areas, reverse=True)


def test_of_two_masks_that_overlap_the_better_stays():
    large, less, other = (np.zeros((20, 20), bool) for _ in range(3))
    large[:10], less[:9], other[12:] = True, True, True
    kept = sam._distinct([(0.8, less), (0.9, large), (0.7, other)])
    assert len(kept) == 2 and (kept[0] == large).all() and (kept[1] == other).all()


def test_missing_weights_and_other_models_are_said(tmp_path, photo):
    with pytest.raises(PaletteError, match="needs weights.*--weights DIR"):
        segment(photo, engine="sam")
    with pytest.raises(PaletteError, match="holds no readable config.json"):
        segment(photo, engine="sam", weights=tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "bert"}))
    with pytest.raises(PaletteError, match="model of type 'bert'"):
        segment(photo, engine="sam", weights=tmp_path)
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "sam"}))
    (tmp_path / "pytorch_model.bin").write_bytes(b"pickle")
    with pytest.raises(PaletteError, match="pickled weights aren't read"):
        segment(photo, engine="sam", weights=tmp_path)


def test_weights_that_lack_tensors_are_said(loaded, tmp_path, photo):
    from safetensors.torch import load_file, save_file

    _, folder, _, _ = loaded
    tensors = load_file(folder / "model.safetensors")
    name = next(name for name in sorted(tensors) if "mask_decoder" in name)
    del tensors[name]
    save_file(tensors, tmp_path / "model.safetensors", {"format": "pt"})
    (tmp_path / "config.json").write_text((folder / "config.json").read_text())
    with pytest.raises(PaletteError, match="lack 1 tensors"):
        sam.Sam(tmp_path)
