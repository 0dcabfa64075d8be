"""What the decomposer is trained with: light that is known, turns that keep it, opponents that can be read again."""

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from material_palette.benchmarks import rivals
from material_palette.core.errors import PaletteError
from textures import pebbles, tileable_noise

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "training"))
import materials  # noqa: E402
import renderings  # noqa: E402
import train  # noqa: E402

SIDE = 64  # px: the least that the opponent takes


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def bumps(count=4, strength=0.2):
    """Grey, rough, bumpy crops."""
    height = torch.stack([torch.from_numpy(tileable_noise(SIDE, SIDE, i).astype(np.float32)) for i in range(count)])
    height = SIDE * 0.06 * strength * height[:, None]
    slope = torch.cat([height.roll(-1, 3) - height.roll(1, 3), height.roll(-1, 2) - height.roll(1, 2)], 1)
    one = torch.ones(count, 1, SIDE, SIDE)
    maps = {"albedo": 0.4 * one.expand(-1, 3, -1, -1), "slope": 4 * slope, "height": height, "known": one}
    return maps | {"roughness": 0.9 * one, "metallic": 0 * one}


def test_what_faces_the_lamp_is_bright():
    batch = bumps(8)
    batch["height"] = 0 * batch["height"]  # a pit is dark whatever the lamp does
    photos, lamps = renderings.lit(batch, np.random.default_rng(0))
    assert lamps.shape == (8, 2, 1, 1)
    facing = -(batch["slope"] * lamps).sum(1)
    alike = [np.corrcoef(photo.mean(0).ravel(), x.ravel())[0, 1] for photo, x in zip(photos, facing, strict=True)]
    slanted = lamps.norm(dim=1).ravel().numpy() > 0.3
    assert slanted.sum() >= 4 and min(alike) > 0 and np.median(np.array(alike)[slanted]) > 0.5


def test_turned_pictures_keep_the_lamp_where_it_was_on_the_relief():
    batch = bumps(2)
    batch["lamp"] = torch.tensor([[0.7, 0.2], [-0.1, 0.5]])[..., None, None]
    batch["pixels"], before = batch["albedo"], (batch["slope"] * batch["lamp"]).sum(1)
    symmetric = [x for turned in (before, before.transpose(1, 2)) for x in (turned, turned.flip(1))]
    symmetric += [x.flip(2) for x in symmetric]
    seen = set()
    for seed in range(80):
        turned = renderings.turned(batch, np.random.default_rng(seed))
        after = (turned["slope"] * turned["lamp"]).sum(1)
        seen.update(i for i, x in enumerate(symmetric) if torch.allclose(x, after, atol=1e-6))
        assert any(torch.allclose(x, after, atol=1e-6) for x in symmetric)
    assert len(seen) == 8


def test_the_critic_learns_to_tell_true_maps_from_flat_ones():
    torch.manual_seed(0)
    critic = train.Critic()
    optimiser = torch.optim.Adam(critic.parameters(), lr=2e-3)
    batch = bumps(2, 1.0)
    true = {"albedo": batch["albedo"], "normal": renderings.normal_of(batch["slope"])}
    flat = true | {"normal": renderings.normal_of(0 * batch["slope"])}
    first = train.criticise(critic, optimiser, true, flat, flat)
    for _ in range(25):
        last = train.criticise(critic, optimiser, true, flat, flat)
    assert last > 0.7 and last > first  # flat maps fool it less and less
    assert critic(true).mean() > critic(flat).mean() + 0.3


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    """A folder in which the opponent's network was trained for a few steps on one picture, and its losses."""
    folder = tmp_path_factory.mktemp("deep")
    run, generator = train.Run(Path(), 0, "deep-materials"), torch.Generator().manual_seed(0)
    batch, errors = bumps(2), []
    batch["pixels"], batch["lamp"] = renderings.lit(batch, np.random.default_rng(1))
    for _ in range(6):
        parts = train.losses(run.find(batch["pixels"]), batch, generator)
        errors.append(float((parts["linear"] + parts["roughness"]).detach()))
        run.optimiser.zero_grad()
        sum(train.WEIGHTS[name] * part for name, part in parts.items()).backward()
        run.optimiser.step()
    run.average = {name: p.detach().clone() for name, p in run.learnt.items()}
    run.save(folder)
    return folder, errors


def test_the_opponent_learns_and_goes_on_where_it_stopped(learnt):
    folder, errors = learnt
    assert errors[-1] < 0.9 * errors[0]
    again = train.Run(Path(), 1, "deep-materials")
    again.load(folder)
    first = train.Run(Path(), 2, "deep-materials")
    first.load(folder)
    for name, p in again.learnt.items():
        assert torch.equal(p, first.learnt[name])


def test_the_critic_goes_on_where_it_stopped(tmp_path):
    runs = [train.Run(Path(), seed, "deep-materials", adversary=True) for seed in (0, 1)]
    batch = bumps(2)
    maps = {"albedo": batch["albedo"], "normal": renderings.normal_of(batch["slope"])}
    train.criticise(runs[0].critic, runs[0].critics, maps, maps, maps)
    runs[0].save(tmp_path)
    runs[1].load(tmp_path)
    with torch.no_grad():
        assert torch.equal(*(run.critic(maps) for run in runs))
    moments = [run.critics.state_dict()["state"][0]["exp_avg"] for run in runs]
    assert torch.equal(*moments) and moments[0].abs().max() > 0


def test_a_gain_beyond_all_measure_spoils_no_gradient():
    pixels, gain = torch.full((1, 3, 8, 8), 0.5), torch.full((1, 3, 8, 8), 200.0, requires_grad=True)
    found = train.answers({"gain": gain, "slope": torch.zeros(1, 2, 8, 8)}, pixels)
    assert found["albedo"].max() == 1
    found["albedo"].sum().backward()
    assert torch.isfinite(gain.grad).all()


def test_what_is_fitted_apart_outlives_a_pause(tmp_path, monkeypatch):
    monkeypatch.setattr(train, "from_published", lambda state: state)
    torch.save(train.SvbrdfNet().trunk.state_dict(), tmp_path / "trunk.pth")
    first, again = (train.Run(tmp_path / "trunk.pth", seed) for seed in (0, 1))
    first.start(ROOT / "models" / "svbrdf_net.safetensors")
    first.save(tmp_path)
    again.load(tmp_path)
    for name, p in first.net.named_parameters():
        assert torch.equal(dict(again.net.named_parameters())[name], p) or name.startswith("trunk."), name
    assert again.net.mean_roughness.weight.abs().max() > 0
    with pytest.raises(RuntimeError, match="DeepMaterials"):
        train.Run(Path(), 0, "deep-materials").load(tmp_path)


def test_the_opponent_is_read_from_its_file(learnt, tmp_path):
    texture = np.ascontiguousarray(pebbles(96, 80), np.float32) ** 2
    found = rivals.deep_materials(texture, learnt[0] / "svbrdf_net.safetensors")
    assert found.albedo.shape == found.normal.shape == (96, 80, 3) and found.roughness.shape == (96, 80)
    assert 0 <= found.albedo.min() and found.albedo.max() <= 1 and 0 <= found.roughness.min() <= found.roughness.max()
    assert np.allclose(np.linalg.norm(found.normal, axis=-1), 1, atol=1e-5)
    with pytest.raises(PaletteError, match="DeepMaterials"):
        rivals.deep_materials(texture, ROOT / "models" / "svbrdf_net.safetensors")


def test_sets_are_split_and_collections_chosen_by_name(tmp_path):
    for name in ("first/a", "first/b", "first/c", "first/d", "polyhaven/a", "second/a"):
        (tmp_path / "pbr" / name).mkdir(parents=True)
        for kind in ("basecolor", "normal", "roughness"):
            cv2.imwrite(str(tmp_path / "pbr" / name / f"{kind}.png"), np.full((8, 8, 3), 128, np.uint8))

    def names(sets):
        return [s.name for s in sets]

    training, held_out = map(names, materials.read_sets(tmp_path))
    assert training == ["first/a", "first/b", "first/c", "second/a"] and held_out == ["first/d", "polyhaven/a"]
    assert tuple(map(names, materials.read_sets(tmp_path, ["second"]))) == (["second/a"], [])
    with pytest.raises(FileNotFoundError, match="'third'.*first, polyhaven, second"):
        materials.read_sets(tmp_path, ["third"])
