"""Whatever is painted on whatever photo: a material whose maps are numbers, or an error that says why not."""

import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from material_palette.core.errors import PaletteError
from material_palette.core.image import linear_from_srgb, read_photo, srgb_from_linear
from material_palette.core.palette import Settings, extract_material
from material_palette.core.region import Region
from textures import quiet

PHOTO = Path(__file__).resolve().parent.parent / "examples" / "viaduct" / "photo.jpg"
HARM = {
    "none": lambda pixels, random: pixels,
    "dark": lambda pixels, random: 0.02 * pixels,
    "over-exposed": lambda pixels, random: 8 * pixels,
    "grey": lambda pixels, random: np.repeat(pixels.mean(2, keepdims=True), 3, 2),
    "noisy": lambda pixels, random: pixels + random.normal(0, 0.2, pixels.shape),
    "two levels": lambda pixels, random: np.where(pixels > pixels.mean(), 0.9, 0.05),
    "one channel black": lambda pixels, random: pixels * [1, 0, 1],
    "constant": lambda pixels, random: np.full_like(pixels, 0.3),
}


def painted(kind: str, shape: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    height, width = shape
    mask, (y, x) = np.zeros(shape, np.uint8), (random.integers(height), random.integers(width))
    if kind == "blobs":
        field = cv2.GaussianBlur(random.standard_normal(shape).astype(np.float32), (0, 0), random.uniform(1, 12))
        return field > np.quantile(field, random.uniform(0.3, 0.95))
    if kind == "stroke":
        end = int(random.integers(width)), int(random.integers(height))
        cv2.line(mask, (int(x), int(y)), end, 1, int(random.integers(3, 60)))
    elif kind == "column":
        mask[:, x : x + random.integers(2, 80)] = 1
    else:
        mask[:] = 1
    return mask > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["all", "blobs", "stroke", "column"])
@pytest.mark.parametrize("harm", HARM)
def test_any_region_of_any_photo(harm, kind):
    random = np.random.default_rng([list(HARM).index(harm), len(kind)])
    photo = read_photo(PHOTO).pixels
    shrunk = cv2.resize(photo, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
    pixels = srgb_from_linear(np.clip(HARM[harm](shrunk, random), 0, 1).astype(np.float32))
    pixels = linear_from_srgb(np.rint(255 * pixels).astype(np.float32) / 255)
    region = Region("painted", painted(kind, pixels.shape[:2], random))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            material = extract_material(pixels, region, Settings(quality="draft", resolution=64), quiet)
        except PaletteError as error:
            assert "painted" in str(error)
            return
    for value in (material.svbrdf.albedo, material.svbrdf.normal, material.svbrdf.roughness):
        assert np.isfinite(value).all()
    assert material.svbrdf.albedo.min() >= 0 and material.svbrdf.albedo.max() <= 1
