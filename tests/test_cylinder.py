import numpy as np
import pytest
from material_palette.core import rectification
from material_palette.core.cylinder import Cylinder, find_cylinder, unroll
from material_palette.core.texture_gradient import local_spectra, spectra_scores
from textures import pebbles

SIDE = 384


def column(half_angle=75, lean=0.4):
    """A photo of a column of pebbles, its mask and the cylinder."""
    across = np.array([np.cos(lean), np.sin(lean)])
    centre = np.full(2, (SIDE - 1) / 2)
    half = 0.45 * SIDE
    truth = Cylinder(across, float(across @ centre), half / np.sin(np.radians(half_angle)))
    fine = 3
    u, v = np.meshgrid(*[(np.arange(SIDE * fine) + 0.5) / fine - 0.5] * 2)
    at = truth.unrolled(np.stack([u.ravel(), v.ravel()], -1))
    texture = pebbles(512, 512)
    column, row = np.rint(at).astype(int).T % 512
    photo = texture[row, column].reshape(SIDE, fine, SIDE, fine, 3).mean((1, 3))
    y, x = np.mgrid[:SIDE, :SIDE]
    return photo.astype(np.float32), np.abs(np.stack([x, y], -1) @ across - truth.middle) < half, truth


def test_rolled_is_the_inverse_of_unrolled_and_density_its_derivative():
    _, _, truth = column()
    points = truth.middle * truth.across + np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2)) * truth.radius
    assert np.allclose(truth.rolled(truth.unrolled(points)), points)
    step = 0.01 * truth.across
    longer = np.linalg.norm(truth.unrolled(points + step) - truth.unrolled(points - step), axis=1)
    assert np.allclose(0.02 / longer, truth.density(points), rtol=1e-3)


def test_a_column_is_found_and_unrolled():
    photo, mask, truth = column()
    found = rectification.rectify(photo, mask, rectification.look(photo))
    assert found.method == "cylinder" and found.homography is None
    assert abs(found.cylinder.across @ truth.across) > np.cos(np.radians(12))
    assert found.cylinder.radius == pytest.approx(truth.radius, rel=0.15)
    assert found.record()["cylinder"]["radius_px"] == pytest.approx(found.cylinder.radius, abs=0.01)


def test_what_is_compressed_towards_one_edge_only_is_no_column():
    photo, mask, truth = column()
    y, x = np.mgrid[:SIDE, :SIDE]
    mask &= np.stack([x, y], -1) @ truth.across > truth.middle - 5
    assert rectification.rectify(photo, mask, rectification.look(photo)).method != "cylinder"


def test_unrolled_the_texture_is_the_flat_one():
    photo, mask, truth = column()
    flat, within, to_surface = unroll(photo, mask, truth, 0.5, 1536)
    y, x = np.nonzero(within)
    at = np.stack([x, y], -1) @ to_surface[:, :2].T + to_surface[:, 2]
    texture = pebbles(512, 512)
    column_, row = np.rint(at).astype(int).T % 512
    assert np.corrcoef(flat[within][:, 1], texture[row, column_][:, 1])[0, 1] > 0.8
    # cubic interpolation must not overstep what the camera calls white
    assert unroll((photo > 0.4).astype(np.float32), mask, truth, 0.5, 1536)[0].max() == 1


def test_a_measure_across_a_column_follows_its_surface():
    photo, mask, truth = column()
    flat, within, to_surface = unroll(photo, mask, truth, 0.5, 1536)
    found = rectification.Rectification(flat, within, method="cylinder", cylinder=truth, to_surface=to_surface)
    middle = truth.middle * truth.across
    ends = np.array([middle, middle + truth.radius * np.sin(1.0) * truth.across])
    texel = to_surface[0, 0]  # px of the surface
    assert rectification.metres_per_texel(ends, 2.0, found) == pytest.approx(2.0 * texel / truth.radius)


@pytest.mark.parametrize("shape", [(640, 64), (64, 640)])
def test_windows_that_lie_in_one_line_are_round_about_no_axis_along_it(shape):
    spectra = local_spectra(np.log(pebbles(*shape)[..., 1] + 0.05), np.ones(shape, bool), 1000.0, (0, 0))
    with np.errstate(divide="raise", invalid="raise"):
        found, gain = find_cylinder(
            spectra, spectra_scores(spectra, np.broadcast_to(np.eye(2), (len(spectra.at), 2, 2)))
        )
    assert found is None and np.isfinite(gain)
