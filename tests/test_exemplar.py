import cv2
import numpy as np
import pytest
from material_palette.core.errors import PaletteError
from material_palette.core.exemplar import RIM, _filled, card_colour, cut_exemplar, without_rim
from material_palette.core.image import linear_from_srgb, srgb_from_linear
from textures import pebbles


def full(pixels):
    return np.ones(pixels.shape[:2], bool)


def test_a_ramp_of_light_is_taken_out_and_the_texture_kept():
    flat = linear_from_srgb(0.2 + 0.6 * pebbles(200, 200))
    ramp = np.linspace(1.0, 0.3, 200, dtype=np.float32)[None, :, None]
    found = cut_exemplar(flat * ramp, full(flat)).pixels

    def halves(x):
        return x[:, :60].mean() / x[:, -60:].mean()

    assert halves(flat * ramp) > 1.8
    assert abs(halves(found) / halves(flat) - 1) < 0.15
    # contrast of the pebbles themselves, on the logarithm
    fine = [np.log(x[..., 1]) - cv2.GaussianBlur(np.log(x[..., 1]), (0, 0), 12) for x in (flat, found)]
    assert abs(fine[1].std() / fine[0].std() - 1) < 0.05


def test_what_lies_outside_the_region_does_not_change_the_result():
    pixels = linear_from_srgb(0.2 + 0.6 * pebbles(120, 160))
    mask = np.zeros((120, 160), bool)
    mask[20:100, 30:130] = True
    cv2.circle(mask.view(np.uint8), (80, 60), 20, 0, -1)
    other = pixels.copy()
    other[~mask] = (5.0, 0.0, 0.0)
    one, two = cut_exemplar(pixels, mask), cut_exemplar(other, mask)
    assert one.pixels.shape == (80, 100, 3)
    assert np.allclose(one.pixels[one.mask], two.pixels[two.mask], rtol=1e-4)


def test_a_part_of_a_surface_gets_the_level_of_all_of_it():
    pixels = linear_from_srgb(0.1 + 0.4 * pebbles(120, 120))
    plain, brighter = (cut_exemplar(pixels, full(pixels), level=level) for level in (1.0, 1.5))
    assert np.allclose(brighter.pixels, 1.5 * plain.pixels, rtol=1e-4)
    assert np.allclose(brighter.pixels * brighter.shading, pixels, rtol=1e-4)
    # no surface is brighter than white, and a grey card knows better
    assert np.quantile(cut_exemplar(pixels, full(pixels), level=50.0).pixels.max(-1), 0.99) <= 1.001
    card = np.float32([0.2, 0.2, 0.2])
    beside = [cut_exemplar(pixels, full(pixels), white_balance=card, level=level).pixels for level in (1.0, 1.5)]
    assert np.array_equal(*beside)


def test_black_joints_leave_the_level_as_it_is():
    pixels = linear_from_srgb(0.3 + 0.4 * pebbles(200, 200)).astype(np.float32)
    jointed = pixels.copy()
    jointed[::20] = jointed[1::20] = 0
    exemplar = cut_exemplar(jointed, full(jointed))
    stones = exemplar.mask & (jointed > 0).all(-1)
    lighter = np.log(exemplar.pixels[stones]).mean() - np.log(jointed[stones]).mean()
    assert abs(lighter) < 0.05


def test_the_rim_of_a_region_is_left_out_where_it_costs_little():
    photo = np.zeros((300, 400), bool)
    photo[:, 100:] = True
    # the photo's edge is no border
    assert np.array_equal(np.argwhere(photo & ~without_rim(photo))[:, 1], np.tile(100 + np.arange(RIM), 300))
    thin = np.repeat(np.arange(300)[:, None] % 20 < 8, 400, 1)
    small = np.zeros((300, 400), bool)
    small[100:130, 100:130] = True
    for mask in (thin, small, np.ones((300, 400), bool)):
        assert np.array_equal(without_rim(mask), mask)


def test_white_that_is_left_out_counts_for_the_level():
    pixels = linear_from_srgb(0.3 + 0.4 * pebbles(200, 200)).astype(np.float32)
    burnt = pixels.copy()
    burnt[:, 120:] = 1.0
    plain, found = (cut_exemplar(x, full(x), flatten=True) for x in (pixels[:, :120].copy(), burnt))
    assert any("over-exposed" in warning for warning in found.warnings)
    levels = [np.log(x.pixels[x.mask]).mean() for x in (plain, found)]
    # two fifths are white, of which no more is known
    assert levels[1] - levels[0] == pytest.approx(-0.4 * np.log(pixels).mean(), abs=0.1)


def test_without_flattening_the_photo_is_kept():
    pixels = linear_from_srgb(pebbles(80, 80))
    exemplar = cut_exemplar(pixels, full(pixels), flatten=False, level=2.0)
    assert np.array_equal(exemplar.pixels, pixels)


@pytest.mark.parametrize("stops", [0, 4])
@pytest.mark.parametrize("noise", [0.0, 4.0])
def test_a_wall_of_one_colour_under_uneven_light_and_noise_is_uniform(noise, stops):
    random = np.random.default_rng(1)
    colour = np.array([0.42, 0.2, 0.1], np.float32)
    light = np.linspace(0.8, 1.25, 150, dtype=np.float32)[:, None, None]
    encoded = np.clip(np.broadcast_to(colour * light / 2**stops, (150, 150, 3)), 0, 1) ** (1 / 2.2)
    noisy = np.rint(255 * encoded + noise * random.standard_normal(encoded.shape)) / 255
    uniform = cut_exemplar(linear_from_srgb(noisy), full(noisy)).uniform
    assert uniform is not None
    assert np.allclose(uniform, linear_from_srgb((colour / 2**stops) ** (1 / 2.2)), rtol=0.08, atol=1e-3)


@pytest.mark.parametrize("contrast", [0.06, 1.0])
def test_a_texture_is_not_uniform(contrast):
    pixels = linear_from_srgb(0.4 + contrast * (pebbles(150, 150) - 0.4))
    assert cut_exemplar(pixels, full(pixels)).uniform is None


def test_a_texture_in_a_dark_photo_is_not_uniform():
    pixels = linear_from_srgb(0.4 + 0.06 * (pebbles(150, 150) - 0.4)) / 2**3
    dark = linear_from_srgb(np.rint(srgb_from_linear(pixels) * 255) / np.float32(255))
    assert cut_exemplar(dark, full(dark)).uniform is None


def test_over_exposed_pixels_are_left_out_and_said():
    pixels = linear_from_srgb(0.2 + 0.6 * pebbles(100, 100))
    pixels[:20] = 1.0
    exemplar = cut_exemplar(pixels, full(pixels))
    assert not exemplar.mask[:20].any() and exemplar.mask[22:].all()
    assert any("20% of the region is over-exposed and left out" in warning for warning in exemplar.warnings)
    assert np.allclose(exemplar.uniform or 0, 0)


def test_one_clipped_channel_is_over_exposed_and_a_bright_photo_in_floats_is_not():
    pixels = linear_from_srgb(0.2 + 0.6 * pebbles(100, 100))
    pixels[:20, :, 0] = 1.0
    assert not cut_exemplar(pixels, full(pixels)).mask[:20].any()
    bright = 6 * linear_from_srgb(0.2 + 0.6 * pebbles(100, 100))
    assert cut_exemplar(bright, full(bright)).mask.mean() > 0.98


def test_what_is_cut_of_a_photo_in_floats_is_said():
    pixels = np.clip(linear_from_srgb(pebbles(200, 200)), 0.05, 0.97)
    words = "of the region is brighter than 1 and cut there"
    assert not any(words in warning for warning in cut_exemplar(pixels, full(pixels)).warnings)
    warnings = cut_exemplar(10 * pixels, full(pixels), flatten=False).warnings
    (said,) = (warning for warning in warnings if words in warning)
    assert said.startswith(f"{(10 * pixels > 1).any(-1).mean():.0%} ")


def test_specks_of_plain_white_and_of_glare_are_filled_and_a_bright_surface_kept():
    bright = linear_from_srgb(0.7 + 0.15 * pebbles(120, 120))
    photo = bright.copy()
    photo[20:100:10, 20:60:4] = 1.0
    photo[20:100:10, 70:110:4, 0] = 1.0
    found = cut_exemplar(photo, full(photo), flatten=False).pixels
    assert found[20:100:10, 20:60:4].max() < 0.9
    assert np.array_equal(found[:, 65:], photo[:, 65:])
    photo[:, 65:] *= 0.3
    photo[20:100:10, 70:110:4, 0] = 1.0
    assert cut_exemplar(photo, full(photo), flatten=False).pixels[:, 65:].max() < 0.5


def test_where_specks_lie_close_together_nothing_is_made_up():
    """Tiles of 4 px that the camera saw as white: filled from their joints the surface would be dark there."""
    photo = linear_from_srgb(0.3 + 0.1 * pebbles(120, 120))
    for row in range(0, 120, 6):
        for column in range(0, 120, 6):
            photo[row : row + 4, column : column + 4] = 1.0 if column < 48 else 0.6
    exemplar = cut_exemplar(photo, full(photo), flatten=False)
    assert not exemplar.mask[:, 8:40].any() and exemplar.mask[:, 60:].all()
    assert exemplar.warnings == ["39% of the region is lost in over-exposed specks and left out"]
    assert exemplar.pixels[:, 60:].max() == pytest.approx(0.6)


def test_white_lines_are_paint_and_no_glare():
    photo = linear_from_srgb(0.2 + 0.3 * pebbles(160, 160))
    for x in range(160):
        photo[60 + x // 4 : 63 + x // 4, x] = 1.0 if x % 9 else 0.9  # the camera did not clip all of it
    photo[20:50:10, 20:140:8] = 1.0
    found = cut_exemplar(photo, full(photo), flatten=False).pixels
    assert np.array_equal(found[55:], photo[55:])
    assert found[20:50:10, 20:140:8].max() < 0.5


def test_specks_far_from_all_others_are_filled_too():
    pixels = linear_from_srgb(0.2 + 0.6 * pebbles(120, 120))
    lost = np.zeros((120, 120), bool)
    lost[30:90, 30:90] = True
    found = _filled(np.where(lost[..., None], 1.0, pixels), full(pixels), lost)
    assert found[lost].min() > pixels.min() and found[lost].max() < pixels.max()
    assert np.array_equal(found[~lost], pixels[~lost])
    assert np.array_equal(_filled(pixels, lost, lost), pixels)  # there are no others


def test_a_black_area_is_left_out_and_a_black_joint_kept():
    pixels = linear_from_srgb(0.2 + 0.6 * pebbles(120, 120))
    pixels[:30] = 0
    pixels[60:64] = 0
    exemplar = cut_exemplar(pixels, full(pixels))
    assert not exemplar.mask[:29].any() and exemplar.mask[60:64].all()
    assert any("under-exposed and left out" in warning for warning in exemplar.warnings)


def test_a_region_that_is_over_exposed_almost_everywhere_is_kept_and_said():
    pixels = np.ones((100, 100, 3), np.float32)
    pixels[:8] = linear_from_srgb(0.2 + 0.6 * pebbles(8, 100))
    exemplar = cut_exemplar(pixels, full(pixels))
    assert exemplar.mask.all()
    assert any("92% of the region is over-exposed; too little" in warning for warning in exemplar.warnings)


def test_of_a_huge_region_the_fullest_part_is_cut_and_said():
    mask = np.zeros((1700, 3200), bool)
    mask[:, ::50] = True
    mask[100:1690, 1600:3150] = True
    exemplar = cut_exemplar(np.full((1700, 3200, 3), 0.4, np.float32), mask)
    assert exemplar.mask.shape == (1536, 1536) and exemplar.mask.all()
    assert any("3151 x 1700" in warning for warning in exemplar.warnings)


def test_white_balance_makes_the_regions_mean_grey_and_nothing_else():
    grey = linear_from_srgb(0.2 + 0.5 * pebbles(160, 160)).mean(-1, keepdims=True)
    tungsten = np.float32([1.25, 1.0, 0.55])
    photo = (grey * tungsten).astype(np.float32)
    off, region = (cut_exemplar(photo, full(photo), white_balance=mode) for mode in ("off", "region"))
    assert np.ptp(off.pixels[off.mask].mean(0)) > 0.05
    assert np.ptp(region.pixels[region.mask].mean(0)) < 0.002
    assert np.allclose(region.pixels * region.shading, photo, rtol=1e-4)


def test_a_grey_card_tells_brightness_and_colour_of_the_light():
    albedo = linear_from_srgb(0.2 + 0.3 * pebbles(160, 160)).astype(np.float32)
    light = np.float32([1.9, 1.4, 0.8])
    scene = np.concatenate([albedo, np.full((40, 160, 3), 0.18, np.float32)]) * light
    card = card_colour(scene, np.array([8, 164]), np.array([150, 196]))
    mask = np.zeros(scene.shape[:2], bool)
    mask[:160] = True
    found = cut_exemplar(scene, mask, white_balance=np.float32(card))
    assert np.allclose(found.pixels[found.mask].mean(0), albedo[found.mask[:160]].mean(0), rtol=0.03)
    assert not found.warnings
    darker = cut_exemplar(scene, mask, white_balance=np.float32(card) / 10)
    assert any("brighter than white beside the grey card" in warning for warning in darker.warnings)


@pytest.mark.parametrize(
    "corners, words",
    [
        (((0, 0), (0, 40)), "no rectangle"),
        (((100, 100), (300, 140)), "no rectangle inside the photo's 160 x 200 px"),
        (((0, 160), (50, 200)), "over-exposed"),
        (((50, 160), (100, 200)), "too dark"),
        (((0, 0), (160, 160)), "more than an evenly lit card"),
    ],
)
def test_what_tells_no_light_is_no_grey_card(corners, words):
    photo = np.concatenate([linear_from_srgb(0.1 + 0.7 * pebbles(160, 160)), np.full((40, 160, 3), 0.001)])
    photo[160:, :50] = 1.0
    with pytest.raises(PaletteError, match=words):
        card_colour(photo.astype(np.float32), *np.array(corners))


def test_a_blurred_region_and_a_dark_one_are_said():
    random = np.random.default_rng(0)
    stones = random.random((20, 20, 3)).astype(np.float32).repeat(8, 0).repeat(8, 1)
    sharp = linear_from_srgb(0.3 + 0.5 * stones)
    soft = cv2.GaussianBlur(sharp, (0, 0), 4.0)
    mask = np.zeros((160, 160), bool)
    mask[:, 20:150] = True
    assert not cut_exemplar(sharp, mask).warnings
    assert any("out of focus" in warning for warning in cut_exemplar(soft, mask).warnings)
    assert any("very dark" in warning for warning in cut_exemplar(sharp / 100, mask).warnings)
