"""The adapter loads models of transformers' own classes, tiny and random, and places prompts as they expect them."""

import json

import numpy as np
import pytest
from material_palette.core.errors import PaletteError
from material_palette.core.segmentation import picker, sam, segment
from material_palette.core.segmentation.pick import Click, Pick


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
    ours = found.model.network.state_dict()
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
            image_embeddings=found.model.embedding,
            input_points=torch.tensor([[[point]]]),
            input_labels=torch.tensor([[[1]]]),
            multimask_output=True,
        )
    best = out.pred_masks[0, 0, out.iou_scores[0, 0].argmax()].numpy()
    assert (mask == (found._full(best) > 0)).all()


def test_boxes_and_negative_clicks_reach_the_model(loaded):
    found = loaded[3]
    prompts = []
    whole = found.model.network.forward
    found.model.network.forward = lambda **given: prompts.append(given) or whole(**given)
    found.select([Click(10, 10), Click(70, 30, positive=False)], box=(5, 5, 75, 35))
    del found.model.network.forward
    assert prompts[0]["input_labels"].tolist() == [[[1, 0]]]
    left, top, right, bottom = prompts[0]["input_boxes"][0, 0].tolist()
    assert 0 < left < right <= 64 and 0 < top < bottom <= 64
    assert not found.select([]).any()


@pytest.fixture(scope="module", params=["sam", "raw", "sam2"])
def exported(request, tmp_path_factory):
    """A folder with an encoder and a decoder in the form of the exports: the mask is a disc around the first point, and
    brighter where the encoder saw red."""
    pytest.importorskip("onnxruntime", reason="optional: Segment Anything by ONNX Runtime")
    onnx = pytest.importorskip("onnx", reason="builds the models of this test")
    from onnx import TensorProto, helper, numpy_helper

    kind = request.param
    number = TensorProto.FLOAT
    folder = tmp_path_factory.mktemp("onnx")

    def save(name, nodes, inputs, outputs, constants=()):
        weights = [numpy_helper.from_array(np.asarray(value), key) for key, value in constants]
        told = [
            [helper.make_tensor_value_info(key, number, shape) for key, shape in side] for side in (inputs, outputs)
        ]
        model = helper.make_model(
            helper.make_graph([helper.make_node(*n[:3], **n[3]) for n in nodes], name, *told, weights),
            opset_imports=[helper.make_opsetid("", 13)],
            ir_version=8,
        )
        onnx.save(model, str(folder / f"tiny_{name}.onnx"))

    flat = [("Transpose", ["image"], ["planes"], {"perm": [2, 0, 1]}), ("Unsqueeze", ["planes", "axis"], ["batch"], {})]
    flat = flat if kind == "raw" else [("Identity", ["image"], ["batch"], {})]
    pool = ("AveragePool", ["batch"], ["image_embeddings"], {"kernel_shape": [4, 4], "strides": [4, 4]})
    more = [("Identity", ["image_embeddings"], ["high_res_feats_0"], {})] if kind == "sam2" else []
    embeddings = ["image_embeddings", "high_res_feats_0"][: 1 + len(more)]
    save(
        "encoder",
        [*flat, pool, *more],
        [("image", [64, 64, 3] if kind == "raw" else [1, 3, 64, 64])],
        [(name, [1, 3, 16, 16]) for name in embeddings],
        [("axis", np.array([0]))],
    )
    rows, columns = np.mgrid[:16, :16].astype(np.float32)
    centres = np.stack([columns.ravel() * 4 + 2, rows.ravel() * 4 + 2], 1)[None]
    save(
        "decoder",
        [
            ("Slice", ["point_coords", "zero", "one"], ["first"], {}),
            ("Sub", ["centres", "first"], ["difference"], {}),
            ("Mul", ["difference", "difference"], ["squares"], {}),
            ("ReduceSum", ["squares", "two"], ["distance"], {"keepdims": 0}),
            ("Sub", ["radius", "distance"], ["disc"], {}),
            ("Reshape", ["disc", "shape"], ["image_disc"], {}),
            ("Concat", ["image_disc"] * (3 if kind == "sam2" else 4), ["masks"], {"axis": 1}),
            ("Identity", ["scores"], ["iou_predictions"], {}),
            ("Identity", ["point_labels"], ["unused"], {}),
        ],
        [
            *((name, [1, 3, 16, 16]) for name in embeddings),
            ("point_coords", [1, None, 2]),
            ("point_labels", [1, None]),
            *([] if kind == "sam2" else [("mask_input", [1, 1, 16, 16]), ("has_mask_input", [1])]),
        ],
        [("masks", None), ("iou_predictions", None), ("unused", None)],
        [
            ("zero", np.array([0, 0, 0])),
            ("one", np.array([1, 1, 2])),
            ("two", np.array([2])),
            ("radius", np.float32([150.0])),
            ("centres", centres),
            ("shape", np.array([1, 1, 16, 16])),
            ("scores", np.full((1, 3 if kind == "sam2" else 4), 0.9, np.float32)),
        ],
    )
    return kind, folder


def test_onnx_models_get_the_photo_and_the_click_where_they_are(exported, photo):
    kind, folder = exported
    found = sam.Sam(folder)
    seen = []
    run = found.model.encoder.run
    found.model.encoder = type("Spy", (), {"run": lambda self, names, feed: seen.append(feed) or run(names, feed)})()
    found.model.encoder.get_outputs = sam.Sam(folder).model.encoder.get_outputs
    found.look(np.full_like(photo, 0.5) * [1, 0, 0])
    red = seen[0]["image"] if kind == "raw" else seen[0]["image"][0].transpose(1, 2, 0)
    inside = red[:32, :, 0] if kind != "sam2" else red[..., 0]  # a photo of 80 x 40 fills half of the square
    level = 0.735  # 0.5 in sRGB
    assert np.allclose(inside, 255 * level if kind == "raw" else (level - 0.485) / 0.229, rtol=0.01)
    assert kind == "sam2" or not red[32:].any()
    mask = found.select([Click(60, 12)])
    rows, columns = np.nonzero(mask)
    assert abs(columns.mean() - 60) < 2 and abs(rows.mean() - 12) < 2
    assert mask.shape == photo.shape[:2] and 0 < mask.mean() < 0.5


def test_onnx_prompts_are_those_of_the_export(exported, photo):
    found = sam.Sam(exported[1])
    found.look(photo)
    seen = []
    run = found.model.decoder.run
    found.model.decoder = type("Spy", (), {"run": lambda self, names, feed: seen.append(feed) or run(names, feed)})()
    found.select([Click(10, 10), Click(70, 30, positive=False)], box=(0, 0, 80, 40))
    found.select([Click(10, 10)])
    assert seen[0]["point_labels"].tolist() == [[1, 0, 2, 3]]
    lower = 64 if exported[0] == "sam2" else 32
    assert seen[0]["point_coords"][0, 2:].tolist() == [[0, 0], [64, lower]]
    assert seen[1]["point_labels"].tolist() == [[1, -1]]


def test_weights_decide_what_answers_clicks(exported, photo, tmp_path):
    found = picker(exported[1])
    assert isinstance(found, sam.Sam) and found.takes_box
    assert isinstance(picker(), Pick) and isinstance(picker(""), Pick)
    with pytest.raises(PaletteError, match="Materialistic"):
        picker(tmp_path / "weights.ckpt")
    found.look(photo)
    areas = [found.select([Click(40, 20)], tolerance).sum() for tolerance in (0.0, 0.5, 1.0)]
    assert areas == sorted(areas) and areas[0] < areas[2]


def test_onnx_models_of_another_kind_are_refused(exported, tmp_path):
    _, folder = exported
    (tmp_path / "encoder.onnx").write_bytes((folder / "tiny_encoder.onnx").read_bytes())
    with pytest.raises(PaletteError, match="1 and 0 files"):
        sam.Sam(tmp_path)
    (tmp_path / "decoder.onnx").write_bytes((folder / "tiny_encoder.onnx").read_bytes())
    with pytest.raises(PaletteError, match="takes image and gives image_embeddings"):
        sam.Sam(tmp_path)
    (tmp_path / "decoder.onnx").write_bytes(b"nonsense")
    with pytest.raises(PaletteError, match="can't be loaded"):
        sam.Sam(tmp_path)


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


def test_what_is_too_small_is_said(monkeypatch):
    masks = [np.zeros((100, 100), bool) for _ in range(3)]
    masks[0][:50], masks[1][60:66, :10], masks[2][80:81] = True, True, True  # half, too small, too thin

    class Found:
        def __init__(self, folder):
            pass

        def look(self, pixels):
            pass

        def everything(self, progress):
            return masks

    monkeypatch.setattr(sam, "Sam", Found)
    words = []
    (region,) = segment(np.full((100, 100, 3), 0.5, np.float32), engine="sam", warn=words.append)
    assert (region.mask == masks[0]).all()
    assert words == [
        "2 parts of the photo, 1.6% of it together, are too small for a region and are left out. "
        "Paint them to have them."
    ]
