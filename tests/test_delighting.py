import cv2
import numpy as np
import pytest
from material_palette.core.delighting import find_light
from material_palette.core.exemplar import cut_exemplar
from material_palette.core.image import linear_from_srgb, srgb_from_linear
from textures import pebbles

SIDE = 360
SKY = np.array([0.30, 0.36, 0.45], np.float32)  # what is left of the light in a shadow: a third, bluish


def texture(seed=0):
    return linear_from_srgb(0.15 + 0.6 * pebbles(SIDE, SIDE, seed))


def half(softness=1.0, wave=10):
    """(H, W) share of the sun, 1 on the left."""
    v, u = np.mgrid[:SIDE, :SIDE].astype(np.float32)
    lit = (u < 0.5 * SIDE + wave * np.sin(v / 25)).astype(np.float32)
    return cv2.GaussianBlur(lit, (0, 0), softness)


def under(lit, shade=SKY):
    return (shade + (1 - shade) * lit[..., None]).astype(np.float32)


def photographed(pixels):
    return linear_from_srgb(np.rint(255 * srgb_from_linear(np.clip(pixels, 0, 1))) / 255)


def everywhere():
    return np.ones((SIDE, SIDE), bool)


def sides_differ(found, flat, lit, mask):
    """Largest change over the channels of found / flat from the lit side to the shaded one, 0 when they agree."""
    ratio = np.log(found / flat)
    return float(np.abs(np.median(ratio[mask & (lit > 0.9)], 0) - np.median(ratio[mask & (lit < 0.1)], 0)).max())


@pytest.mark.parametrize("softness", [1.0, 5.0])
def test_a_cast_shadow_is_balanced_in_every_channel(softness):
    flat, lit = texture(), half(softness)
    exemplar = cut_exemplar(photographed(flat * under(lit)), everywhere())
    assert sides_differ(flat * under(lit), flat, lit, everywhere()) > 1.0
    assert sides_differ(exemplar.pixels, flat, lit, exemplar.mask) < 0.06
    assert any("% of the region lies in a cast shadow" in warning for warning in exemplar.warnings)


def test_a_shadow_leaves_the_level_of_the_whole_region():
    flat, lit = texture(), half()
    photo = photographed(flat * under(lit))
    light = find_light(photo, everywhere())
    assert light.shaded > 0.3
    assert np.abs(np.log(light.shading).mean((0, 1))).max() < 0.02


def test_shadow_and_ramp_together_are_taken_out():
    flat, lit = texture(), half()
    ramp = np.linspace(1, 0.5, SIDE, dtype=np.float32)[:, None, None]
    exemplar = cut_exemplar(photographed(flat * under(lit) * ramp), everywhere())
    assert sides_differ(exemplar.pixels, flat, lit, exemplar.mask) < 0.1
    top_to_bottom = np.log(exemplar.pixels / flat).mean((1, 2))
    assert abs(top_to_bottom[:80].mean() - top_to_bottom[-80:].mean()) < 0.1


def test_the_texture_is_kept_beside_a_shadow():
    flat, lit = texture(), half()
    exemplar = cut_exemplar(photographed(flat * under(lit)), everywhere())

    def fine(pixels):
        y = np.log(pixels[..., 1])
        return (y - cv2.GaussianBlur(y, (0, 0), 6))[exemplar.mask].std()

    assert abs(fine(exemplar.pixels) / fine(flat) - 1) < 0.05


def test_the_unsure_border_of_a_shadow_is_left_out_and_little_else():
    lit = half()
    exemplar = cut_exemplar(photographed(texture() * under(lit)), everywhere())
    border = cv2.Canny((lit > 0.5).astype(np.uint8) * 255, 50, 100) > 0
    assert exemplar.mask[border].mean() < 0.02
    assert exemplar.mask.mean() > 0.95


def two_tone(kind):
    v, u = np.mgrid[:SIDE, :SIDE]
    grain = np.exp(0.3 * (pebbles(SIDE, SIDE)[..., :1] - 0.5))
    light, dark = np.array([0.5, 0.5, 0.5]), np.array([0.13, 0.13, 0.13])
    if kind == "chequers":
        first = (v // 40 + u // 40) % 2 == 0
    elif kind == "stain":
        first, light, dark = half() > 0.5, np.array([0.5, 0.45, 0.4]), np.array([0.32, 0.24, 0.16])
    elif kind == "dado":
        first, dark = half() > 0.5, np.array([0.12, 0.3, 0.2])
    else:
        row = v // 24
        first, light, dark = (v % 24 < 4) | ((u + 24 * (row % 2)) % 48 < 4), light, np.array([0.3, 0.12, 0.08])
    return (np.where(first[..., None], light, dark) * grain).astype(np.float32)


@pytest.mark.parametrize("kind", ["chequers", "stain", "dado", "bricks"])
def test_a_material_of_two_tones_is_not_taken_for_a_shadow(kind):
    light = find_light(photographed(two_tone(kind)), everywhere())
    assert light.shaded == 0 and not light.unsure.any()


def test_bricks_under_a_shadow_lose_the_shadow_and_keep_their_joints():
    flat, lit = two_tone("bricks"), half()
    exemplar = cut_exemplar(photographed(flat * under(lit)), everywhere())
    assert sides_differ(exemplar.pixels, flat, lit, exemplar.mask) < 0.08
    joints = flat[..., 2] > 0.3

    def contrast(pixels):
        x = np.log(pixels[..., 1])
        return x[exemplar.mask & joints].mean() - x[exemplar.mask & ~joints].mean()

    assert abs(contrast(exemplar.pixels) / contrast(flat) - 1) < 0.05


def uneven(seed):
    """A texture that is uneven at every scale, in brightness and in colour."""
    random = np.random.default_rng(seed)
    x = np.zeros((SIDE, SIDE, 3), np.float32)
    for sigma in (3, 6, 12, 24):
        noise = cv2.GaussianBlur(random.standard_normal(x.shape).astype(np.float32), (0, 0), sigma)
        x += 0.1 * noise / noise.std()
    return (0.2 * np.exp(x)).astype(np.float32)


def test_the_textures_own_unevenness_is_no_light():
    changes = [np.log(find_light(uneven(seed), everywhere()).shading).std() for seed in range(6)]
    assert np.median(changes) < 0.02  # a trend as it comes takes 0.05


def test_a_pool_of_light_is_taken_out_and_colour_that_wanders_is_kept():
    flat = texture()
    v, u = np.mgrid[-1 : 1 : SIDE * 1j, -1 : 1 : SIDE * 1j]
    pool = np.log1p(2 * np.exp(-((u - 0.2) ** 2 + (v + 0.1) ** 2) / 0.5))[..., None].astype(np.float32)
    found = np.log(find_light(flat * np.exp(pool), everywhere()).shading)
    left = found - pool
    assert (left - left.mean((0, 1))).std() < 0.3 * pool.std()
    assert np.ptp(found, axis=-1).max() < 0.02


def test_light_that_no_polynomial_follows_is_taken_out_where_no_texture_is_as_uneven():
    noise = np.random.default_rng(0).standard_normal((SIDE, SIDE)).astype(np.float32)
    light = cv2.GaussianBlur(noise, (0, 0), SIDE / 8)[..., None]
    light = 0.4 * (light - light.mean()) / light.std()
    found = np.log(find_light(0.5 * texture() ** 0.3 * np.exp(light), everywhere()).shading)
    assert (found - light).std() < 0.7 * light.std()  # the polynomial leaves 0.82
    assert np.ptp(found, axis=-1).max() < 0.01


def test_shading_times_exemplar_is_the_photo():
    photo = photographed(texture() * under(half()))
    exemplar = cut_exemplar(photo, everywhere())
    assert np.allclose(exemplar.pixels * exemplar.shading, photo, rtol=1e-5, atol=1e-7)
    assert exemplar.shading.min() > 0


def test_light_is_found_alike_whatever_lies_outside_and_every_time():
    mask = everywhere()
    mask[:40] = mask[:, -30:] = False
    photo = photographed(texture() * under(half()))
    other = np.where(mask[..., None], photo, np.float32([5, 0, 0]))
    assert np.allclose(find_light(photo, mask).shading[mask], find_light(other, mask).shading[mask], rtol=1e-3)
    assert np.array_equal(find_light(photo, mask).shading, find_light(photo, mask).shading)
