"""Masks as other tools write them become the same regions."""

import json

import cv2
import numpy as np
import pytest
from material_palette.core.annotations import read_annotations
from material_palette.core.errors import PaletteError

SHAPE = (40, 60)
COCOTOOLS = "e<?i" + "0" * 78 + "[<"


@pytest.fixture
def masks():
    wall, floor = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    wall[5:20, 10:50] = True
    floor[25:40, 0:30] = True
    return {"floor": floor, "wall": wall}


def by_name(regions):
    return {region.name: region.mask for region in regions}


def run_lengths(mask):
    """Column by column, beginning with zeros: the definition, not the reader turned round."""
    runs, value = [0], False
    for pixel in mask.T.ravel():
        if pixel != value:
            runs.append(0)
            value = pixel
        runs[-1] += 1
    return runs


def compressed(runs):
    text = ""
    for index, run in enumerate(runs):
        number = run - runs[index - 2] if index > 2 else run
        while True:
            bits, number = number & 31, number >> 5
            last = number == (-1 if bits & 16 else 0)
            text += chr(48 + (bits if last else bits | 32))
            if last:
                break
    return text


def write(path, content):
    path.write_text(json.dumps(content))
    return path


def test_colours_and_indices_are_regions_and_black_is_none(tmp_path, masks):
    colours = np.zeros((*SHAPE, 3), np.uint8)
    colours[masks["floor"]] = (0, 0, 255)  # OpenCV's red
    colours[masks["wall"]] = (0, 255, 0)
    cv2.imwrite(str(tmp_path / "colours.png"), colours)
    found = by_name(read_annotations(tmp_path / "colours.png", SHAPE))
    assert list(found) == ["colour_00ff00", "colour_ff0000"]
    assert (found["colour_ff0000"] == masks["floor"]).all() and (found["colour_00ff00"] == masks["wall"]).all()
    indices = np.zeros(SHAPE, np.uint16)
    indices[masks["floor"]], indices[masks["wall"]] = 1, 300
    cv2.imwrite(str(tmp_path / "indices.png"), indices)
    found = by_name(read_annotations(tmp_path / "indices.png", SHAPE))
    assert (found["label_1"] == masks["floor"]).all() and (found["label_300"] == masks["wall"]).all()


def test_colours_of_16_bits_have_names_of_their_own(tmp_path, masks):
    colours = np.zeros((*SHAPE, 3), np.uint16)
    colours[masks["floor"]] = (0, 0x345, 0x12)
    colours[masks["wall"]] = (0, 0x45, 0x123)
    cv2.imwrite(str(tmp_path / "colours.png"), colours)
    found = by_name(read_annotations(tmp_path / "colours.png", SHAPE))
    assert (found["colour_001203450000"] == masks["floor"]).all()
    assert (found["colour_012300450000"] == masks["wall"]).all()


def test_codes_are_resized_without_new_ones(tmp_path, masks):
    indices = np.zeros(SHAPE, np.uint8)
    indices[masks["floor"]] = 200
    cv2.imwrite(str(tmp_path / "indices.png"), indices)
    (region,) = read_annotations(tmp_path / "indices.png", (80, 120))
    assert region.mask.shape == (80, 120)
    assert (region.mask[::2, ::2] == masks["floor"]).all()


def test_a_picture_and_a_lossy_file_are_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (*SHAPE, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "picture.png"), noise)
    with pytest.raises(PaletteError, match="too many for one colour per region"):
        read_annotations(tmp_path / "picture.png", SHAPE)
    cv2.imwrite(str(tmp_path / "picture.jpg"), noise)
    with pytest.raises(PaletteError, match="doesn't keep colours exactly"):
        read_annotations(tmp_path / "picture.jpg", SHAPE)


@pytest.mark.parametrize("encode", [run_lengths, lambda mask: compressed(run_lengths(mask))])
def test_run_lengths_by_category(tmp_path, masks, encode):
    content = {
        "images": [{"id": 7, "file_name": "a.jpg", "height": 40, "width": 60}],
        "categories": [{"id": 1, "name": "floor"}, {"id": 2, "name": "wall"}],
        "annotations": [
            {"image_id": 7, "category_id": number, "segmentation": {"size": SHAPE, "counts": encode(masks[name])}}
            for number, name in ((1, "floor"), (2, "wall"))
        ],
    }
    found = by_name(read_annotations(write(tmp_path / "coco.json", content), SHAPE))
    assert all((found[name] == masks[name]).all() for name in masks)


def test_a_string_made_by_pycocotools(tmp_path):
    """pycocotools.mask.encode of a 40 x 60 mask with rows 5..20, columns 10..50 set."""
    mask = np.zeros(SHAPE, bool)
    mask[5:20, 10:50] = True
    assert compressed(run_lengths(mask)) == COCOTOOLS
    content = [{"segmentation": {"size": SHAPE, "counts": COCOTOOLS}}]
    (region,) = read_annotations(write(tmp_path / "sam.json", content), SHAPE)
    assert region.name == "mask_01" and (region.mask == mask).all()


def test_polygons_of_one_category_are_one_region(tmp_path):
    content = {
        "images": [
            {"id": 1, "file_name": "other.jpg", "height": 40, "width": 60},
            {"id": 2, "file_name": "street.jpg", "height": 80, "width": 120},
        ],
        "categories": [{"id": 3, "name": "cobbles"}],
        "annotations": [
            {"image_id": 2, "category_id": 3, "segmentation": [[0, 0, 40, 0, 40, 40, 0, 40]]},
            {"image_id": 2, "category_id": 3, "segmentation": [[80, 40, 120, 40, 120, 80, 80, 80]]},
            {"image_id": 1, "category_id": 3, "segmentation": [[0, 0, 60, 0, 60, 40, 0, 40]]},
        ],
    }
    path = write(tmp_path / "coco.json", content)
    (region,) = read_annotations(path, SHAPE, "street.png")
    expected = np.zeros(SHAPE, bool)
    expected[0:20, 0:20] = expected[20:40, 40:60] = True
    assert region.name == "cobbles" and np.count_nonzero(region.mask ^ expected) <= 80  # half a pixel of border
    with pytest.raises(PaletteError, match="2 images and none is named 'wall'"):
        read_annotations(path, SHAPE, "wall.jpg")


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"annotations": [{"segmentation": {"size": [4, 4], "counts": [3]}}]},
        {"annotations": [{"segmentation": [[0, 0, 1]]}]},
        {"annotations": 3},
        [1],
    ],
)
def test_damaged_json_is_named(tmp_path, content):
    with pytest.raises(PaletteError, match="coco.json"):
        read_annotations(write(tmp_path / "coco.json", content), SHAPE)


@pytest.mark.parametrize(
    "size, name, segmentation, words",
    [
        (SHAPE, "wall", {"size": (60, 40), "counts": [0, 2400]}, "coco.json' is 40 x 60 px, of another shape than the"),
        ((60, 40), "wall", [[0, 0, 9, 0, 9, 9]], "coco.json' is 40 x 60 px, of another shape than the photo"),
        ((0, 0), "wall", [[0, 0, 9, 0, 9, 9]], "coco.json' is 0 x 0 px"),
        (SHAPE, "wall", [[0, 0, 1e12, 0, 9, 9]], "coco.json' .*a polygon leaves the image by far"),
        (SHAPE, "", [[0, 0, 9, 0, 9, 9]], "coco.json' has a category without a name, id 0"),
    ],
)
def test_what_belongs_to_no_region_of_the_photo_is_named(tmp_path, size, name, segmentation, words):
    content = {
        "images": [{"id": 1, "height": size[0], "width": size[1]}],
        "categories": [{"id": 0, "name": name}],
        "annotations": [{"category_id": 0, "image_id": 1, "segmentation": segmentation}],
    }
    with pytest.raises(PaletteError, match=words):
        read_annotations(write(tmp_path / "coco.json", content), SHAPE)


def test_categories_of_one_file_name_are_refused(tmp_path):
    content = {
        "categories": [{"id": 1, "name": "a/b"}, {"id": 2, "name": "A_b"}],
        "annotations": [{"category_id": n, "segmentation": [[0, 0, 9, 0, 9, 9]]} for n in (1, 2)],
    }
    with pytest.raises(PaletteError, match="'A_b' and 'a/b' would name one material"):
        read_annotations(write(tmp_path / "coco.json", content), SHAPE)


def test_no_region_is_said(tmp_path):
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros(SHAPE, np.uint8))
    for path in (tmp_path / "black.png", write(tmp_path / "none.json", {"annotations": []})):
        with pytest.raises(PaletteError, match="holds no region"):
            read_annotations(path, SHAPE)
