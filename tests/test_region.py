"""Masks become regions by their files' names; what can't hold a texture or would clash on some system is refused."""

import cv2
import numpy as np
import pytest
from material_palette.core.errors import PaletteError
from material_palette.core.region import (
    LEAST_AREA,
    LEAST_RADIUS,
    Region,
    add_geometry,
    check_names,
    check_region,
    file_name,
    read_regions,
)

SHAPE = (48, 64)


def paint(folder, *names, mask=None):
    folder.mkdir(exist_ok=True)
    for name in names:
        pixels = np.zeros(SHAPE, np.uint8) if mask is None else mask * np.uint8(255)
        cv2.imwrite(str(folder / "painted.png"), pixels)
        if name.endswith(".jpg"):
            cv2.imwrite(str(folder / name), pixels)
            (folder / "painted.png").unlink()
        else:
            (folder / "painted.png").rename(folder / name)
    return folder


def test_regions_are_named_by_their_files_and_sorted(tmp_path):
    mask = np.zeros(SHAPE, bool)
    mask[5:40, 9:50] = True
    folder = paint(tmp_path / "masks", "wall.png", "Path.PNG", "été 2.v1.png", mask=mask)
    regions = read_regions(folder, SHAPE)
    assert [region.name for region in regions] == ["Path", "wall", "été 2.v1"]
    assert all((region.mask == mask).all() for region in regions)


def test_masks_of_a_reduced_photo_are_resized(tmp_path):
    mask = np.zeros(SHAPE, bool)
    mask[:, 32:] = True
    (region,) = read_regions(paint(tmp_path, "a.png", mask=mask), (24, 32))
    assert region.mask.shape == (24, 32) and region.mask[:, 16:].all() and not region.mask[:, :16].any()


def test_files_that_are_no_masks_are_passed_over(tmp_path):
    folder = paint(tmp_path, "a.png", "._a.png", ".hidden.png")
    for name in ("Thumbs.db", ".DS_Store", "README.txt", "notes"):
        (folder / name).write_text("x")
    (folder / "old.png").mkdir()
    assert [region.name for region in read_regions(folder, SHAPE)] == ["a"]


@pytest.mark.parametrize("make, words", [
    (lambda f: f / "none", "none' doesn't exist"),
    (lambda f: paint(f, "a.png") / "a.png", "a.png' is a file"),
    (lambda f: f, "holds no mask image"),
])  # fmt: skip
def test_a_folder_without_masks_is_refused(tmp_path, make, words):
    with pytest.raises(PaletteError, match=words):
        read_regions(make(tmp_path), SHAPE)


def test_an_image_that_does_not_read_is_named(tmp_path):
    paint(tmp_path, "a.png")
    (tmp_path / "b.png").write_text("not an image")
    with pytest.raises(PaletteError, match="Mask '.*b.png'"):
        read_regions(tmp_path, SHAPE)


def test_a_mask_of_another_shape_is_named(tmp_path):
    paint(tmp_path, "a.png")
    with pytest.raises(PaletteError, match="a.png' is 64 x 48 px, of another shape"):
        read_regions(tmp_path, (48, 48))


@pytest.mark.parametrize(
    "one, two", [("a.png", "a.jpg"), ("Stone.png", "stone.png"), ("é.png", "e\u0301.png"), ("a?.png", "a*.png")]
)
def test_two_masks_of_one_name_are_refused(tmp_path, one, two):
    try:
        paint(tmp_path, one, two)
    except OSError:
        pytest.skip("this filesystem has no such names")
    if len(list(tmp_path.iterdir())) < 2:
        pytest.skip("this filesystem takes the two names for one")
    with pytest.raises(PaletteError, match="would name one material") as error:
        read_regions(tmp_path, SHAPE)
    assert one in str(error.value) and two in str(error.value)


def test_a_name_that_blender_would_cut_is_refused():
    whole = np.ones((64, 64), bool)
    check_names([Region("é" * 31, whole)])
    with pytest.raises(PaletteError, match="64 bytes"):
        check_names([Region("é" * 32, whole)])


def test_corners_off_the_photo_are_refused():
    region = Region("floor", np.ones(SHAPE, bool))
    reaching = np.float64([[-9, -9], [90, -9], [90, 60], [-9, 60]])
    add_geometry([region], {"floor": 2 * reaching}, {}, 0.5)
    assert np.array_equal(region.corners, reaching)
    for away in (reaching + (0, 100), reaching - (100, 0)):
        with pytest.raises(PaletteError, match="corners of 'floor' lie outside of the photo, 128 x 96 px"):
            add_geometry([region], {"floor": 2 * away}, {}, 0.5)


def block(height, width):
    mask = np.zeros((200, 300), bool)
    mask[20 : 20 + height, 30 : 30 + width] = True
    return Region("moss", mask)


def test_least_region_passes_and_smaller_ones_say_how_small():
    side = int(LEAST_AREA**0.5)
    check_region(block(side, side))
    check_region(block(2 * LEAST_RADIUS, 200))
    for small, size in ((block(side, side - 1), "552 px"), (block(2 * LEAST_RADIUS - 2, 250), "4 px across")):
        with pytest.raises(PaletteError, match=f"'moss' is too small.*{size}.*least is 576 px and 6 px across"):
            check_region(small)


def test_an_empty_region_and_scattered_specks_are_refused():
    with pytest.raises(PaletteError, match="'moss' is empty"):
        check_region(block(0, 0))
    specks = Region("moss", np.indices((200, 300)).sum(0) % 2 == 0)
    with pytest.raises(PaletteError, match="'moss' is too small to hold a texture: 30000 px, 2 px across"):
        check_region(specks)


def test_a_strip_along_the_photos_edge_is_bounded_by_it():
    mask = np.zeros((200, 300), bool)
    mask[:4] = True
    with pytest.raises(PaletteError, match="4 px across"):
        check_region(Region("moss", mask))
    check_region(Region("moss", np.ones((200, 300), bool)))


@pytest.mark.parametrize(
    "name, expected",
    [
        ("masonry", "masonry"),
        ("Mauer größer 石", "Mauer größer 石"),
        ("e\u0301t\u0301", "ét\u0301"),
        ("a/b\\c:d*e?f\"g<h>i|j", "a_b_c_d_e_f_g_h_i_j"),
        ("../../etc/passwd", "_.._etc_passwd"),
        ("tab\tnul\0", "tab_nul_"),
        ("trailing. . ", "trailing"),
        (" .hidden", "hidden"),
        ("CON", "_CON"),
        ("nul.stone", "_nul.stone"),
        ("Com1", "_Com1"),
        ("console", "console"),
        ("...", "region"),
        ("masks", "masks_"),
        ("Palette.PNG", "Palette.PNG_"),
        ("blender_assets.cats.txt ", "blender_assets.cats.txt_"),
        ("", "region"),
    ],
)  # fmt: skip
def test_file_names_are_safe_on_every_system(name, expected):
    assert file_name(name) == expected
    assert file_name(expected) == expected


def test_long_names_are_cut_between_letters():
    assert file_name("石" * 200) == "石" * 33
    assert len(file_name("a" * 300)) == 100
