"""The benchmarks' scenes: the grey card that is held into them, and textures of known materials made of them."""

import sys
from pathlib import Path

import numpy as np
import pytest
from material_palette.benchmarks import made, scenes
from material_palette.core.material import SVBRDF
from material_palette.models.svbrdf_net import TEXTURE, SvbrdfNet

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "training"))
import roughness  # noqa: E402
import scene_textures  # noqa: E402


def test_a_grey_card_under_an_even_sky_shows_a_fifth_of_it_and_is_gone_afterwards():
    scene = scenes.Scene("table", 2, (160, 120), 4)
    dark = SVBRDF(np.float32([0.02, 0.02, 0.02]), np.float32([0, 0, 1]), 1.0)
    scene.dress(dict.fromkeys(scene.things, dark), dict.fromkeys(scene.things, (1.0, 1.0)))
    nodes = scene.bpy.context.scene.world.node_tree.nodes["Background"].inputs["Color"]
    scene.bpy.context.scene.world.node_tree.links.remove(nodes.links[0])
    nodes.default_value = (1.0, 0.8, 0.5, 1)
    before = set(scene.bpy.data.objects.keys())
    card = np.array(scene.show_card(1.5))
    # dark things around it take a part of the sky away
    assert np.all(card < 1.02 * 0.18 * 1.5 * np.array([1.0, 0.8, 0.5])) and card[0] > 0.6 * 0.18 * 1.5
    assert card / card[0] == pytest.approx(np.array([1.0, 0.8, 0.5]), abs=0.05)
    assert set(scene.bpy.data.objects.keys()) == before


def test_textures_of_known_materials_are_made_once_and_learnt_from(tmp_path, monkeypatch):
    data, folder = made.make_data(tmp_path / "data"), tmp_path / "textures"
    monkeypatch.setattr(scenes, "WIDTH", 200)
    monkeypatch.setattr(scenes, "HEIGHT", 150)
    monkeypatch.setattr(scenes, "SAMPLES", 1)
    arguments = ["scene_textures.py", str(data), "-o", str(folder), "--scenes", "1"]
    monkeypatch.setattr(sys, "argv", arguments)
    scene_textures.main()
    rows = [line.split(",") for line in (folder / scene_textures.TABLE).read_text().split()]
    assert rows and len({name for name, _, _ in rows}) == len(rows)
    held_out = {f"made/{family}_3" for family in made.FAMILIES}
    assert not held_out & {material for _, material, _ in rows}
    before = (folder / rows[0][0]).stat().st_mtime_ns
    scene_textures.main()
    assert (folder / rows[0][0]).stat().st_mtime_ns == before

    names = ["made/none", rows[0][1]]
    x, y, number = roughness.described_textures(SvbrdfNet().eval(), folder, names)
    own = [row for row in rows if row[1] == rows[0][1]]
    assert x.shape == (len(own) * len(roughness.REPEATS), TEXTURE) and set(number) == {1}
    assert y[0] == pytest.approx(float(own[0][2]))
