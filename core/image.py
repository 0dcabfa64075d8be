"""Photos and masks into memory, maps onto disk; colour is linear Rec.709 inside and sRGB in files."""

import contextlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio

from .errors import PaletteError

FILM_DIAGONAL = 43.27  # mm, of 36 x 24
MAX_PIXELS = 16_000_000
LEAST_SIDE = 32  # px; below it there is no neighbourhood to learn a texture from
ASPECT_TOLERANCE = 0.02
BLOCK_BYTES = 16 << 20  # of float32 pixels read at once
# JPEG and WebP have no exact zero: painted edges ring by a few values into the black beside them.
LOSSY_ZERO = {"jpeg": 16, "webp": 16}

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # CIE xy of red, green, blue, white
CHROMATICITIES = {
    "p3": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290),
    "adobe": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290),
    "prophoto": (0.734699, 0.265301, 0.159597, 0.840403, 0.036598, 0.000105, 0.345704, 0.358540),
    "rec2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
    "ap0": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
    "ap1": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
}
GAMUT_WORDS = {
    "p3": ("p3",),
    "adobe": ("adobe",),
    "prophoto": ("prophoto", "romm"),
    "rec2020": ("rec2020", "bt2020"),
    "ap0": ("ap0", "aces2065"),
    "ap1": ("ap1", "acescg"),
}
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


@dataclass
class Photo:
    """pixels (H, W, 3) float32 linear Rec.709, >= 0, upright; warnings: what was changed on the way in.

    focal: focal length in px of `pixels`, as the camera wrote it into the file, else None; scale: px of `pixels` per px
    of the file.
    """

    pixels: np.ndarray
    warnings: list[str] = field(default_factory=list)
    focal: float | None = None
    scale: float = 1.0


def linear_from_srgb(x: np.ndarray) -> np.ndarray:
    """sRGB-encoded values to linear, float32, any shape; beyond [0, 1] the curve goes on (IEC 61966-2-1)."""
    x = np.asarray(x, np.float32)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0.04045) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def srgb_from_linear(x: np.ndarray) -> np.ndarray:
    """Linear values to sRGB-encoded, float32, any shape; beyond [0, 1] the curve goes on (IEC 61966-2-1)."""
    x = np.asarray(x, np.float32)
    return np.where(x <= 0.0031308, x * 12.92, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055).astype(np.float32)


def read_photo(
    path: str | Path,
    max_pixels: int = MAX_PIXELS,
    progress: Callable[[float, str], None] = lambda fraction, message: None,
) -> Photo:
    """Read a photo upright, in linear light, at most `max_pixels` large.

    Integer formats are sRGB-encoded and float formats linear Rec.709, unless the file names another colour space or
    carries the profile of one. Alpha is undone, not composited: a transparent pixel keeps the colour stored in it, with
    a warning. A larger photo is read in blocks of rows and averaged over boxes in linear light, so that memory is
    bounded by the result.
    Raises PaletteError for a file that is missing, empty, cut off, no image, of pixels that are not finite, of channels
    that are not grey or RGB, or with a side under 32 px.
    """
    path = Path(path)
    warnings = []
    with _opened(path, "Photo") as image:
        spec = image.spec()
        if min(spec.width, spec.height) < LEAST_SIDE:
            raise PaletteError(
                f"Photo '{path}' is {spec.width} x {spec.height} px, too small to hold a texture: "
                f"each side needs at least {LEAST_SIDE} px. Use a larger photo."
            )
        colour, alpha = _channels(path, spec)
        linear = _linearisation(spec, warnings)
        to_rec709 = _gamut(spec, warnings)
        associated = alpha is not None and not spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
        height, width = _reduced_size(spec.height, spec.width, max_pixels)
        pixels = np.zeros((height, width, 3), np.float32)
        transparent = negative = 0
        for row, block in _blocks(image, path, "Photo"):
            rgb = block[..., colour]
            if rgb.dtype == np.float32 and not np.isfinite(rgb).all():
                raise PaletteError(
                    f"Photo '{path}' has pixels that are not finite numbers (NaN or infinity) near row {row}. "
                    f"Replace them in an image editor or render it again."
                )
            if alpha is not None:
                coverage = block[..., alpha, None].astype(np.float32)
                coverage /= np.iinfo(block.dtype).max if block.dtype != np.float32 else 1
                transparent += np.count_nonzero(coverage < 0.5)
                if associated:
                    rgb = _unassociated(rgb, coverage)
            rgb = linear(rgb)
            if to_rec709 is not None:
                rgb = rgb @ to_rec709.T
            negative += np.count_nonzero((rgb < -1e-4).any(-1))
            _add_rows(pixels, np.maximum(rgb, 0), row, spec.height)
            progress((row + len(block)) / spec.height, "Reading the photo")
        orientation = spec.get_int_attribute("Orientation", 1)
        upright = _upright(pixels, orientation)
        total = spec.width * spec.height
        focal = _focal(spec)
    if transparent:
        warnings.append(
            f"{100 * transparent / total:.3g} % of the photo is transparent: the colour stored there is used where a "
            f"region covers it."
        )
    if negative:
        warnings.append(
            f"{100 * negative / total:.3g} % of the pixels lie outside Rec.709; what is negative there became 0."
        )
    if (height, width) != (spec.height, spec.width):
        large = (spec.height, spec.width) if orientation < 5 else (spec.width, spec.height)
        warnings.append(_reduced(large, upright.shape, max_pixels))
    return Photo(upright, warnings, focal and focal * max(height, width), width / spec.width)


def read_mask(path: str | Path, shape: tuple[int, int]) -> np.ndarray:
    """Read a mask as (H, W) bool of the given shape (H, W), resized to the nearest pixel.

    Any pixel that is not black belongs (in lossy JPEG and WebP: 16 of 255 and more). Where alpha varies, a transparent
    pixel doesn't belong; where alpha alone varies, any pixel that is not transparent does.
    Raises PaletteError for a file that doesn't read as an image, or whose aspect ratio is more than 2 % off.
    """
    path = Path(path)
    with _opened(path, "Mask") as image:
        spec = image.spec()
        orientation = spec.get_int_attribute("Orientation", 1)
        height, width = shape if orientation < 5 else shape[::-1]
        check_shape(path, (spec.height, spec.width)[:: 1 if orientation < 5 else -1], shape)
        alpha = spec.alpha_channel if spec.alpha_channel >= 0 else None
        colour = [c for c in range(spec.nchannels) if c not in (alpha, spec.z_channel)] or [alpha]
        least = LOSSY_ZERO.get(image.format_name(), 0)
        rows, columns = _nearest(spec.height, height), _nearest(spec.width, width)
        painted = np.zeros((height, width), bool)
        visible = np.ones((height, width), bool)
        for row, block in _blocks(image, path, "Mask"):
            inside = slice(*np.searchsorted(rows, (row, row + len(block))))
            picked = block[rows[inside] - row][:, columns]
            painted[inside] = (picked[..., colour] >= least if least else picked[..., colour] != 0).any(-1)
            if alpha is not None:
                visible[inside] = picked[..., alpha] > 0
    if not visible.all() and visible.any():
        painted = painted & visible if (painted & visible).any() else visible
    return np.ascontiguousarray(_upright(painted, orientation))


def read_codes(path: str | Path, shape: tuple[int, int]) -> np.ndarray:
    """Read an image of codes, a colour or index per region, as (H, W, C) uint8 or uint16, upright, resized to the
    nearest pixel.

    What is transparent becomes 0. Raises PaletteError for a file that doesn't read as an image, is stored with loss or
    as floats, or whose aspect ratio is more than 2 % off.
    """
    path = Path(path)
    with _opened(path, "Mask") as image:
        spec = image.spec()
        orientation = spec.get_int_attribute("Orientation", 1)
        height, width = shape if orientation < 5 else shape[::-1]
        if image.format_name() in LOSSY_ZERO or spec.format.basetype not in (oiio.UINT8, oiio.UINT16):
            raise PaletteError(f"Mask '{path}' doesn't keep colours exactly. Save it as PNG of 8 or 16 bits.")
        check_shape(path, (spec.height, spec.width)[:: 1 if orientation < 5 else -1], shape)
        rows, columns = _nearest(spec.height, height), _nearest(spec.width, width)
        alpha = spec.alpha_channel
        colour = [c for c in range(spec.nchannels) if c != alpha]
        blocks = [block for _, block in _blocks(image, path, "Mask")]
        codes = np.concatenate(blocks)[rows][:, columns]
    if alpha >= 0:
        codes[codes[..., alpha] == 0] = 0
    return _upright(codes[..., colour], orientation)


def check_shape(path: Path, own: tuple[int, int], shape: tuple[int, int]) -> None:
    """Raise PaletteError for a mask (H, W), upright, whose aspect ratio is more than 2 % off a photo's shape (H, W)."""
    height, width = own
    if min(own) < 1 or abs(width * shape[0] / (height * shape[1]) - 1) > ASPECT_TOLERANCE:
        raise PaletteError(
            f"Mask '{path}' is {width} x {height} px, of another shape than the photo "
            f"({shape[1]} x {shape[0]} px). Paint it on the photo itself."
        )


def _nearest(stored: int, wanted: int) -> np.ndarray:
    """(wanted,) indices of the stored lines nearest to the wanted ones."""
    return ((np.arange(wanted) + 0.5) * stored / wanted).astype(int)


def write_image(path: str | Path, pixels: np.ndarray, bits: int = 8) -> None:
    """Write (H, W) or (H, W, 3) floats in [0, 1], already encoded, as a PNG of 8 or 16 bits per channel.

    The same pixels give the same bytes (no dates), and the file appears complete or not at all.
    Raises ValueError for another shape, depth or values that are not finite; OSError when it can't be written.
    """
    path = Path(path)
    pixels = np.asarray(pixels)
    if bits not in (8, 16) or not (pixels.ndim == 2 or pixels.ndim == 3 and pixels.shape[2] == 3) or not pixels.size:
        raise ValueError(f"write_image takes (H, W) or (H, W, 3) at 8 or 16 bits, not {pixels.shape} at {bits}")
    if not np.isfinite(pixels).all():
        raise ValueError(f"'{path.name}' would hold values that are not finite")
    steps = 2**bits - 1
    levels = np.rint(np.clip(pixels, 0, 1) * np.float32(steps)).astype(np.uint8 if bits == 8 else np.uint16)
    # Encoded in memory: OpenImageIO's Python writer reports a full disk only sometimes.
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 3, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT]
    _, encoded = cv2.imencode(".png", levels if levels.ndim == 2 else levels[..., ::-1], settings)
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_bytes(encoded.tobytes())
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def _opened(path: Path, kind: str) -> Iterator["oiio.ImageInput"]:
    """The first image of a file, opened with its alpha left as stored."""
    try:
        if path.is_dir():
            raise PaletteError(f"{kind} '{path}' is a folder. Name an image file in it.")
        with open(path, "rb") as file:
            empty = not file.read(1)
    except FileNotFoundError:
        raise PaletteError(f"{kind} '{path}' doesn't exist. Check its name and folder.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise PaletteError(f"{kind} '{path}' can't be opened: {reason}. Check its permissions.") from None
    if empty:
        raise PaletteError(f"{kind} '{path}' is empty (0 bytes). Save or copy it again.")
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    oiio.geterror()  # clears what an earlier failure left
    image = oiio.ImageInput.open(str(path), hints)
    if image is None or image.format_name() == "null":
        raise PaletteError(
            f"{kind} '{path}' can't be read as an image ({_one_line(oiio.geterror())}). "
            f"It is damaged or of a format that is not read here; save it as PNG, JPEG, TIFF or OpenEXR."
        )
    try:
        spec = image.spec()
        if spec.get_int_attribute("oiio:Movie", 0) or spec.deep or spec.depth > 1:
            raise PaletteError(f"{kind} '{path}' is a film, a volume or deep. Export one flat picture of it.")
        yield image
    finally:
        image.close()


def _blocks(image: "oiio.ImageInput", path: Path, kind: str) -> Iterator[tuple[int, np.ndarray]]:
    """(first row, (rows, W, C) array) from the top; 8 and 16 bit integers as stored, all else float32."""
    spec = image.spec()
    native = spec.format.basetype in (oiio.UINT8, oiio.UINT16)
    kept = spec.format if native else oiio.TypeDesc(oiio.FLOAT)
    rows = max(1, BLOCK_BYTES // (4 * spec.width * spec.nchannels))
    if spec.tile_width:
        rows = max(1, rows // spec.tile_height) * spec.tile_height
    for row in range(0, spec.height, rows):
        ys = spec.y + row, spec.y + min(row + rows, spec.height)
        if spec.tile_width:
            columns = spec.x, spec.x + spec.width
            block = image.read_tiles(0, 0, *columns, *ys, spec.z, spec.z + 1, 0, spec.nchannels, kept)
        else:
            block = image.read_scanlines(0, 0, *ys, spec.z, 0, spec.nchannels, kept)
        # Some readers return what they have of a cut-off file and only set the error.
        error = image.geterror()
        if block is None or error:
            raise PaletteError(
                f"{kind} '{path}' is damaged or cut off near row {row} of {spec.height} ({_one_line(error)}). "
                f"Save or copy it again."
            )
        yield row, block.reshape(ys[1] - ys[0], spec.width, spec.nchannels)


def _one_line(error: str) -> str:
    return " ".join(error.split()) or "no reason given"


def _channels(path: Path, spec: "oiio.ImageSpec") -> tuple[list[int], int | None]:
    """Indices of red, green, blue (one index thrice for grey), and of alpha or None."""
    model = _stored_model(spec)
    if "LAB" in model or "LOGL" in model:  # OpenCV's default for floats is LogLuv
        how = " (OpenCV: IMWRITE_TIFF_COMPRESSION 1)" if "LOGL" in model else ""
        raise PaletteError(f"Photo '{path}' is stored as {model}. Save it as RGB{how}.")
    names = [name.lower() for name in spec.channelnames]
    for prefix in [""] + [name[:-1] for name in names if name.endswith(".r")]:
        if all(prefix + c in names for c in "rgb"):
            alpha = names.index(prefix + "a") if prefix + "a" in names else None
            return [names.index(prefix + c) for c in "rgb"], alpha
    alpha = spec.alpha_channel if spec.alpha_channel >= 0 else None
    grey = [c for c in range(spec.nchannels) if c not in (alpha, spec.z_channel)]
    if len(grey) == 1:
        return grey * 3, alpha
    raise PaletteError(f"Photo '{path}' has channels {', '.join(spec.channelnames)}, not RGB or grey. Save it as RGB.")


def _colour_space(spec: "oiio.ImageSpec") -> str:
    """Name of the colour space as the file or its reader says it, lower case without punctuation but points; or ''."""
    return re.sub(r"[^a-z0-9.]", "", spec.get_string_attribute("oiio:ColorSpace").lower())


def _profile(spec: "oiio.ImageSpec") -> str:
    return re.sub(r"[^a-z0-9.]", "", spec.get_string_attribute("ICCProfile:profile_description").lower())


def _stored_model(spec: "oiio.ImageSpec") -> str:
    """What a JPEG or TIFF file stores, upper case, such as CMYK; the reader may have made RGB of it."""
    return (spec.get_string_attribute("jpeg:ColorSpace") or spec.get_string_attribute("tiff:ColorSpace")).upper()


def read_focal(path: str | Path) -> float | None:
    """The focal length that a camera wrote into a photo's file, in longer sides of the photo, else None."""
    image = oiio.ImageInput.open(str(path))
    if image is None:
        oiio.geterror()
        return None
    try:
        return _focal(image.spec())
    finally:
        image.close()


def _focal(spec: "oiio.ImageSpec") -> float | None:
    def exif(name: str) -> float:
        value = spec.getattribute(f"Exif:{name}")
        return float(value) if isinstance(value, int | float) and 0 < value < 1e6 else 0.0

    # by CIPA's definition the equivalent for 35 mm film goes by the diagonal
    if exif("FocalLengthIn35mmFilm"):
        diagonal = float(np.hypot(spec.width, spec.height)) / max(spec.width, spec.height)
        return exif("FocalLengthIn35mmFilm") / FILM_DIAGONAL * diagonal
    unit = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}.get(int(exif("FocalPlaneResolutionUnit")), 25.4)  # mm
    across = max(exif("PixelXDimension") or spec.width, exif("PixelYDimension") or spec.height)
    return (exif("FocalLength") * exif("FocalPlaneXResolution") / unit / across) or None


def _linearisation(spec: "oiio.ImageSpec", warnings: list[str]) -> Callable[[np.ndarray], np.ndarray]:
    """Function from stored pixels (integers or floats) to linear float32."""
    is_float = spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
    name, profile = _colour_space(spec), _profile(spec)
    gamma = re.search(r"gamma(?:corrected)?(\d\.\d+)|^g(\d\d)", name)
    if _stored_model(spec) in ("CMYK", "YCCK"):
        warnings.append("The photo is CMYK; its colours are approximate. Save it as RGB for exact ones.")
    if not is_float and "adobe" in profile:
        curve = _power(563 / 256)
    elif not is_float and any(word in profile for word in GAMUT_WORDS["prophoto"]):
        curve = _power(1.8)
    elif gamma:
        curve = _power(float(gamma[1]) if gamma[1] else int(gamma[2]) / 10)
    elif name.startswith(("lin", "scenelinear", "aces2065", "acescg")):
        curve = _power(1.0)
    elif name.startswith("srgb"):
        curve = linear_from_srgb
    else:
        curve = _power(1.0) if is_float else linear_from_srgb
        if name and name != "colorseparated":
            encoding = "linear" if is_float else "sRGB"
            colour_space = spec.get_string_attribute("oiio:ColorSpace")
            warnings.append(f"The photo's colour space {colour_space} is not known here; it was read as {encoding}.")
    if spec.format.basetype not in (oiio.UINT8, oiio.UINT16):
        return curve
    steps = 255 if spec.format.basetype == oiio.UINT8 else 65535
    table = curve(np.arange(steps + 1, dtype=np.float32) / steps)
    return lambda block: curve(block) if block.dtype == np.float32 else table[block]


def _power(gamma: float) -> Callable[[np.ndarray], np.ndarray]:
    if gamma == 1:
        return lambda x: np.asarray(x, np.float32)
    return lambda x: np.maximum(x, 0).astype(np.float32) ** np.float32(gamma)


def _gamut(spec: "oiio.ImageSpec", warnings: list[str]) -> np.ndarray | None:
    """(3, 3) float32 matrix from the file's linear primaries to Rec.709, or None where they are Rec.709's."""
    name, profile = _colour_space(spec), _profile(spec)
    stored = spec.getattribute("chromaticities")
    if stored is not None and len(stored) == 8:
        return None if np.allclose(stored, REC709, atol=2e-3) else _rec709_from(stored)
    for text in (name, profile):
        for gamut, words in GAMUT_WORDS.items():
            if any(word in text for word in words):
                return _rec709_from(CHROMATICITIES[gamut])
    if profile and not any(word in profile for word in ("srgb", "iec61966", "gray", "grey", "linear", "rec709")):
        description = spec.get_string_attribute("ICCProfile:profile_description")
        warnings.append(f"The photo's colour profile '{description}' is not known here; its colours were read as sRGB.")
    return None


def _rec709_from(chromaticities: tuple[float, ...]) -> np.ndarray:
    """(3, 3) float32 matrix between linear RGB spaces, white adapted by Bradford's method."""

    def xyz_from_rgb(xy):
        xyz = np.array([[x / y, 1, (1 - x - y) / y] for x, y in np.reshape(xy, (4, 2))]).T
        return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3]), xyz[:, 3]

    source, source_white = xyz_from_rgb(chromaticities)
    rec709, white = xyz_from_rgb(REC709)
    cones = (BRADFORD @ white) / (BRADFORD @ source_white)
    adapted = np.linalg.inv(BRADFORD) @ np.diag(cones) @ BRADFORD
    return (np.linalg.inv(rec709) @ adapted @ source).astype(np.float32)


def _unassociated(rgb: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """Float32 colour before it was multiplied by alpha; where alpha is 0 the stored one."""
    if rgb.dtype != np.float32:
        rgb = np.minimum(rgb / np.float32(np.iinfo(rgb.dtype).max), np.maximum(coverage, 1e-6))
    return rgb / np.where(coverage > 0, coverage, 1)


def reduce_photo(pixels: np.ndarray, max_pixels: int = MAX_PIXELS) -> tuple[np.ndarray, list[str]]:
    """A photo (H, W, 3) linear at most `max_pixels` large, as `read_photo` has it, and a warning if it was larger."""
    height, width = _reduced_size(*pixels.shape[:2], max_pixels)
    if (height, width) == pixels.shape[:2]:
        return pixels, []
    small = cv2.resize(np.ascontiguousarray(pixels), (width, height), interpolation=cv2.INTER_AREA)
    return small, [_reduced(pixels.shape, small.shape, max_pixels)]


def _reduced(before: tuple[int, ...], after: tuple[int, ...], max_pixels: int) -> str:
    return (
        f"The photo was reduced from {before[1]} x {before[0]} px to {after[1]} x {after[0]} px: "
        f"at most {max_pixels / 1e6:g} megapixels are used."
    )


def _reduced_size(height: int, width: int, max_pixels: int) -> tuple[int, int]:
    scale = min(1.0, (max_pixels / (height * width)) ** 0.5)
    return max(1, int(height * scale)), max(1, int(width * scale))


def _add_rows(pixels: np.ndarray, block: np.ndarray, row: int, full_height: int) -> None:
    """Add full-size rows from `row` on to their boxes of the reduced `pixels`, weighted by overlap."""
    height, width = pixels.shape[:2]
    if height == full_height and width == block.shape[1]:
        pixels[row : row + len(block)] = block
        return
    block = cv2.resize(np.ascontiguousarray(block), (width, len(block)), interpolation=cv2.INTER_AREA)
    edges = (row + np.arange(len(block) + 1)) * (height / full_height)
    first, last = int(edges[0]), min(height, int(np.ceil(edges[-1])))
    boxes = np.arange(first, last)[:, None]
    overlap = np.minimum(edges[None, 1:], boxes + 1) - np.maximum(edges[None, :-1], boxes)
    weights = np.maximum(overlap, 0).astype(np.float32)
    pixels[first:last] += np.tensordot(weights, block, 1)


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Undo the camera's orientation, 1..8 as in EXIF."""
    if orientation in (5, 6, 7, 8):
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)
