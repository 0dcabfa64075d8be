import numpy as np
import pytest
import torch
from material_palette.core import reduction
from material_palette.core.errors import Cancelled
from material_palette.core.material import SVBRDF
from material_palette.core.reduction import reduce, shrink
from material_palette.core.torus import normal_from_height, wrap_ratio
from textures import tileable_noise

N = 128
FLAT = np.broadcast_to(np.array([0, 0, 1], np.float32), (N, N, 3))
GREY = np.full((N, N, 3), 0.25, np.float32)


def fine(seed=0):
    """Detail of a texel's size, in [0, 1]."""
    return np.random.default_rng(seed).random((N, N), np.float32)


def relief(height):
    return normal_from_height(torch.from_numpy(height)).numpy()


def changes(found):
    return {entry["map"]: entry["change"] for entry in found.ledger}


def test_maps_that_no_picture_shows_become_values():
    almost = 0.5 + (fine() - 0.5) / 400
    found = reduce(SVBRDF(GREY + (fine(1)[..., None] - 0.5) / 1000, FLAT, almost, np.zeros((N, N), np.float32)))
    assert found.svbrdf.albedo.shape == (3,) and np.allclose(found.svbrdf.albedo, 0.25, atol=1e-3)
    assert found.svbrdf.normal.tolist() == [0, 0, 1] and found.svbrdf.height is None
    assert abs(found.svbrdf.roughness - 0.5) < 2e-3
    assert sum(entry["bytes"] for entry in found.ledger) == 9 * N * N


@pytest.mark.parametrize("pixels", [None, 2 * N])
def test_fine_relief_in_a_close_up_is_kept(pixels):
    height = (fine() - 0.5) * 0.4 / N
    found = reduce(SVBRDF(GREY, relief(height), 0.5, height), pixels=pixels)
    assert found.svbrdf.normal.shape == (N, N, 3) and found.svbrdf.height.shape == (N, N)


def test_fine_colour_is_kept():
    albedo = np.repeat(0.1 + 0.6 * fine()[..., None], 3, -1)
    assert reduce(SVBRDF(albedo, FLAT, 0.5)).svbrdf.albedo.shape == albedo.shape


def test_a_dark_material_keeps_its_detail_in_a_close_up():
    albedo = 0.004 + 0.02 * np.repeat(fine()[..., None], 3, -1)
    assert reduce(SVBRDF(albedo, FLAT, 0.5)).svbrdf.albedo.shape == albedo.shape


@pytest.mark.parametrize("pixels", [None, 2 * N, N // 2])
def test_glossy_variation_of_the_roughness_is_kept(pixels):
    roughness = np.where(tileable_noise(N, N) > 0.5, 0.15, 0.6).astype(np.float32)
    found = reduce(SVBRDF(GREY, FLAT, roughness), pixels=pixels)
    assert np.ndim(found.svbrdf.roughness) == 2
    small = found.svbrdf.roughness
    assert small.max() - small.min() > 0.4


def test_one_glossy_spot_is_kept():
    roughness = np.full((N, N), 0.7, np.float32)
    roughness[40:64, 70:94] = 0.1
    assert np.ndim(reduce(SVBRDF(GREY, FLAT, roughness)).svbrdf.roughness) == 2


@pytest.mark.parametrize("side", (250, 1000))
def test_every_part_of_a_tile_is_looked_at(side):
    y, x = np.mgrid[:side, :side]
    beyond = (y >= side // 128 * 128 + 8) | (x >= side // 128 * 128 + 8)
    chequered = np.where((y // 8 + x // 8) % 2 == 0, 0.02, 0.58)
    albedo = np.repeat(np.where(beyond, chequered, 0.3)[..., None], 3, 2).astype(np.float32)
    found = reduce(SVBRDF(albedo, np.array([0, 0, 1], np.float32), 0.6), parts=1).svbrdf
    assert np.ndim(found.albedo) == 3


def test_a_tilt_of_the_whole_surface_is_no_flat_normal():
    tilted = np.broadcast_to(np.array([0.6, 0, 0.8], np.float32), (N, N, 3))
    assert reduce(SVBRDF(GREY, tilted, 0.5)).svbrdf.normal.shape[2:] == (3,)


def test_what_is_smooth_gets_fewer_texels_and_still_tiles():
    x = np.arange(N) * 2 * np.pi / N
    wave = (0.3 + 0.2 * np.sin(x)[:, None] * np.cos(x)).astype(np.float32)
    found = reduce(SVBRDF(np.repeat(wave[..., None], 3, -1), FLAT, 0.5))
    assert 16 <= found.svbrdf.albedo.shape[0] <= N // 2
    assert wrap_ratio(found.svbrdf.albedo) < 1.6
    assert np.allclose(found.svbrdf.albedo.mean(), 0.3, atol=0.01)
    assert all(entry["flip"] <= reduction.VISIBLE for entry in found.ledger)


def test_from_afar_there_are_fewer_texels_and_none_are_lost_in_a_close_up():
    colour = 0.1 + 0.6 * tileable_noise(N, N)[..., None] + 0.2 * fine()[..., None]
    full = SVBRDF(np.repeat(colour, 3, -1).astype(np.float32), FLAT, 0.5)
    sides = [reduction.largest(reduce(full, pixels=pixels).svbrdf) for pixels in (24, 2 * N)]
    assert sides[0] < N == sides[1]
    # means of the full map, not picked texels
    assert np.allclose(reduce(full, pixels=16).svbrdf.albedo.mean((0, 1)), full.albedo.mean((0, 1)), atol=0.01)


def test_relief_too_far_away_to_be_seen_dulls_the_surface():
    height = (fine() - 0.5) * 0.4 / N
    found = reduce(SVBRDF(GREY, relief(height), 0.2, height), pixels=16).svbrdf
    assert reduction.largest(found) < N and np.mean(found.roughness) > 0.3


def test_a_weave_keeps_one_period():
    weave = np.tile(np.repeat(0.1 + 0.6 * fine()[:32, :32, None], 3, -1), (4, 4, 1))
    height = np.tile((fine(1)[:32, :32] - 0.5) * 0.2 / N, (4, 4))
    found = reduce(SVBRDF(weave, relief(height), 0.5, height))
    assert found.parts == 4 and changes(found)["tile"] == "1/4 along each side"
    assert np.allclose(found.svbrdf.albedo, weave[:32, :32], atol=0.01)
    # the height is in widths of the tile, which has become narrower
    assert np.allclose(found.svbrdf.height, 4 * height[:32, :32], atol=1e-5)


def test_what_never_repeats_keeps_its_tile():
    assert reduce(SVBRDF(np.repeat(fine()[..., None], 3, -1), FLAT, 0.5)).parts == 1


def test_fewer_texels_keep_the_place_and_contrast_of_what_they_can_hold():
    x = (np.arange(N) + 0.5) * 2 * np.pi / N
    wave = (0.5 + 0.3 * np.sin(9 * x)[:, None] * np.cos(5 * x)).astype(np.float32)
    errors = [
        np.abs(reduction._texels(small, (0, 0), N, N) - wave).mean()
        for small in (reduction._shrunk(wave, 48), reduction._means(wave, 48))
    ]
    assert errors[0] < 0.5 * errors[1] and errors[0] < 0.03


def test_relief_that_is_averaged_away_leaves_a_duller_surface():
    height = (fine() - 0.5) * 0.4 / N
    small = shrink(SVBRDF(GREY, relief(height), 0.2, height), 16)
    assert small.normal.shape == (16, 16, 3) and np.mean(small.roughness) > 0.3
    assert np.mean(shrink(SVBRDF(GREY, FLAT, 0.2), 16).roughness) == pytest.approx(0.2)


def test_it_is_deterministic_and_can_be_cancelled():
    full = SVBRDF(np.repeat(fine()[..., None], 3, -1), FLAT, fine(1))
    first, second = reduce(full), reduce(full)
    assert first.ledger == second.ledger and np.array_equal(first.svbrdf.albedo, second.svbrdf.albedo)

    def stop(fraction, message):
        if fraction > 0.3:
            raise Cancelled

    with pytest.raises(Cancelled):
        reduce(full, stop)
