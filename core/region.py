"""Regions: the named parts of a photo whose materials are wanted."""

import json
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
PALETTE_FILES = ("palette.json", "palette.png", "palette.blend", "blender_assets.cats.txt")
EXEMPLARS = "exemplars"  # folder of what each material was learnt from, beside masks
RESERVED = {"masks", EXEMPLARS, *PALETTE_FILES}  # beside the materials' folders
GEOMETRY = "regions.json"  # beside the masks: corners and measures by region
LONGEST_FILE_NAME = 100  # bytes; leaves room for suffixes and folders within what Windows takes
LONGEST_NAME = 63  # bytes, of a data-block in Blender 4
MASK_SUFFIXES = frozenset(
    ".png .jpg .jpeg .jpe .tif .tiff .bmp .tga .exr .hdr .webp .gif .pbm .pgm .ppm .pnm .pfm .psd .psb .jp2 .dpx .sgi "
    ".rgb .ico .avif .heic .heif .jxl".split()
)
WINDOWS_DEVICE = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\.|$)", re.IGNORECASE)


@dataclass
class Region:
    """A named part of the photo: mask (H, W) bool, of the photo's height and width.

    corners (4, 2): photo px (x, y) of a rectangle on the surface, clockwise from its top left, or None; measure: two
    photo px (2, 2) on the surface and the metres between them, or None.
    """

    name: str
    mask: np.ndarray
    corners: np.ndarray | None = None
    measure: tuple[np.ndarray, float] | None = None


def read_regions(folder: str | Path, shape: tuple[int, int], scale: float = 1.0) -> list[Region]:
    """One region per mask image in `folder`, named as its file without suffix, sorted by name, of the shape (H, W).

    Corners and measures come from the file GEOMETRY beside them, if there is one, in px of the photo's file, of which
    the photo has `scale`. Hidden files, folders and other files
    without an image's suffix are passed over.
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
    regions = [Region(readable(file.stem), read_mask(file, shape)) for file in files]
    if (folder / GEOMETRY).is_file():
        _read_geometry(folder / GEOMETRY, regions, scale)
    return regions


def parse_corners(text: str) -> tuple[str, np.ndarray]:
    """(region, corners) of "region:x,y x,y x,y x,y". Raises PaletteError."""
    name, _, points = text.rpartition(":")
    return readable(name), _points(points.split(), 4, text, "NAME:X,Y X,Y X,Y X,Y")


def parse_measure(text: str) -> tuple[str, tuple[np.ndarray, float]]:
    """(region, measure) of "region:x,y x,y=metres". Raises PaletteError."""
    name, _, rest = text.rpartition(":")
    points, _, metres = rest.partition("=")
    usage = "NAME:X,Y X,Y=METRES"
    return readable(name), (_points(points.split(), 2, text, usage), _metres(metres, text, usage))


def parse_card(text: str) -> tuple[Path | None, np.ndarray]:
    """(photo, two corners (2, 2)) of "x,y x,y" or "photo:x,y x,y", a grey card's place. Raises PaletteError."""
    photo, _, points = text.rpartition(":")
    return Path(photo) if photo else None, _points(points.split(), 2, text, "[PHOTO:]X,Y X,Y")


def add_geometry(regions: list[Region], corners: dict, measures: dict, scale: float = 1.0) -> None:
    """Give regions their corners and measures, by name, in px of a photo `scale` times smaller than its file.

    Raises PaletteError for a name that no region has, and for corners that all lie off one side of the photo.
    """
    by_name = {region.name: region for region in regions}
    for name in [*corners, *measures]:
        if name not in by_name:
            raise PaletteError(f"there is no region '{name}'; choose one of: {', '.join(by_name)}")
    for name, found in corners.items():
        points, (height, width) = found * scale, by_name[name].mask.shape
        if (points.max(0) <= 0).any() or (points.min(0) >= (width, height)).any():
            raise PaletteError(
                f"the corners of '{name}' lie outside of the photo, {width / scale:.0f} x {height / scale:.0f} px"
            )
        by_name[name].corners = points
    for name, (points, metres) in measures.items():
        by_name[name].measure = points * scale, metres


def region_geometry(region: Region, scale: float = 1.0) -> dict:
    """A region's corners and measure as `GEOMETRY` holds them, in px of the file; empty without either."""
    found = {}
    if region.corners is not None:
        found["corners"] = (np.asarray(region.corners, float) / scale).tolist()
    if region.measure is not None:
        points, metres = region.measure
        found["measure"] = {"points": (np.asarray(points, float) / scale).tolist(), "metres": metres}
    return found


def write_geometry(regions: list[Region], folder: Path, scale: float = 1.0) -> None:
    """Corners and measures, beside the regions' masks, as `read_regions` reads them; no file where there are none."""
    content = {file_name(r.name): geometry for r in regions if (geometry := region_geometry(r, scale))}
    if content:
        text = json.dumps(content, indent=1, ensure_ascii=False)
        (folder / GEOMETRY).write_text(text + "\n", encoding="utf-8")


def _read_geometry(file: Path, regions: list[Region], scale: float) -> None:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        corners = {n: g["corners"] for n, g in content.items() if "corners" in g}
        measures = {n: (g["measure"]["points"], g["measure"]["metres"]) for n, g in content.items() if "measure" in g}
        usage = "points [x, y], four as corners and two as a measure"
        corners = {n: _points(c, 4, str(c), usage) for n, c in corners.items()}
        measures = {n: (_points(p, 2, str(p), usage), _metres(m, str(m), "a length")) for n, (p, m) in measures.items()}
        add_geometry(regions, corners, measures, scale)
    except PaletteError as error:
        raise PaletteError(f"'{file}': {error}") from None
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise PaletteError(
            f"'{file}' can't be read ({error}). It holds, by region, \"corners\": four [x, y] and "
            f'"measure": {{"points": two [x, y], "metres": number}}.'
        ) from None


def _points(values: list, count: int, text: str, usage: str) -> np.ndarray:
    try:
        points = np.array([v.split(",") if isinstance(v, str) else v for v in values], np.float64)
    except (ValueError, TypeError):
        points = None
    if points is None or points.shape != (count, 2) or not np.isfinite(points).all():
        raise PaletteError(f"'{text}' is not {usage}")
    return points


def _metres(value: str | float, text: str, usage: str) -> float:
    try:
        metres = float(value)
    except (ValueError, TypeError):
        metres = float("nan")
    if not 0 < metres < float("inf"):
        raise PaletteError(f"'{text}' is not {usage}: the length is a positive number of metres")
    return metres


def check_names(regions: list[Region]) -> None:
    """Raise PaletteError for two regions whose files of maps would have one name on some system, and for a name that
    Blender 4 would cut, so that neither `fit` nor a scene's materials could be told by it."""
    owners = {}
    for region in regions:
        if len(region.name.encode()) > LONGEST_NAME:
            raise PaletteError(
                f"The region's name '{region.name}' has {len(region.name.encode())} bytes; Blender's materials have at "
                f"most {LONGEST_NAME}. Rename it, or its mask."
            )
        owner = owners.setdefault(file_name(region.name).casefold(), region)
        if owner is not region:
            raise PaletteError(
                f"Regions '{owner.name}' and '{region.name}' would name one material. Rename or remove one."
            )


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


def holds_texture(mask: np.ndarray) -> bool:
    """Whether `check_region` takes a mask (H, W) bool."""
    try:
        check_region(Region("region", mask))
    except PaletteError:
        return False
    return True


def too_small(count: int, share: float) -> str:
    """The warning that so many regions, together `share` (0 to 1) of the photo, were left out for their size."""
    if count == 1:
        return (
            f"A part of the photo, {share:.1%} of it, is too small for a region and is left out. Paint it to have it."
        )
    return (
        f"{count} parts of the photo, {share:.1%} of it together, are too small for a region and are left out. "
        f"Paint them to have them."
    )


def readable(stem: str) -> str:
    """A file's stem as text that JSON can hold: Linux allows names that are not UTF-8, macOS takes accents apart."""
    return unicodedata.normalize("NFC", stem.encode("utf-8", "replace").decode("utf-8"))


def file_name(name: str) -> str:
    """A region's name as a file name on Linux, macOS and Windows; letters of any script stay as they are. None of
    RESERVED."""
    clean = unicodedata.normalize("NFC", name)
    clean = "".join("_" if c in '<>:"/\\|?*' or unicodedata.category(c)[0] == "C" else c for c in clean)
    clean = clean.encode("utf-8")[:LONGEST_FILE_NAME].decode("utf-8", "ignore")
    clean = clean.strip(" ").lstrip(".").rstrip(" .").strip(" ")
    if WINDOWS_DEVICE.match(clean):
        clean = "_" + clean
    if clean.casefold() in RESERVED:
        clean += "_"
    return clean or "region"
