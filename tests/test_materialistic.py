"""The network has the published names and does what the paper says; its adapter reads checkpoints, answers clicks."""

import numpy as np
import pytest
import torch
from material_palette.core.errors import PaletteError
from material_palette.core.segmentation import materialistic as adapter
from material_palette.core.segmentation import segment
from material_palette.core.segmentation.pick import Click
from material_palette.core.tensors import write_tensors
from material_palette.models.materialistic import Block, CrossSimilarity, Materialistic

TINY = {"width": 32, "heads": 2, "depth": 12, "grid": 4, "channels": 16}


def normalised(photo):
    encoded = np.where(photo <= 0.0031308, photo * 12.92, 1.055 * photo ** (1 / 2.4) - 0.055)
    batch = torch.from_numpy(((encoded - adapter.MEAN) / adapter.DEVIATION).astype(np.float32))
    return batch.permute(2, 0, 1)[None]


@pytest.fixture(scope="module")
def photo():
    """Two materials, and a third: left, right, and a band below."""
    pixels = np.random.default_rng(0).random((64, 96, 3), np.float32) * 0.1
    pixels[:, :48] += (0.7, 0.2, 0.1)
    pixels[:, 48:] += (0.1, 0.3, 0.7)
    pixels[48:] = pixels[48:, :, ::-1] * 0.5
    return pixels


@pytest.fixture(scope="module")
def net(photo):
    torch.manual_seed(0)
    net = Materialistic(**TINY).eval()
    for weights in net.parameters():  # with torch's own start every score is about the same
        if weights.dim() > 1:
            torch.nn.init.normal_(weights, std=2 / weights[0].numel() ** 0.5)
    last = net.out_conv[-1]
    with torch.no_grad():
        last.weight *= 0.01
        maps = net.look(normalised(photo))
        logits = torch.stack([torch.logit(net.score(maps, place)) for place in ((20, 20), (20, 70), (55, 50))])
        last.bias -= logits.median()
        last.weight *= 2 / logits.std()
        last.bias *= 2 / logits.std()
    return net


@pytest.fixture(scope="module")
def checkpoint(net, tmp_path_factory):
    """As PyTorch Lightning saves it."""
    path = tmp_path_factory.mktemp("weights") / "materialistic.ckpt"
    torch.save({"epoch": 3, "state_dict": {f"net.{name}": x for name, x in net.state_dict().items()}}, path)
    return path


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(adapter, "SHORTER_SIDE", 64)


def test_parameters_have_the_published_names_and_shapes():
    with torch.device("meta"):
        shapes = {name: tuple(x.shape) for name, x in Materialistic().state_dict().items()}
    assert shapes["dino_model.pos_embed"] == (1, 1 + 28 * 28, 768)
    assert shapes["dino_model.patch_embed.proj.weight"] == (768, 3, 8, 8)
    assert shapes["dino_model.blocks.11.attn.qkv.bias"] == (3 * 768,)
    assert shapes["dino_model.blocks.0.mlp.fc2.weight"] == (768, 4 * 768)
    assert shapes["spatial_transform_4.0.project.0.weight"] == (768, 2 * 768)
    assert shapes["spatial_transform_1.2.weight"] == (256, 768, 1, 1)
    assert shapes["cross_attention_2.get_reference_embedding.reference_feature_extractor.0.weight"] == (512, 258)
    assert shapes["cross_attention_3.out_norm.weight"] == (256,)
    assert shapes["fusion_1.resConfUnit2.conv2.weight"] == (256, 256, 3, 3)
    assert "fusion_1.resConfUnit2.conv2.bias" not in shapes
    assert shapes["out_conv.6.weight"] == (1, 128)


def test_a_block_is_torchs_own_transformer_layer():
    torch.manual_seed(0)
    ours, x = Block(32, 2), torch.randn(1, 9, 32)
    theirs = torch.nn.TransformerEncoderLayer(32, 2, 128, 0.0, "gelu", 1e-6, batch_first=True, norm_first=True).eval()
    pairs = (
        ("self_attn.in_proj_", ours.attn.qkv),
        ("self_attn.out_proj.", ours.attn.proj),
        ("linear1.", ours.mlp.fc1),
        ("linear2.", ours.mlp.fc2),
        ("norm1.", ours.norm1),
        ("norm2.", ours.norm2),
    )
    theirs.load_state_dict({name + end: getattr(layer, end) for name, layer in pairs for end in ("weight", "bias")})
    with torch.no_grad():
        assert torch.allclose(ours(x), theirs(x), atol=1e-5)


def test_cross_similarity_weights_each_value_by_its_likeness_to_the_click():
    """Against the paper's formula, pixel by pixel and head by head."""
    torch.manual_seed(0)
    layer, context = CrossSimilarity(32), torch.randn(1, 32, 3, 4)
    place, stride = (5, 9), 4  # cell (1, 2), 1 px below and left of its middle
    with torch.no_grad():
        found = layer(context, place, stride)
        normed = layer.LayerNorm(context[0].permute(1, 2, 0))
        local = torch.tensor([(5 - 5.5) / 1.5001, (9 - 9.5) / 1.5001])
        click = layer.get_reference_embedding.reference_feature_extractor(torch.cat([normed[1, 2], local]))
        query = layer.query(click)
        for row in range(3):
            for column in range(4):
                key, value = layer.key(normed[row, column]), layer.value(normed[row, column])
                heads = [slice(2 * h, 2 * h + 2) for h in range(16)]
                mixed = [torch.sigmoid(query[h] @ key[h] / 2**0.5) * value[h] for h in heads]
                expected = layer.out_norm(layer.out(torch.cat(mixed)))
                assert torch.allclose(found[0, :, row, column], expected, atol=1e-5)


def test_the_same_patches_score_the_same_wherever_they_lie(net):
    """With no word of where a patch is, what repeats by whole patches has scores that repeat, but at the edge."""
    import copy

    net = copy.deepcopy(net)
    torch.nn.init.zeros_(net.dino_model.pos_embed)
    torch.manual_seed(1)
    pixels = torch.randn(1, 3, 8, 8).repeat(1, 1, 12, 16)
    with torch.no_grad():
        maps = net.look(pixels)
        assert all(torch.allclose(m, m[..., :1, :1].expand_as(m), atol=1e-4) for m in maps)


def test_a_click_uses_the_weights_of_the_file(net, checkpoint, photo, tmp_path):
    found = adapter.Materialistic(checkpoint)
    found.look(photo)
    ours = found.net.state_dict()
    assert all((tensor == ours[name]).all() for name, tensor in net.state_dict().items())
    with torch.no_grad():
        score = net.score(net.look(normalised(photo)), (20, 30)).numpy()
    assert score.shape == (64, 96)
    for tolerance in (0.3, 0.5, 0.7):
        mask = found.select([Click(30.4, 20.6)], tolerance)
        assert np.mean(mask == (score > 1 - tolerance)) > 0.999
    write_tensors(tmp_path / "plain.safetensors", {n: x.numpy() for n, x in net.state_dict().items()}, {})
    again = adapter.Materialistic(tmp_path)  # a folder with a state dict
    again.look(photo)
    assert (again.select([Click(30.4, 20.6)]) == found.select([Click(30.4, 20.6)])).all()


def test_clicks_add_and_take_away_and_tolerance_widens(checkpoint, photo):
    found = adapter.Materialistic(checkpoint)
    found.look(photo)
    first, second = Click(20, 20), Click(70, 20)
    both = found.select([first, second])
    assert (both == (found.select([first]) | found.select([second]))).all()
    without = found.select([first, Click(70, 20, positive=False)], 0.9)
    assert not (without & ~found.select([first], 0.9)).any()
    areas = [found.select([first], tolerance).sum() for tolerance in (0.1, 0.4, 0.7, 1.0)]
    assert areas == sorted(areas) and areas[0] < areas[-1]
    assert not found.select([]).any()


def test_regions_are_found_without_clicks(checkpoint, photo):
    fractions = []
    regions = segment(
        photo, engine="materialistic", regions=3, weights=checkpoint, progress=lambda f, m: fractions.append(f)
    )
    assert 1 <= len(regions) <= 3 and np.sum([region.mask for region in regions], 0).max() == 1
    assert fractions[-1] == 1 and (np.diff(fractions) >= 0).all()


def test_what_is_no_checkpoint_of_it_is_refused(net, tmp_path, photo):
    with pytest.raises(PaletteError, match="needs weights.*--weights FILE"):
        segment(photo, engine="materialistic")
    with pytest.raises(PaletteError, match=r"holds no .safetensors, .ckpt or .pth file"):
        adapter.Materialistic(tmp_path)
    with pytest.raises(PaletteError, match="can't be read"):
        adapter.Materialistic(tmp_path / "none.ckpt")
    torch.save({"state_dict": {}, "hyper_parameters": adapter.Materialistic}, tmp_path / "code.ckpt")
    with pytest.raises(PaletteError, match="holds more than tensors.*state_dict"):
        adapter.Materialistic(tmp_path / "code.ckpt")
    torch.save({"weight": torch.zeros(3)}, tmp_path / "other.pth")
    with pytest.raises(PaletteError, match="is not Materialistic's network"):
        adapter.Materialistic(tmp_path / "other.pth")
    state = net.state_dict()
    del state["fusion_2.out_conv.bias"]
    torch.save(state, tmp_path / "less.pth")
    with pytest.raises(PaletteError, match=r"1 of its .* tensors differ: fusion_2.out_conv.bias is missing"):
        adapter.Materialistic(tmp_path / "less.pth")
