import numpy as np
import pytest
from material_palette.core import front
from material_palette.core.errors import PaletteError
from material_palette.core.palette import Settings
from textures import pebbles


def test_the_cheapest_preset_that_meets_the_error_is_taken(monkeypatch):
    presets = {"draft": {"slope": 1.0, "offset": 0.02}, "best": {"slope": 0.8, "offset": 0.01}}
    monkeypatch.setattr(front, "_front", lambda: {"usual_spread": 0.1, "presets": presets})
    assert front.choose(0.05, 0.1) == ("draft", pytest.approx(0.07), True)
    assert front.choose(0.1, 0.1) == ("best", pytest.approx(0.09), True)
    assert front.choose(0.3, 0.1) == ("best", pytest.approx(0.25), False)
    assert front.choose(None, 0.1) == ("best", pytest.approx(0.09), True)


def test_a_region_of_one_texture_has_less_spread_than_one_of_two():
    pixels = pebbles(160, 320)
    mask = np.ones((160, 320), bool)
    two = pixels.copy()
    two[:, 160:] = 0.5 + 0.3 * (np.arange(160)[:, None, None] // 4 % 2)
    assert front.spread(pixels, mask) < 0.5 * front.spread(two, mask)
    mask[:, 40:] = False  # no crop fits
    assert front.spread(pixels, mask) is None


def test_the_measured_front_is_complete_and_ordered_by_cost():
    content = front._front()
    assert set(content["presets"]) == {"draft", "balanced", "best"}
    seconds = [preset["seconds"] for preset in content["presets"].values()]
    assert seconds == sorted(seconds) and content["usual_spread"] > 0


def test_a_target_that_cannot_be_honoured_is_refused():
    with pytest.raises(PaletteError, match="target error"):
        Settings(target_error=0.0).check()
    with pytest.raises(PaletteError, match="patch"):
        Settings(target_error=0.1, engine="diffusion").check()
