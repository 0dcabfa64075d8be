"""The loading and ranking are real; the model is CLIP's own class, made here with a few thousand random weights."""

import numpy as np
import pytest

pytest.importorskip("transformers", reason="transformers (requirements-diffusion.txt)")
import torch
from material_palette.benchmarks import endtoend
from material_palette.benchmarks.zero_shot import ZeroShot
from tiny_diffusion import LENGTH, WIDTH, tokenizer
from transformers import CLIPConfig, CLIPModel

CLASSES = ["brick", "fabric_weave", "moss", "stone"]


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    folder, marks = tmp_path_factory.mktemp("clip"), tokenizer()
    both = {"hidden_size": WIDTH, "intermediate_size": 2 * WIDTH, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = {"vocab_size": len(marks), "max_position_embeddings": LENGTH}
    text |= {f"{name}_token_id": getattr(marks, f"{name}_token_id") for name in ("bos", "eos", "pad")}
    vision = {"image_size": 32, "patch_size": 8}
    torch.manual_seed(0)
    model = CLIPModel(CLIPConfig(text_config=both | text, vision_config=both | vision, projection_dim=WIDTH))
    model.save_pretrained(folder)
    marks.save_pretrained(folder)
    return folder


def test_places_are_all_different_and_told_by_the_picture(weights):
    classify, random = ZeroShot(weights, CLASSES), np.random.default_rng(0)
    orders = set()
    for level in (0.05, 0.5, 0.95):
        picture = np.clip(level + 0.2 * random.standard_normal((60, 80, 3)), 0, 1)
        ranks = [classify.rank(picture, name) for name in CLASSES]
        assert sorted(ranks) == [1, 2, 3, 4] and ranks == [classify.rank(picture, name) for name in CLASSES]
        orders.add(tuple(ranks))
    assert len(orders) > 1


def test_a_folder_without_clip_is_an_error(tmp_path):
    with pytest.raises((OSError, ValueError)):
        ZeroShot(tmp_path, CLASSES)


def test_the_table_tells_the_share_of_first_places():
    rows = [{"row": "ours", "A": 0.1, "N": 0.1, "R": 0.1, "clip_rank": rank} for rank in (1, 3, 7, 1)]
    lines = endtoend.resemblance_table([*rows, {"row": "other class", "A": 0.2, "N": 0.2, "R": 0.2}]).splitlines()
    assert lines[0].endswith("| CLIP top-1 | top-5 |") and len({line.count("|") for line in lines}) == 1
    assert lines[2].endswith("| 0.500 | 0.750 |") and lines[3].endswith("|  |  |")
