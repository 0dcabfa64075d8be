import cv2
import numpy as np
import pytest
from material_palette.benchmarks import baselines, measures, records
from material_palette.core.torus import WRAP_GATE, wrap_ratio
from textures import pebbles, tileable_noise

SIDE = 128
FULL = np.ones((SIDE, SIDE), bool)


def distance(texture, exemplar, mask=None):
    return measures.sliced_wasserstein(
        measures.patch_quantiles(texture), measures.patch_quantiles(exemplar, FULL if mask is None else mask)
    )


def colourful(grey):
    return np.repeat(grey[..., None], 3, 2)


def ramp():
    """Pebbles whose own border is a step."""
    return np.clip(pebbles(SIDE, SIDE) * 0.6 + np.linspace(0, 0.4, SIDE, dtype=np.float32)[:, None, None], 0, 1)


def test_patch_distance_is_small_to_itself_and_grows_with_blur():
    exemplar = colourful(tileable_noise(SIDE, SIDE))
    itself = distance(exemplar, exemplar)
    blurred = [distance(cv2.GaussianBlur(exemplar, (0, 0), s), exemplar) for s in (1, 2, 4)]
    # not 0: of the exemplar, which is no torus, the patches across its border are left out
    assert itself < 0.3 * blurred[0]
    assert blurred == sorted(blurred)


def test_patch_distance_does_not_see_where_a_patch_is():
    exemplar = colourful(tileable_noise(SIDE, SIDE))
    assert distance(np.roll(exemplar, (31, 57), (0, 1)), exemplar) == pytest.approx(
        distance(exemplar, exemplar), abs=1e-3
    )


def test_patch_distance_is_that_of_sorted_samples():
    # of two constants every projection differs by the difference times the direction's sum
    first, second = (np.full((SIDE, SIDE, 3), v, np.float32) for v in (0.3, 0.5))
    direction = measures.patch_quantiles(np.ones((SIDE, SIDE, 3), np.float32))[0][:, 0]
    assert distance(first, second) == pytest.approx(0.2 * np.abs(direction).mean(), rel=1e-3)


def test_nothing_outside_the_region_is_measured():
    exemplar, mask = pebbles(SIDE, SIDE), FULL.copy()
    mask[:, 80:] = False
    spoilt = np.where(mask[..., None], exemplar, 1).astype(np.float32)
    texture = pebbles(SIDE, SIDE, seed=1)
    assert distance(texture, spoilt, mask) == distance(texture, exemplar, mask)
    assert measures.repetition(spoilt, mask) == pytest.approx(measures.repetition(exemplar, mask))


def test_repetition_of_repeated_patches_and_of_noise():
    noise = np.random.default_rng(0).random((SIDE, SIDE, 3), np.float32)
    repeated = np.tile(noise[:32, :32], (4, 4, 1))
    assert measures.repetition(repeated) > 0.99
    assert measures.repetition(repeated, FULL) > 0.99
    assert measures.repetition(noise) < 0.1
    assert measures.repetition(noise, FULL) < 0.1


def test_frechet_distance_against_the_closed_form_of_diagonal_covariances():
    a, b = np.array([1.0, 4.0, 9.0]), np.array([4.0, 4.0, 1.0])
    means = np.array([0.0, 1.0, 2.0]), np.array([1.0, 1.0, 0.0])
    expected = 5 + ((np.sqrt(a) - np.sqrt(b)) ** 2).sum()
    assert measures.frechet((means[0], np.diag(a)), (means[1], np.diag(b))) == pytest.approx(expected)


def test_verbatim_share():
    grid = np.stack(np.mgrid[:40, :40], -1)
    # on the torus the last row and the last column do not continue
    assert measures.copied_share(grid) == pytest.approx((39 / 40) ** 2)
    assert measures.copied_share(np.random.default_rng(0).integers(0, 40, (40, 40, 2))) < 0.01


def test_pareto_front_is_what_nothing_beats():
    points = {"slow": (3, 1), "fast": (1, 3), "middle": (2, 2), "worse": (2.5, 2.5), "equal": (3, 2)}
    assert measures.pareto(points) == ["fast", "middle", "slow"]


@pytest.mark.parametrize("engine", ["quilting", "offset-poisson", "cross-fade"])
def test_baselines_tile_where_the_exemplar_does_not(engine):
    assert wrap_ratio(ramp()) > WRAP_GATE
    texture, _ = baselines.ENGINES[engine](ramp(), FULL, SIDE, 0)
    assert wrap_ratio(texture) <= WRAP_GATE


def test_quilting_takes_its_pixels_from_the_region():
    exemplar, mask = pebbles(SIDE, SIDE), FULL.copy()
    mask[:50, :50] = False
    texture, coordinates = baselines.quilting(exemplar, mask, SIDE, 0)
    rows, columns = coordinates[..., 0], coordinates[..., 1]
    assert mask[rows, columns].all()
    assert np.array_equal(texture, exemplar[rows, columns])


def test_the_largest_square_lies_in_the_region():
    mask = np.zeros((90, 120), bool)
    mask[20:61, 30:110] = True
    rows, columns = baselines.largest_square(mask)
    assert mask[rows, columns].all()
    assert rows.stop - rows.start == columns.stop - columns.start == 41


def test_gpnn_gives_the_exemplars_patches_back_and_tiles():
    exemplar = ramp()[:48, :48]
    texture, _ = baselines.gpnn_exact(exemplar, FULL[:48, :48], 48, 0)
    assert wrap_ratio(texture) <= WRAP_GATE
    assert np.abs(texture.mean((0, 1)) - exemplar.mean((0, 1))).max() < 0.1
    noise = np.random.default_rng(0).random(texture.shape, np.float32)
    full = np.ones((48, 48), bool)
    assert distance(texture, exemplar, full) < 0.3 * distance(noise, exemplar, full)


def test_exact_search_is_the_normalised_nearest():
    import torch

    generator = torch.Generator().manual_seed(0)
    keys, queries = torch.rand(300, 12, generator=generator), torch.rand(700, 12, generator=generator)
    d = torch.cdist(queries.double(), keys.double()).square()
    expected = (d / (baselines.ALPHA + d.min(0).values)).argmin(1)
    assert (baselines._nearest_normalised(keys)(queries) == expected).float().mean() > 0.99


def test_the_command_that_is_kept_names_no_folder_of_the_machine(monkeypatch):
    monkeypatch.setattr(
        "sys.argv", ["/here/svbrdf.py", "--data", "/there/data", "--rows", "a:b c=/there/x.bin", "unet"]
    )
    assert records.command() == "svbrdf.py --data data --rows 'a:b c=x.bin' unet"
