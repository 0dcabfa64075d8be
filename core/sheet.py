"""The contact sheet: the photo with its coloured regions, and for each material what was made of it."""

import colorsys
import unicodedata
from typing import TYPE_CHECKING

import cv2
import numpy as np

from . import reduction
from .image import srgb_from_linear

if TYPE_CHECKING:
    from .palette import Material, Palette

CELL = 256  # px
GAP = 8
TITLE = 28
BACKGROUND = 0.13
COLUMNS = ("exemplar", "texture, tiled 2 x 2", "base colour", "normal", "roughness", "height", "rendered")


def region_colour(index: int) -> tuple[float, float, float]:
    """sRGB-encoded colour of the index-th region, told apart from its neighbours (golden-ratio hues)."""
    return colorsys.hsv_to_rgb((0.03 + index * 0.618034) % 1, 0.75, 1.0)


def thumbnail(encoded: np.ndarray) -> np.ndarray:
    """An encoded picture (H, W, C) in [0, 1] within CELL x CELL px, uint8."""
    h, w = encoded.shape[:2]
    scale = min(1.0, CELL / max(h, w))
    size = max(1, round(w * scale)), max(1, round(h * scale))
    small = cv2.resize(np.asarray(encoded, np.float32), size, interpolation=cv2.INTER_AREA)
    return np.rint(np.clip(small, 0, 1) * 255).astype(np.uint8)


def contact_sheet(palette: "Palette") -> np.ndarray:
    """The sheet as (H, W, 3) float32 sRGB-encoded: constants are shown as flat fields, a failure by its reason."""
    width = len(COLUMNS) * (CELL + GAP) + GAP
    rows = [] if palette.photo is None else [_photo(palette, width)]
    for i, material in enumerate(palette.materials):
        rows.append(_material(material, region_colour(i), width))
    return np.concatenate(rows)


def _photo(palette: "Palette", width: int) -> np.ndarray:
    encoded = srgb_from_linear(np.clip(palette.photo, 0, 1))
    h, w = encoded.shape[:2]
    scale = min((width - 3 * GAP) / 2 / w, 700 / h)
    size = max(1, round(w * scale)), max(1, round(h * scale))
    shrink = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    photo = cv2.resize(encoded, size, interpolation=shrink)
    marked = photo.copy()
    for i, region in enumerate(palette.regions):
        mask = cv2.resize(region.mask.astype(np.float32), size, interpolation=shrink)[..., None]
        colour = np.array(region_colour(i), np.float32)
        marked = marked * (1 - 0.5 * mask) + 0.5 * mask * colour
        outlines, _ = cv2.findContours((mask[..., 0] > 0.5).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        marked = np.ascontiguousarray(marked)
        cv2.drawContours(marked, outlines, -1, region_colour(i), 1, cv2.LINE_AA)
    row = _empty(size[1] + 2 * GAP, width)
    row[GAP : GAP + size[1], GAP : GAP + size[0]] = photo
    row[GAP : GAP + size[1], 2 * GAP + size[0] : 2 * GAP + 2 * size[0]] = marked
    return row


def _material(material: "Material", colour: tuple[float, float, float], width: int) -> np.ndarray:
    row = _empty(TITLE + 20 + CELL + GAP, width)
    row[4:TITLE, GAP : GAP + 20] = colour
    # nothing that differs between two runs stands here: the same seed gives the same sheet
    note = material.name if material.status == "ok" else f"{material.name}   FAILED"
    if material.status == "ok" and material.reduced:
        note += "   (" + "; ".join(reduction.say(material.reduced)) + ")"
    _text(row, note, GAP + 30, 21, 0.6)
    top = TITLE + 20
    if material.svbrdf is None:
        _text(row, material.error or "", GAP, top + 20, 0.5)
        return row
    for column, picture in enumerate(_pictures(material)):
        left = GAP + column * (CELL + GAP)
        _text(row, COLUMNS[column], left, TITLE + 13, 0.4)
        if picture is not None:
            h, w = picture.shape[:2]
            row[top : top + h, left : left + w] = picture
    return row


def _pictures(material: "Material") -> list[np.ndarray | None]:
    svbrdf = material.svbrdf
    height = svbrdf.height
    relief = None if height is None else (height - height.min()) / max(float(np.ptp(height)), 1e-9)
    sphere = material.preview[..., :3] * material.preview[..., 3:] + BACKGROUND * (1 - material.preview[..., 3:])
    return [
        _field(material.exemplar, 3) if material.exemplar is not None else None,
        _field(material.texture, 3) if material.texture is not None else None,
        _field(srgb_from_linear(svbrdf.albedo), 3),
        _field((svbrdf.normal + 1) / 2, 3),
        _field(svbrdf.roughness, 1),
        None if relief is None else _field(relief, 1),
        _field(sphere, 3),
    ]


def _field(value: np.ndarray | float, channels: int) -> np.ndarray:
    """A map, or a constant as a flat field, as float32 RGB within the cell."""
    value = np.asarray(value, np.float32) / (255 if getattr(value, "dtype", None) == np.uint8 else 1)
    if value.ndim < 2:
        value = np.broadcast_to(value, (CELL, CELL, channels))
    small = thumbnail(value).astype(np.float32) / 255
    if small.ndim == 2:
        small = small[..., None]
    return np.broadcast_to(small, small.shape[:2] + (3,))


def _empty(height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), BACKGROUND, np.float32)


def _text(row: np.ndarray, text: str, x: int, y: int, scale: float) -> None:
    # OpenCV's built-in font has ASCII only
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    cv2.putText(row, plain, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, (0.85, 0.85, 0.85), 1, cv2.LINE_AA)
