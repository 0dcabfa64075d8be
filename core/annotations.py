"""Masks from other tools in one file: an image of colours or indices, or COCO's JSON of polygons and run lengths."""

import json
from pathlib import Path

import cv2
import numpy as np

from .errors import PaletteError
from .image import check_shape, read_codes
from .region import Region, check_names, readable

FARTHEST = 10  # longer sides of the image: a polygon that goes beyond is of another one
MOST_CODES = 64  # more colours than that are a picture, or borders that were smoothed


def read_annotations(path: str | Path, shape: tuple[int, int], photo_name: str = "") -> list[Region]:
    """Regions of the shape (H, W) from one file, sorted by name.

    .json: COCO; one region per category, of all its annotations, or per annotation where there are no categories (the
    lists that Segment Anything's tools write). `photo_name` chooses among several images, by file name.
    Any other: an image in which each colour or index but black and transparent is a region.
    Raises PaletteError for what can't be read, when there is no region and for two of one file name.
    """
    path = Path(path)
    found = _coco(path, shape, photo_name) if path.suffix.lower() == ".json" else _coded(path, shape)
    if not found:
        raise PaletteError(f"'{path}' holds no region.")
    regions = [Region(name, found[name]) for name in sorted(found)]
    check_names(regions)
    return regions


def _coded(path: Path, shape: tuple[int, int]) -> dict[str, np.ndarray]:
    codes = read_codes(path, shape)
    digits = 2 * codes.itemsize
    flat = codes.reshape(-1, codes.shape[2]).astype(np.uint64)
    keys = flat[:, 0]
    for channel in flat.T[1:]:
        keys = keys << np.uint64(16) | channel
    values, first, owner = np.unique(keys, return_index=True, return_inverse=True)
    if len(values) > MOST_CODES:
        raise PaletteError(
            f"'{path}' has {len(values)} colours, too many for one colour per region (at most {MOST_CODES}). "
            f"Save it without smoothed borders and without loss, as PNG."
        )
    owner = owner.reshape(shape)
    found = {}
    for index, at in enumerate(first):
        code = flat[at].tolist()
        if any(code):
            name = f"label_{code[0]}" if len(set(code)) == 1 else "colour_" + "".join(f"{c:0{digits}x}" for c in code)
            found[name] = owner == index
    return found


def _coco(path: Path, shape: tuple[int, int], photo_name: str) -> dict[str, np.ndarray]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        content = {"annotations": content} if isinstance(content, list) else content
        annotations = content["annotations"]
        images = content.get("images", [])
        image = _image(path, images, photo_name)
        if image is not None:
            annotations = [a for a in annotations if a.get("image_id", image["id"]) == image["id"]]
        names = {category["id"]: readable(str(category["name"] or "")) for category in content.get("categories", [])}
        size = (int(image["height"]), int(image["width"])) if image and "height" in image else shape
        found: dict[str, np.ndarray] = {}
        for number, annotation in enumerate(annotations, 1):
            name = names.get(annotation.get("category_id"), f"mask_{number:02}")
            if not name.strip():
                raise PaletteError(f"'{path}' has a category without a name, id {annotation['category_id']}. Name it.")
            segmentation = annotation["segmentation"]
            check_shape(path, segmentation["size"] if isinstance(segmentation, dict) else size, shape)
            mask = _mask(segmentation, size, shape)
            found[name] = found[name] | mask if name in found else mask
        return found
    except PaletteError:
        raise
    except OSError as error:
        raise PaletteError(f"'{path}' can't be read: {error.strerror or error}.") from None
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise PaletteError(f"'{path}' is not COCO's JSON of masks ({type(error).__name__}: {error}).") from None


def _image(path: Path, images: list[dict], photo_name: str) -> dict | None:
    if len(images) < 2:
        return images[0] if images else None
    stem = Path(photo_name).stem
    for image in images:
        if stem and Path(str(image.get("file_name", ""))).stem == stem:
            return image
    raise PaletteError(f"'{path}' is about {len(images)} images and none is named '{stem}'. Name the photo as there.")


def _mask(segmentation: list | dict, size: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of polygons [[x, y, x, y, ..], ..] or run lengths {"size": [h, w], "counts": ..}."""
    if isinstance(segmentation, dict):
        height, width = segmentation["size"]
        counts = segmentation["counts"]
        runs = _decoded(counts) if isinstance(counts, str) else counts
        if sum(runs) != height * width or min(runs, default=0) < 0:
            raise ValueError("run lengths don't add up to the mask's size")
        values = np.arange(len(runs)) % 2 == 1
        mask = np.repeat(values, runs).reshape(width, height).T  # columns one after the other
        return cv2.resize(mask.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    height, width = size
    mask = np.zeros(shape, np.uint8)
    for polygon in segmentation:
        points = np.asarray(polygon, np.float64).reshape(-1, 2) * (shape[1] / width, shape[0] / height)
        if len(points) < 3 or not np.isfinite(points).all():
            raise ValueError("a polygon has fewer than three points or one that is no number")
        if np.abs(points).max() > FARTHEST * max(shape):
            raise ValueError("a polygon leaves the image by far")
        # COCO's corners of pixels are at whole numbers, OpenCV's centres; 4 bits of fraction
        cv2.fillPoly(mask, [np.round((points - 0.5) * 16).astype(np.int32)], 1, shift=4)
    return mask > 0


def _decoded(text: str) -> list[int]:
    """Run lengths of COCO's compressed string: 5 bits a character, least first, bit 6 means more follow; from the
    fourth on a run is stored as its difference to the run before the last."""
    runs, value, shift = [], 0, 0
    for character in text:
        bits = ord(character) - 48
        value |= (bits & 0x1F) << shift
        shift += 5
        if not bits & 0x20:
            if bits & 0x10:  # the sign
                value -= 1 << shift
            if len(runs) > 2:
                value += runs[-2]
            runs.append(value)
            value, shift = 0, 0
    return runs
