"""The forecast follows the machine's last runs, and a damaged memory costs nothing but the forecast."""

import pytest
from material_palette.core import pace


def run(seconds, resolution=512, engine="patch", quality="draft"):
    return {"engine": engine, "quality": quality, "resolution": resolution, "seconds": seconds}


def test_forecast_is_the_median_of_the_latest_runs():
    history = [run(100)] * 5 + [run(s) for s in (9, 10, 11, 12, 90)]
    assert pace.expected(history, "patch", "draft", 512, 3) == pytest.approx(33)


def test_forecast_of_another_resolution_goes_by_the_cost_that_was_measured():
    """docs/results.md: CPU seconds of a material, 2 s less for the start of Python and torch."""
    history = [run(15.8, 1024, quality="balanced")]
    for resolution, seconds in ((256, 3.1), (512, 6.9), (2048, 46), (4096, 153)):
        assert pace.expected(history, "patch", "balanced", resolution, 1) == pytest.approx(seconds, rel=0.2)


def test_the_nearest_resolution_decides():
    history = [run(10, 512), run(1, 64)]
    assert 20 < pace.expected(history, "patch", "draft", 1024, 1) < 40
    assert 1 < pace.expected(history, "patch", "draft", 128, 1) < 2


def test_another_quality_stands_in_until_there_is_a_run_of_it():
    history = [run(10)]
    assert pace.expected(history, "patch", "best", 512, 1) > 20
    assert pace.expected([*history, run(99, quality="best")], "patch", "best", 512, 1) == pytest.approx(99)


def test_no_quality_is_said_to_take_longer_than_the_next():
    """Runs of two qualities on a machine that was busy during one of them."""
    history = [run(3, 128), run(6, 256, quality="balanced")]
    seconds = [pace.expected(history, "patch", q, 128, 1) for q in ("draft", "balanced", "best")]
    assert seconds == sorted(seconds)


def test_before_any_run_only_the_engine_that_ships_is_forecast():
    draft, balanced, best = (pace.expected([], "patch", q, 1024, 3) for q in ("draft", "balanced", "best"))
    assert 0 < draft < balanced < best
    assert pace.expected([run(10)], "diffusion", "draft", 512, 1) is None
    history = [run(10, engine="diffusion")]
    assert pace.expected(history, "diffusion", "draft", 512, 2) == pytest.approx(20)
    assert pace.expected(history, "diffusion", "best", 512, 1) is None


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
