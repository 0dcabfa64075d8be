"""The forecast follows the machine's last runs, and a damaged memory costs nothing but the forecast."""

import pytest
from material_palette.core import pace


def run(seconds, resolution=512, engine="patch", quality="draft"):
    return {"engine": engine, "quality": quality, "resolution": resolution, "seconds": seconds}


def test_forecast_is_the_median_of_the_latest_runs():
    history = [run(100)] * 5 + [run(s) for s in (9, 10, 11, 12, 90)]
    assert pace.expected(history, "patch", "draft", 512, 3) == 33


def test_forecast_of_another_resolution_goes_by_the_pixels():
    history = [run(10, 512), run(1, 64)]
    assert pace.expected(history, "patch", "draft", 1024, 1) == 40
    assert pace.expected(history, "patch", "draft", 128, 1) == 4


def test_another_engine_or_quality_tells_nothing():
    assert pace.expected([run(10)], "patch", "best", 512, 1) is None
    assert pace.expected([run(10)], "diffusion", "draft", 512, 1) is None


def test_memory_is_bounded_and_survives(tmp_path):
    history = [run(i) for i in range(1000)]
    pace.remember(tmp_path / "pace.json", history)
    kept = pace.remembered(tmp_path / "pace.json")
    assert kept == history[-len(kept) :] and 50 < len(kept) < 1000


@pytest.mark.parametrize("text", ["", "{", "[1]", '[{"engine": "patch"}]', "null"])
def test_a_damaged_memory_is_no_memory(tmp_path, text):
    (tmp_path / "pace.json").write_text(text)
    assert pace.remembered(tmp_path / "pace.json") == []


def test_no_folder_is_no_failure(tmp_path):
    pace.remember(tmp_path / "nowhere" / "pace.json", [run(1)])
    pace.remember(None, [run(1)])
    assert pace.remembered(None) == pace.remembered(tmp_path / "nowhere" / "pace.json") == []
