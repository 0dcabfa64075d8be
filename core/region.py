"""Regions: the named parts of a photo whose materials are wanted."""

import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from .errors import PaletteError
from .image import read_mask

LEAST_AREA = 24 * 24  # px
LEAST_RADIUS = 3  # px of the largest disc inside; below it no neighbourhood lies within the region
LONGEST_FILE_NAME = 100  # bytes; leaves room for suffixes and folders within what Windows takes
MASK_SUFFIXES = frozenset(
    ".png .jpg .jpeg .jpe .tif .tiff .bmp .tga .exr .hdr .webp .gif .pbm .pgm .ppm .pnm .pfm .psd .psb .jp2 .dpx .sgi "
    ".rgb .ico .avif .heic .heif .jxl".split()
)
WINDOWS_DEVICE = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\.|$)", re.IGNORECASE)


@dataclass
class Region:
    """A named part of the photo: mask (H, W) bool, of the photo's height and width."""

    name: str
    mask: np.ndarray


def read_regions(folder: str | Path, shape: tuple[int, int]) -> list[Region]:
    """One region per mask image in `folder`, named as its file without suffix, sorted by name, of the shape (H, W).

    Hidden files, folders and files without an image's suffix are passed over.
    Raises PaletteError for a folder that is missing or holds no mask, for two masks whose files of maps would have one
    name on some system, and for what `read_mask` refuses.
    """
    folder = Path(folder)
    if not folder.is_dir():
        reason = "is a file" if folder.is_file() else "doesn't exist"
        raise PaletteError(f"Mask folder '{folder}' {reason}. Name a folder that holds one mask image per material.")
    try:
        files = sorted(
            (f for f in folder.iterdir() if f.suffix.lower() in MASK_SUFFIXES and f.name[0] != "." and not f.is_dir()),
            key=lambda f: (f.stem, f.name),
        )
    except OSError as error:
        raise PaletteError(f"Mask folder '{folder}' can't be read: {error.strerror}. Check its permissions.") from None
    if not files:
        raise PaletteError(
            f"Mask folder '{folder}' holds no mask image. Put one image per material there, such as stone.png."
        )
    owners = {}
    for file in files:
        owner = owners.setdefault(file_name(file.stem).casefold(), file)
        if owner is not file:
            raise PaletteError(
                f"Masks '{owner.name}' and '{file.name}' in '{folder}' would name one material. Rename or remove one."
            )
    return [Region(_readable(file.stem), read_mask(file, shape)) for file in files]


def check_region(region: Region) -> None:
    """Raise PaletteError when a region is empty or too small to hold a texture, with its size and the least."""
    area = int(np.count_nonzero(region.mask))
    if not area:
        raise PaletteError(f"Region '{region.name}' is empty: no pixel of its mask is painted. Paint it or remove it.")
    inside = np.pad(region.mask.astype(np.uint8), 1)  # the photo's edge bounds a region too
    radius = float(cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_5).max())
    if area < LEAST_AREA or radius < LEAST_RADIUS:
        raise PaletteError(
            f"Region '{region.name}' is too small to hold a texture: {area} px, {2 * radius:.0f} px across at its "
            f"widest place. The least is {LEAST_AREA} px and {2 * LEAST_RADIUS} px across. "
            f"Paint a larger area or use a larger photo."
        )


def _readable(stem: str) -> str:
    """A file's stem as text that JSON can hold: Linux allows names that are not UTF-8, macOS takes accents apart."""
    return unicodedata.normalize("NFC", stem.encode("utf-8", "replace").decode("utf-8"))


def file_name(name: str) -> str:
    """A region's name as a file name on Linux, macOS and Windows; letters of any script stay as they are."""
    clean = unicodedata.normalize("NFC", name)
    clean = "".join("_" if c in '<>:"/\\|?*' or unicodedata.category(c)[0] == "C" else c for c in clean)
    clean = clean.encode("utf-8")[:LONGEST_FILE_NAME].decode("utf-8", "ignore")
    clean = clean.strip(" ").lstrip(".").rstrip(" .").strip(" ")
    if WINDOWS_DEVICE.match(clean):
        clean = "_" + clean
    return clean or "region"
