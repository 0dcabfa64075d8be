import numpy as np
from material_palette.core.material import SVBRDF
from material_palette.core.reduction import reduce
from textures import tileable_noise

FLAT = np.broadcast_to(np.array([0, 0, 1], np.float32), (32, 32, 3))


def material(albedo=None, normal=FLAT, roughness=None, height=None):
    albedo = np.repeat(tileable_noise(32, 32)[..., None], 3, -1) if albedo is None else albedo
    return SVBRDF(albedo, normal, 0.3 + 0.4 * tileable_noise(32, 32, 1) if roughness is None else roughness, height)


def test_maps_that_vary_are_kept():
    normal = FLAT.copy()
    normal[5, 5] = (0.1, 0, np.sqrt(1 - 0.01))
    full = material(normal=normal, height=np.zeros((32, 32), np.float32))
    reduced, lines = reduce(full)
    assert lines == []
    assert reduced.albedo is full.albedo and reduced.normal is normal and reduced.roughness is full.roughness


def test_maps_that_8_bits_show_as_constant_become_values():
    almost = 0.5 + (tileable_noise(32, 32) - 0.5) / 400
    albedo = np.full((32, 32, 3), 0.25, np.float32) + (tileable_noise(32, 32)[..., None] - 0.5) / 1000
    reduced, lines = reduce(material(albedo, roughness=almost, height=np.zeros((32, 32), np.float32)))
    assert reduced.albedo.shape == (3,) and np.allclose(reduced.albedo, 0.25, atol=1e-3)
    assert reduced.normal.tolist() == [0, 0, 1] and reduced.height is None
    assert abs(reduced.roughness - 0.5) < 2e-3
    assert len(lines) == 4


def test_a_tilt_of_the_whole_surface_is_no_flat_normal():
    tilted = np.broadcast_to(np.array([0.6, 0, 0.8], np.float32), (32, 32, 3))
    assert reduce(material(normal=tilted))[0].normal.shape == (32, 32, 3)


def test_one_pixel_that_shows_keeps_the_map():
    roughness = np.full((32, 32), 0.5, np.float32)
    roughness[3, 4] = 0.52
    assert np.ndim(reduce(material(roughness=roughness))[0].roughness) == 2
