"""The benchmarks' scenes: the grey card that is held into them."""

import numpy as np
import pytest
from material_palette.benchmarks import scenes
from material_palette.core.material import SVBRDF


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
