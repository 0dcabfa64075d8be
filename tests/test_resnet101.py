import numpy as np
import pytest
import torch
from material_palette.core.decomposition import decompose
from material_palette.core.errors import PaletteError
from material_palette.core.tensors import write_tensors
from material_palette.core.torus import WRAP_GATE, wrap_ratio
from material_palette.models import resnet101
from textures import quiet, tileable_noise

pytestmark = pytest.mark.slow  # 70 million parameters are written and read


def texture(height, width):
    grey = 0.1 + 0.6 * tileable_noise(height, width)
    return np.stack([grey, 0.9 * grey, 0.7 * grey], -1).astype(np.float32)


@pytest.fixture(scope="module")
def state():
    torch.manual_seed(0)
    net = resnet101.Resnet101()
    # with the last layer's random start every map is nearly constant
    for decoder in net.model[1].decoders.values():
        torch.nn.init.normal_(decoder.decoder[10].conv.weight, std=0.1)
    state = {name: x.half() for name, x in net.state_dict().items()}
    # the classifier is of no use here, and in the file all the same
    return state | {"model.0.encoder.fc.weight": torch.zeros(1000, 8), "loss.weight": torch.ones(1)}


@pytest.fixture(scope="module")
def checkpoint(state, tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "model.ckpt"
    torch.save({"epoch": 3, "state_dict": state}, path)
    return path


@pytest.fixture(autouse=True)
def forget():
    yield
    resnet101.load.cache_clear()


def test_parameters_have_the_published_names(state):
    assert state["model.0.encoder.conv1.weight"].shape == (64, 3, 7, 7)
    assert state["model.0.encoder.layer3.22.conv2.weight"].shape == (256, 256, 3, 3)
    assert state["model.0.encoder.layer4.0.downsample.0.weight"].shape == (2048, 1024, 1, 1)
    for head, channels in (("albedo", 3), ("normals", 2), ("roughness", 1)):
        prefix = f"model.1.decoders.{head}.decoder"
        assert state[f"{prefix}.0.block.0.conv.weight"].shape == (256, 2048, 3, 3)
        assert state[f"{prefix}.1.block.0.conv.weight"].shape == (256, 256 + 1024, 3, 3)
        assert state[f"{prefix}.9.block.0.conv.bias"].shape == (16,)
        assert state[f"{prefix}.10.conv.weight"].shape == (channels, 16, 3, 3)
    assert not any("bn" in name for name in state)


def test_maps_tile_and_follow_the_texture(checkpoint):
    pixels = texture(128, 96)
    maps = resnet101.decompose(pixels, quiet, checkpoint)
    rolled = resnet101.decompose(np.roll(pixels, (32, -64), (0, 1)), quiet, checkpoint)
    for name in ("albedo", "normal", "roughness", "height"):
        value = getattr(maps, name)
        assert value.dtype == np.float32 and value.std() > 1e-5, name
        assert wrap_ratio(value) <= WRAP_GATE, name
        assert np.abs(getattr(rolled, name) - np.roll(value, (32, -64), (0, 1))).max() < 1 / 255, name
    assert np.allclose(np.linalg.norm(maps.normal, axis=-1), 1, atol=1e-5)


def test_cancelling_ends_it(checkpoint):
    class Stop(Exception):
        pass

    def stop(fraction, message):
        if fraction > 0.1:
            raise Stop

    with pytest.raises(Stop):
        decompose(texture(64, 64), stop, f"resnet101={checkpoint}")
    # and nothing of it is left in the network
    seen = []
    decompose(texture(64, 64), lambda fraction, message: seen.append(fraction), f"resnet101={checkpoint}")
    assert seen == sorted(seen) and seen[-1] == 1.0


def test_any_size_will_do(checkpoint):
    assert resnet101.decompose(texture(75, 110), quiet, checkpoint).roughness.shape == (75, 110)


def test_safetensors_give_the_same_maps(state, checkpoint, tmp_path):
    path = tmp_path / "model.safetensors"
    write_tensors(path, {name: x.numpy() for name, x in state.items()})
    pixels = texture(64, 64)
    expected = resnet101.decompose(pixels, quiet, checkpoint)
    assert np.array_equal(resnet101.decompose(pixels, quiet, path).albedo, expected.albedo)


def test_weights_of_another_network_are_refused(state, tmp_path):
    path = tmp_path / "other.ckpt"
    torch.save({"state_dict": {n: x for n, x in state.items() if "roughness" not in n}}, path)
    with pytest.raises(PaletteError, match=r"other.ckpt.*22 of its .* missing"):
        resnet101.load(path)
    wide = {**state, "model.1.decoders.albedo.decoder.10.conv.bias": torch.zeros(4)}
    torch.save(wide, path)
    with pytest.raises(PaletteError, match=r"decoder.10.conv.bias is \(4,\), not \(3,\)"):
        resnet101.load(path)


def test_a_file_that_could_run_code_is_not_opened(tmp_path):
    class Harm:
        def __reduce__(self):
            return (pytest.fail, ("code from the file was run",))

    path = tmp_path / "harm.ckpt"
    torch.save({"state_dict": {}, "callbacks": Harm()}, path)
    with pytest.raises(PaletteError, match="more than tensors"):
        resnet101.load(path)
    with pytest.raises(PaletteError, match="missing.ckpt"):
        resnet101.load(tmp_path / "missing.ckpt")


@pytest.mark.parametrize("content", [b"hello", b"", b"\x80", b"PK\x03\x04", b"(dp0\n.", b"{}", bytes(100)])
def test_a_file_of_another_kind_is_named(tmp_path, content):
    path = tmp_path / "model.ckpt"
    path.write_bytes(content)
    with pytest.raises(PaletteError, match="model.ckpt"):
        resnet101.load(path)
    with pytest.raises(PaletteError, match="read the checkpoint"):
        resnet101.load(tmp_path)


@pytest.mark.parametrize("state", [{"state_dict": [1]}, {"state_dict": {3: torch.zeros(1)}}, [torch.zeros(1)]])
def test_a_checkpoint_of_no_named_tensors_is_refused(tmp_path, state):
    torch.save(state, tmp_path / "model.ckpt")
    with pytest.raises(PaletteError, match="missing"):
        resnet101.load(tmp_path / "model.ckpt")
