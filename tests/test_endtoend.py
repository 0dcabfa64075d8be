"""The end-to-end, stability and speed suites: their scales, their distances, their resumption."""

import numpy as np
import pytest
from material_palette.benchmarks import endtoend, records, scenes, speed, stability
from material_palette.core.material import SVBRDF


def surface(seed, colour=(0.4, 0.3, 0.2)):
    random = np.random.default_rng(seed)
    grain = np.kron(random.uniform(0.5, 1.5, (32, 32, 1)), np.ones((8, 8, 1))).astype(np.float32)
    normal = np.zeros((256, 256, 3), np.float32)
    normal[..., 2] = 1
    return SVBRDF((grain * colour).clip(0, 1).astype(np.float32), normal, np.full((256, 256), 0.5, np.float32))


def shown(shear=0.0):
    """A surface seen with 50 px a metre across and 100 px up."""
    v, u = np.mgrid[:100, :120].astype(np.float32)
    uv = np.stack([u / 50 + shear * v, v / 100], -1)
    return scenes.Shown(np.zeros((100, 120, 3), np.float32), {"part": np.ones((100, 120), bool)}, uv, 1.0)


@pytest.mark.parametrize("shear", [0.0, 0.02])
def test_scale_of_a_part_is_the_root_of_the_areas(shear):
    assert scenes.texels_per_metre(shown(shear), "part") == pytest.approx(np.sqrt(50 * 100), rel=1e-3)


def test_rectified_scale_follows_the_homography():
    """A rectified picture twice as large has twice the px per metre; under perspective, the median over the part."""
    assert scenes.texels_per_metre(shown(), "part", np.diag([0.5, 0.5, 1])) == pytest.approx(141.4, rel=1e-3)
    homography = np.array([[1, 0, 5], [0, 1, 3], [0, 1e-3, 1]])  # rectified px to photo px
    inverse = np.linalg.inv(homography)
    ends = [inverse @ [60 + dx, 50 + dy, 1] for dx, dy in ((0, 0), (0.1, 0), (0, 0.1))]
    ends = [e[:2] / e[2] for e in ends]
    local = np.abs(np.linalg.det([10 * (ends[1] - ends[0]), 10 * (ends[2] - ends[0])]))
    expected = np.sqrt(50 * 100 * local)
    assert scenes.texels_per_metre(shown(), "part", homography) == pytest.approx(expected, rel=0.03)


def test_the_material_itself_at_its_own_scale_is_nearer_than_at_another_or_another_material():
    truth = surface(0)
    right = endtoend.compare(truth, 2.0, endtoend.Found(truth, 128.0), 0)
    scaled = endtoend.compare(truth, 2.0, endtoend.Found(truth, 512.0), 0)
    other = endtoend.compare(truth, 2.0, endtoend.Found(surface(1, (0.1, 0.3, 0.5)), 128.0), 0)
    assert right["A"] < scaled["A"] and right["A"] < other["A"]
    assert right["colour"] == right["tilt"] == right["roughness"] == 0 < other["colour"]


def test_a_constant_is_compared_as_one_colour():
    flat = SVBRDF(np.array([0.4, 0.3, 0.2], np.float32), endtoend.FLAT, 0.7)
    row = endtoend.compare(surface(0), 2.0, endtoend.Found(flat, 1.0), 0)
    assert row["N"] == pytest.approx(0, abs=1e-6) and row["roughness"] == pytest.approx(0.2, abs=1e-6)
    assert row["colour"] < 2


def test_every_material_is_cast_once_in_a_pass():
    known = [endtoend.Known(str(i), "", None) for i in range(24)]
    names = [k.name for number in range(6) for k in endtoend.cast(known, number).values()]
    assert sorted(names) == sorted(k.name for k in known)


def test_finished_parts_are_not_made_again_and_none_begins_when_time_is_up(tmp_path):
    assert records.Parts(tmp_path / "first").get("one", lambda: [1]) == [1]
    late = records.Parts(tmp_path / "first", minutes=0)
    assert late.get("one", pytest.fail) == [1]
    assert late.get("two", pytest.fail) is None
    for other in (records.Parts(tmp_path / "second"), records.Parts(tmp_path / "first", quick=True)):
        assert other.get("one", lambda: [2]) == [2]


@pytest.mark.parametrize("family", stability.FAMILIES)
def test_the_first_severity_is_harmless_and_the_last_is_not(family):
    """Crop, colour or mask: the last severity loses much of what the first shows; chance is the seed's at both."""
    severities, maps, other = stability.FAMILIES[family][1], surface(2), surface(3, (0.1, 0.5, 0.7))
    first, worst = (stability.disturbed(family, s, maps, other, 5) for s in (severities[0], severities[-1]))
    again = stability.disturbed(family, severities[-1], maps, other, 5)
    np.testing.assert_array_equal(worst[0], again[0])
    assert first[1].all() and (first[0] < 1).mean() > 0.9
    changed = np.abs(first[0] - worst[0]).mean() > 0.01 or worst[1].mean() < 0.2 or worst[2] > first[2]
    assert changed and worst[1].any()


def test_brightness_is_no_error_but_structure_is():
    truth = surface(0).albedo
    target = stability.quantiles(truth)
    darker = stability.judged(truth * 0.5, truth, target)
    flat = stability.judged(truth.mean((0, 1)), truth, target)
    assert darker["error"] < 1 < flat["error"]
    assert darker["colour"] < 0.01


def test_silent_failures_are_those_without_a_warning():
    case = {"family": "noise", "severity": 0.1, "method": "ours", "refused": False}
    rows = [case | {"error": e, "warned": w} for e, w in ((1, False), (50, True), (50, False), (2, True))]
    (found,) = stability.summarise(rows, 10)
    assert found["silent"] == 0.25 and found["warned"] == 0.5 and found["worst"] == 50


def test_exponent_of_a_power():
    assert speed.exponent([256, 512, 1024, 2048], [1, 4, 16, 64]) == pytest.approx(2)


def test_the_engine_alone_is_timed_over_runs():
    found = speed.engine_alone("draft", 64, 2)
    assert found["runs"] == 2 and 0 < found["silence"] < found["wall_seconds"] * 2
    assert found["cpu_seconds"] > 0.05 and found["peak_mb"] > 50
