import numpy as np
import pytest
import torch
from material_palette.benchmarks import svbrdf
from material_palette.core.material import SVBRDF
from textures import tileable_noise


def material(name="polyhaven/test"):
    side = 64
    height = torch.from_numpy(tileable_noise(side, side).astype(np.float32)) * 0.1
    grey = 0.1 + 0.6 * tileable_noise(side, side, 1)
    albedo = torch.from_numpy(np.stack([grey, 0.8 * grey, 0.5 * grey], -1).astype(np.float32))
    roughness = torch.from_numpy((0.3 + 0.5 * tileable_noise(side, side, 2)).astype(np.float32))
    return svbrdf.Material(name, albedo, svbrdf.normal_from_height(height), roughness, torch.zeros(side, side))


def measured(truth, found):
    small = svbrdf.smaller(truth)
    expected = {"relit": svbrdf.relit(*small), "lab": svbrdf.cielab(small[0].numpy())}
    return svbrdf.measure(truth, found, expected, with_flip=False)


# pairs of Sharma, Wu, Dalal 2005, table 1, that reach every branch
@pytest.mark.parametrize(
    "first, second, difference",
    [
        ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425),
        ((50, 0, 0), (50, -1, 2), 2.3669),
        ((50, 2.49, -0.001), (50, -2.49, 0.0009), 7.1792),
        ((50, 2.49, -0.001), (50, -2.49, 0.0011), 7.2195),
        ((50, 2.5, 0), (73, 25, -18), 27.1492),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((6.7747, -0.2908, -2.4247), (5.8714, -0.0985, -2.2286), 0.6377),
        ((2.0776, 0.0795, -1.135), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_ciede2000_of_published_pairs(first, second, difference):
    assert svbrdf.ciede2000(np.array(first), np.array(second)) == pytest.approx(difference, abs=1e-4)


def test_the_truth_has_no_error_and_a_constant_has():
    m = material()
    perfect = measured(m, SVBRDF(*(x.numpy() for x in (m.albedo, m.normal, m.roughness))))
    assert perfect["A_mse"] == perfect["N_mse"] == perfect["R_mse"] == 0
    assert perfect["N_ssim"] == pytest.approx(1) and perfect["angle"] < 0.05 and perfect["relit_psnr"] > 80
    flat = measured(m, SVBRDF(m.albedo.mean((0, 1)).numpy(), svbrdf.FLAT, 0.5))
    assert flat["A_mse"] > 0.001 and flat["A_ssim"] < 0.9 and flat["angle"] > 3 and flat["delta_e"] > 3
    assert flat["relit_psnr"] < 30


def test_normals_of_guessed_strength_do_not_count():
    m = material("ambientcg-derived/test")
    row = measured(m, SVBRDF(np.full(3, 0.2), svbrdf.FLAT, 0.5))
    assert "A_mse" in row and not {"N_mse", "angle", "relit_psnr"} & set(row)


def test_the_input_tiles_and_has_a_known_exposure():
    m = material()
    pixels = svbrdf.photographed(m, 3)
    shifted = svbrdf.Material(m.name, *(x.roll((9, 20), (0, 1)) for x in (m.albedo, m.normal, m.roughness, m.metallic)))
    assert np.allclose(svbrdf.photographed(shifted, 3), np.roll(pixels, (9, 20), (0, 1)), atol=1e-5)
    white = svbrdf.Material(
        "x/y", torch.ones(8, 8, 3), torch.tensor(svbrdf.FLAT).expand(8, 8, 3), torch.ones(8, 8), torch.zeros(8, 8)
    )
    for seed in range(3):
        assert svbrdf.photographed(white, seed).mean() == pytest.approx(1, abs=0.06)


def test_delta_is_the_mean_gain_of_the_papers_table():
    """Of the table of Lopes et al. 2024: SurfaceNet with adaptation over source only, +5.18 %."""
    numbers = {
        "source": (0.083, 0.300, 0.475, 0.610, 0.304, 0.458),
        "adapted": (0.071, 0.298, 0.427, 0.626, 0.304, 0.472),
    }
    summary = {row: {k: {"mean": x} for k, x in zip(svbrdf.MAPS, found, strict=True)} for row, found in numbers.items()}
    assert svbrdf.delta(summary, "adapted", "source") == pytest.approx(5.18, abs=0.05)


def test_held_out_materials_are_all_of_polyhaven_and_every_fourth(tmp_path):
    for folder in [f"polyhaven/{n}" for n in "ab"] + [f"other/{n}" for n in "abcdefgh"]:
        (tmp_path / "pbr" / folder).mkdir(parents=True)
        for name in ("basecolor", "normal", "roughness"):
            (tmp_path / "pbr" / folder / f"{name}.jpg").touch()
    training, held_out = svbrdf.split(tmp_path)
    assert [f"{f.parent.name}/{f.name}" for f in held_out] == ["other/d", "other/h", "polyhaven/a", "polyhaven/b"]
    assert len(training) == 6
    with pytest.raises(SystemExit, match="no material"):
        svbrdf.split(tmp_path / "pbr")


def test_rows_that_were_measured_are_kept_under_the_same_conditions_only(tmp_path):
    (tmp_path / "svbrdf.json").write_text('{"size": 256}')
    (tmp_path / "svbrdf.csv").write_text("row,material,seed,A_mse,N_mse\nunet,a/b,101,0.5,\n")
    rows = svbrdf.read_results(tmp_path, {"size": 256})
    assert rows == [{"row": "unet", "material": "a/b", "seed": 101, "A_mse": 0.5, "N_mse": None}]
    with pytest.raises(SystemExit, match="other size"):
        svbrdf.read_results(tmp_path, {"size": 512})
    with pytest.raises(SystemExit, match="leave --keep out"):
        svbrdf.read_results(tmp_path / "nowhere", {"size": 256})
