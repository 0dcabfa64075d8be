"""Photos come in upright and linear, whatever the file; bad files are refused by name; what is written reads back."""

import base64
import struct
import subprocess
import sys
import textwrap
import zlib
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from material_palette.core import image
from material_palette.core.errors import PaletteError
from material_palette.core.image import (
    linear_from_srgb,
    read_codes,
    read_focal,
    read_mask,
    read_photo,
    srgb_from_linear,
    write_image,
)

FORMATS = {"uint8": oiio.UINT8, "uint16": oiio.UINT16, "float32": oiio.FLOAT}
# 32 x 32 px of C 0, M 255, Y 255, K 0 as Adobe writes them: pure red
CMYK_JPEG = base64.b64decode(
    "/9j/7gAOQWRvYmUAZAAAAAAA/9sAQwAQCwwODAoQDg0OEhEQExgoGhgWFhgxIyUdKDozPTw5Mzg3QEhcTkBEV0U3OFBtUVdfYmdoZz5NcXlwZHhc"
    "ZWdj/8AAFAgAIAAgBEMRAE0RAFkRAEsRAP/EAB8AAAEFAQEBAQEBAAAAAAAAAAABAgMEBQYHCAkKC//EALUQAAIBAwMCBAMFBQQEAAABfQECAwAE"
    "EQUSITFBBhNRYQcicRQygZGhCCNCscEVUtHwJDNicoIJChYXGBkaJSYnKCkqNDU2Nzg5OkNERUZHSElKU1RVVldYWVpjZGVmZ2hpanN0dXZ3eHl6"
    "g4SFhoeIiYqSk5SVlpeYmZqio6Slpqeoqaqys7S1tre4ubrCw8TFxsfIycrS09TV1tfY2drh4uPk5ebn6Onq8fLz9PX29/j5+v/aAA4EQwBNAFkA"
    "SwAAPwD0CvP68/r0Ciiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiiv/Z"
)


def store(path, pixels, tile=0, **attributes):
    """Write an image file with attributes, by OpenImageIO."""
    pixels = np.ascontiguousarray(pixels).reshape(*pixels.shape[:2], -1)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], FORMATS[str(pixels.dtype)])
    spec.tile_width = spec.tile_height = tile
    for name, value in attributes.items():
        if isinstance(value, tuple):
            spec.attribute(name.replace("__", ":"), *value)
        else:
            spec.attribute(name.replace("__", ":"), value)
    out = oiio.ImageOutput.create(str(path))
    assert out and out.open(str(path), spec) and out.write_image(pixels), oiio.geterror()
    out.close()
    return path


def noise(channels=3, height=40, width=56, dtype=np.uint8):
    return np.random.default_rng(1).integers(0, np.iinfo(dtype).max + 1, (height, width, channels), dtype)


def test_srgb_curve_has_the_standard_values():
    # IEC 61966-2-1, computed in double precision
    encoded = [0, 0.04045, 0.25, 0.5, 188 / 255, 1]
    linear = [0, 0.0031308049535603713, 0.05087608817155679, 0.21404114048223255, 0.5028864580325687, 1]
    np.testing.assert_allclose(linear_from_srgb(encoded), linear, rtol=2e-6)
    np.testing.assert_allclose(srgb_from_linear(linear), encoded, rtol=2e-6)
    assert srgb_from_linear(0.18) == pytest.approx(0.4613561295004415, rel=1e-6)
    levels = np.arange(65536) / 65535
    assert (np.rint(srgb_from_linear(linear_from_srgb(levels)) * 65535) == np.arange(65536)).all()
    assert linear_from_srgb(levels).dtype == srgb_from_linear(levels).dtype == np.float32


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integer_files_are_srgb(tmp_path, dtype):
    bgr = noise(dtype=dtype)
    cv2.imwrite(str(tmp_path / "a.png"), bgr)
    photo = read_photo(tmp_path / "a.png")
    np.testing.assert_allclose(photo.pixels, linear_from_srgb(bgr[..., ::-1] / np.iinfo(dtype).max), atol=1e-6)
    assert photo.pixels.dtype == np.float32 and photo.warnings == []


@pytest.mark.parametrize("name", ["a.exr", "a.tif", "a.hdr"])
def test_float_files_are_linear(tmp_path, name):
    pixels = noise().astype(np.float32) / 64  # beyond 1 as well
    photo = read_photo(store(tmp_path / name, pixels))
    np.testing.assert_allclose(photo.pixels, pixels, atol=0 if name != "a.hdr" else 0.02)
    assert photo.warnings == []


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied(tmp_path, orientation):
    y, x = np.mgrid[:40, :56]
    pixels = np.stack([4 * x, 5 * y, 3 * x + y], -1).astype(np.uint8)
    path = store(tmp_path / "a.jpg", pixels, Orientation=orientation, Compression="jpeg:98")
    upright = cv2.imread(str(path))[..., ::-1]  # OpenCV applies it too
    np.testing.assert_allclose(srgb_from_linear(read_photo(path).pixels) * 255, upright, atol=3)


@pytest.mark.parametrize("width, height", [(80, 60), (60, 80)])
@pytest.mark.parametrize("unit, length", [(2, 25.4), (3, 10.0), (4, 1.0), (5, 1e-3)])
def test_a_focal_length_by_the_sensors_resolution_counts_longer_sides(tmp_path, width, height, unit, length):
    exif = {"FocalLength": 50.0, "FocalPlaneXResolution": 2 * length, "FocalPlaneResolutionUnit": unit}
    exif |= {"PixelXDimension": width, "PixelYDimension": height}
    attributes = {f"Exif__{name}": value for name, value in exif.items()}
    path = store(tmp_path / "a.jpg", noise(3, height, width), **attributes)
    assert read_focal(path) == pytest.approx(100 / 80, rel=1e-3)  # 2 px a mm


def test_a_logluv_tiff_is_refused_with_the_way_out(tmp_path):
    pixels = np.full((40, 56, 3), 0.5, np.float32)
    cv2.imwrite(str(tmp_path / "a.tif"), pixels)
    with pytest.raises(PaletteError, match="a.tif' is stored as LOGLUV. Save it as RGB .*COMPRESSION 1"):
        read_photo(tmp_path / "a.tif")
    cv2.imwrite(str(tmp_path / "b.tif"), pixels, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    assert np.array_equal(read_photo(tmp_path / "b.tif").pixels, pixels)


def test_grey_and_grey_with_alpha_become_rgb(tmp_path):
    grey = noise(2)
    for path in (
        store(tmp_path / "g.png", grey[..., 0]),
        store(tmp_path / "ga.png", grey, oiio__UnassociatedAlpha=1),
    ):
        expected = np.repeat(linear_from_srgb(grey[..., :1] / 255), 3, -1)
        np.testing.assert_allclose(read_photo(path).pixels, expected, atol=1e-6)


def test_transparent_pixels_keep_their_colour_and_warn(tmp_path):
    bgra = noise(4)
    bgra[..., 3] = 255
    bgra[:10, :, 3] = 0
    cv2.imwrite(str(tmp_path / "a.png"), bgra)
    photo = read_photo(tmp_path / "a.png")
    np.testing.assert_allclose(photo.pixels, linear_from_srgb(bgra[..., 2::-1] / 255), atol=1e-6)
    assert len(photo.warnings) == 1 and "25 % of the photo is transparent" in photo.warnings[0]


def test_colour_multiplied_by_alpha_is_undone(tmp_path):
    colour = noise().astype(np.float32) / 255
    alpha = np.full((40, 56, 1), 0.5, np.float32)
    photo = read_photo(store(tmp_path / "a.exr", np.concatenate([colour * alpha, alpha], -1)))
    np.testing.assert_allclose(photo.pixels, colour, atol=1e-6)


def test_layered_exr_gives_its_colour_layer(tmp_path):
    pixels = noise(5).astype(np.float32) / 255
    spec = oiio.ImageSpec(56, 40, 5, oiio.FLOAT)
    spec.channelnames = ("Depth.Z", "Combined.A", "Combined.B", "Combined.G", "Combined.R")
    pixels[..., 1] = 1
    out = oiio.ImageOutput.create("a.exr")
    assert out.open(str(tmp_path / "a.exr"), spec) and out.write_image(pixels)
    out.close()
    np.testing.assert_allclose(read_photo(tmp_path / "a.exr").pixels, pixels[..., [4, 3, 2]], atol=1e-6)


def test_negative_values_become_zero_with_a_warning(tmp_path):
    pixels = np.full((40, 50, 3), 0.5, np.float32)
    pixels[:4, :, 1] = -1
    photo = read_photo(store(tmp_path / "a.exr", pixels))
    assert photo.pixels.min() == 0 and photo.pixels[:4, :, 0].max() == 0.5
    assert len(photo.warnings) == 1 and "10 %" in photo.warnings[0]


def test_palette_and_low_bit_pngs(tmp_path):
    colours = np.array([[200, 60, 30], [10, 20, 230]], np.uint8)
    index = np.zeros((32, 32), np.uint8)
    index[:, 16:] = 1

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    rows = b"".join(b"\0" + np.packbits(row).tobytes() for row in index)
    header = struct.pack(">IIBBBBB", 32, 32, 1, 3, 0, 0, 0)
    parts = [(b"IHDR", header), (b"PLTE", colours.tobytes()), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts))
    np.testing.assert_allclose(read_photo(tmp_path / "a.png").pixels, linear_from_srgb(colours[index] / 255), atol=1e-6)
    # Any non-zero colour belongs; both colours are.
    assert read_mask(tmp_path / "a.png", (32, 32)).all()


def test_cmyk_jpeg_is_read_with_a_warning(tmp_path):
    (tmp_path / "a.jpg").write_bytes(CMYK_JPEG)
    photo = read_photo(tmp_path / "a.jpg")
    np.testing.assert_allclose(photo.pixels, np.broadcast_to([1, 0, 0], (32, 32, 3)), atol=0.02)
    assert "CMYK" in photo.warnings[0]


def icc_profile(description):
    """The least of an ICC profile (version 2): a header and a description."""
    text = description.encode() + b"\0"
    tag = b"desc" + bytes(4) + struct.pack(">I", len(text)) + text + bytes(78)
    size = 128 + 4 + 12 + len(tag)
    header = struct.pack(">I4sI4s4s4s", size, b"test", 0x02100000, b"mntr", b"RGB ", b"XYZ ") + bytes(12) + b"acsp"
    return header.ljust(128, b"\0") + struct.pack(">I4sII", 1, b"desc", 144, len(tag)) + tag


# Linear RGB to linear Rec.709, from the published primaries (colour-science, Bradford)
P3 = [[1.2249401, -0.2249402, 0], [-0.0420569, 1.0420571, 0], [-0.0196376, -0.0786361, 1.0982735]]
ADOBE = [[1.3983557, -0.3983557, 0], [0, 1, 0], [0, -0.0429290, 1.0429290]]
ACESCG = [[1.7050515, -0.6217907, -0.0832584], [-0.1302571, 1.1408029, -0.0105485], [-0.0240033, -0.1289688, 1.1529717]]


@pytest.mark.parametrize(
    "description, matrix, decode",
    [
        ("Display P3", P3, linear_from_srgb),
        ("Adobe RGB (1998)", ADOBE, lambda x: x ** (563 / 256)),
        ("sRGB IEC61966-2.1", np.eye(3), linear_from_srgb),
    ],
)
def test_embedded_profiles_are_honoured(tmp_path, description, matrix, decode):
    pixels = noise() // 4 + 96  # well within both gamuts
    profile = np.frombuffer(icc_profile(description), np.uint8)
    path = store(tmp_path / "a.tif", pixels, ICCProfile=(oiio.TypeDesc(f"uint8[{len(profile)}]"), profile))
    photo = read_photo(path)
    np.testing.assert_allclose(photo.pixels, decode(pixels / 255) @ np.transpose(matrix), atol=2e-4)
    assert photo.warnings == []


def test_unknown_profile_warns(tmp_path):
    profile = np.frombuffer(icc_profile("My printer"), np.uint8)
    path = store(tmp_path / "a.tif", noise(), ICCProfile=(oiio.TypeDesc(f"uint8[{len(profile)}]"), profile))
    assert "'My printer' is not known" in read_photo(path).warnings[0]


def test_chromaticities_of_an_exr_are_honoured(tmp_path):
    acescg = np.array([0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767], np.float32)
    pixels = noise().astype(np.float32) / 512 + 0.4
    path = store(tmp_path / "a.exr", pixels, chromaticities=(oiio.TypeDesc("float[8]"), acescg))
    np.testing.assert_allclose(read_photo(path).pixels, pixels @ np.transpose(ACESCG), atol=2e-3)


def test_png_that_says_it_is_linear(tmp_path):
    path = store(tmp_path / "a.png", noise(), oiio__ColorSpace="Linear")
    np.testing.assert_allclose(read_photo(path).pixels, noise() / 255, atol=1e-6)


@pytest.mark.parametrize("tile", [0, 16])
@pytest.mark.parametrize("block_bytes", [image.BLOCK_BYTES, 60 * 4 * 3 * 7])
def test_reduction_averages_boxes_in_linear_light(tmp_path, monkeypatch, tile, block_bytes):
    monkeypatch.setattr(image, "BLOCK_BYTES", block_bytes)  # blocks that don't fall on the boxes' edges
    pixels = noise(height=48, width=60)
    photo = read_photo(store(tmp_path / "a.tif", pixels, tile=tile), max_pixels=32 * 40)
    linear = linear_from_srgb(pixels / 255)
    boxes = linear.repeat(2, 0).repeat(2, 1).reshape(32, 3, 40, 3, 3).mean((1, 3))  # 1.5 px a side
    np.testing.assert_allclose(photo.pixels, boxes, atol=1e-5)
    assert len(photo.warnings) == 1 and "from 60 x 48 px to 40 x 32 px" in photo.warnings[0]


def test_reduced_sideways_photo_names_upright_sizes(tmp_path):
    photo = read_photo(store(tmp_path / "a.png", noise(height=48, width=60), Orientation=6), max_pixels=32 * 40)
    assert photo.pixels.shape == (40, 32, 3)
    assert "from 48 x 60 px to 32 x 40 px" in photo.warnings[0]


@pytest.mark.parametrize("tile", [0, 256])
def test_huge_photo_is_read_in_bounded_memory(tmp_path, tile):
    """80 megapixels are 960 MB as floats; reading them down to 1 megapixel takes a fraction."""
    out = oiio.ImageOutput.create("a.tif")
    spec = oiio.ImageSpec(10240, 8192, 3, oiio.UINT8)
    spec.attribute("compression", "packbits")
    spec.tile_width = spec.tile_height = tile
    assert out.open(str(tmp_path / "a.tif"), spec)
    rows = np.full((256, 10240, 3), 188, np.uint8)
    for y in range(0, 8192, 256):
        assert out.write_tiles(0, 10240, y, y + 256, 0, 1, rows) if tile else out.write_scanlines(y, y + 256, 0, rows)
    out.close()
    code = f"""
        import resource, sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        import conftest
        from material_palette.core.image import read_photo
        peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        before = peak()
        photo = read_photo({str(tmp_path / "a.tif")!r}, max_pixels=1_000_000)
        print((peak() - before) / 1e6, photo.pixels.size, photo.pixels.min(), photo.pixels.max(), *photo.warnings)
    """
    pytest.importorskip("resource", reason="peak memory is measured on Linux and macOS")
    run = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    megabytes, size, least, greatest, *words = run.stdout.split()
    assert float(megabytes) < 200
    assert 2_990_000 < int(size) <= 3_000_000
    assert float(least) == pytest.approx(0.50289, abs=1e-4) and float(greatest) == pytest.approx(0.50289, abs=1e-4)
    assert "from 10240 x 8192 px to 1118 x 894 px" in " ".join(words)


def cut(path, pixels, share, **attributes):
    store(path, pixels, **attributes)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    return path


BAD_PHOTOS = {
    "missing": (lambda f: f / "none.png", "doesn't exist"),
    "in a file": (lambda f: store(f / "a.png", noise()) / "b.png", "can't be opened"),
    "a folder": (lambda f: f, "is a folder"),
    "no name": (lambda f: "nul\0name.png", "can't be opened"),
    "1 x 1": (lambda f: store(f / "a.png", noise(height=1, width=1)), "1 x 1 px, too small"),
    "31 high": (lambda f: store(f / "a.png", noise(height=31, width=400)), "400 x 31 px, too small"),
    "cut JPEG": (lambda f: cut(f / "a.jpg", noise(), 0.6), "damaged or cut off"),
    "JPEG without its end": (lambda f: cut(f / "a.jpg", noise(), 0.999), "damaged or cut off"),
    "cut PNG": (lambda f: cut(f / "a.png", noise(), 0.6), "damaged or cut off"),
    "cut TIFF": (lambda f: cut(f / "a.tif", noise(height=100, width=200), 0.6, tile=16), "a.tif"),
    "cut EXR": (lambda f: cut(f / "a.exr", noise().astype(np.float32), 0.6), "damaged or cut off"),
    "NaN": (lambda f: store(f / "a.exr", np.full((40, 40, 3), np.nan, np.float32)), "not finite"),
    "infinite": (lambda f: store(f / "a.exr", np.full((40, 40, 3), np.inf, np.float32)), "not finite"),
    "two channels": (lambda f: store(f / "a.tif", noise(2), oiio__UnassociatedAlpha=1), None),
    "five channels": (lambda f: store(f / "a.tif", noise(5)), None),
}


@pytest.mark.parametrize("case", ["empty", "text", "null", *BAD_PHOTOS])
def test_bad_photos_are_refused_by_name(tmp_path, case):
    if case in ("empty", "text", "null"):
        path = tmp_path / ("a.null" if case == "null" else "a.jpg")
        path.write_text("" if case == "empty" else "a shopping list")
        words = "is empty" if case == "empty" else "can't be read as an image"
    else:
        make, words = BAD_PHOTOS[case]
        path = make(tmp_path)
    if words is None:  # channels without a meaning may be read or refused, as the file names them
        try:
            assert read_photo(path).pixels.shape == (40, 56, 3)
        except PaletteError as error:
            assert "not RGB or grey" in str(error)
        return
    with pytest.raises(PaletteError, match="(?s)Photo.*" + words) as error:
        read_photo(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_unreadable_file_names_its_permissions(tmp_path, monkeypatch):
    path = store(tmp_path / "a.png", noise())

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(image, "open", refuse, raising=False)  # root may read any file
    with pytest.raises(PaletteError, match="a.png' can't be opened: Permission denied"):
        read_photo(path)


def disc(height=48, width=60):
    y, x = np.mgrid[:height, :width]
    return (x - 30) ** 2 + (y - 20) ** 2 < 200


def test_any_pixel_that_is_not_black_belongs(tmp_path):
    mask = disc()
    for number, colour in enumerate([(255, 255, 255), (0, 0, 1), (0, 7, 0), (1, 0, 0)]):
        cv2.imwrite(str(tmp_path / f"{number}.png"), mask[..., None] * np.array(colour, np.uint8))
        assert (read_mask(tmp_path / f"{number}.png", mask.shape) == mask).all()
    cv2.imwrite(str(tmp_path / "grey.png"), mask.astype(np.uint8))
    cv2.imwrite(str(tmp_path / "sixteen.png"), mask.astype(np.uint16))
    for name in ("grey.png", "sixteen.png"):
        assert (read_mask(tmp_path / name, mask.shape) == mask).all()
    store(tmp_path / "float.exr", mask.astype(np.float32) * 1e-3)
    assert (read_mask(tmp_path / "float.exr", mask.shape) == mask).all()


@pytest.mark.parametrize("painted, hidden", [(255, 255), (255, 0), (0, 0), (0, 255)])
def test_alpha_decides_where_it_varies(tmp_path, painted, hidden):
    mask = disc()
    colour = np.where(mask, painted, hidden).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([colour] * 3 + [mask * np.uint8(255)]))
    assert (read_mask(tmp_path / "a.png", mask.shape) == mask).all()


def test_opaque_black_around_paint_does_not_belong(tmp_path):
    mask = disc()
    alpha = np.full(mask.shape, 255, np.uint8)
    alpha[:3] = 0
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([mask * np.uint8(255)] * 3 + [alpha]))
    assert (read_mask(tmp_path / "a.png", mask.shape) == mask).all()


def test_mask_in_a_jpeg_has_no_rim_of_noise(tmp_path):
    mask = disc()
    cv2.imwrite(str(tmp_path / "a.jpg"), mask * np.uint8(255), [cv2.IMWRITE_JPEG_QUALITY, 90])
    read = read_mask(tmp_path / "a.jpg", mask.shape)
    grown = cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))) > 0
    assert (read[mask]).mean() > 0.99 and not read[~grown].any()


@pytest.mark.parametrize("shape", [(24, 30), (32, 40), (48, 60), (96, 120), (97, 120)])
def test_masks_are_resized_to_the_nearest_pixel(tmp_path, shape):
    mask = disc()
    cv2.imwrite(str(tmp_path / "a.png"), mask * np.uint8(255))
    read = read_mask(tmp_path / "a.png", shape)
    rows = [min(47, int((y + 0.5) * 48 / shape[0])) for y in range(shape[0])]
    columns = [min(59, int((x + 0.5) * 60 / shape[1])) for x in range(shape[1])]
    assert (read == mask[rows][:, columns]).all()


def test_mask_with_orientation_fits_the_upright_photo(tmp_path):
    mask = disc()
    store(tmp_path / "a.png", mask * np.uint8(255), Orientation=6)
    assert (read_mask(tmp_path / "a.png", (60, 48)) == np.rot90(mask, -1)).all()
    assert (read_codes(tmp_path / "a.png", (60, 48))[..., 0] == 255 * np.rot90(mask, -1)).all()
    with pytest.raises(PaletteError, match="another shape"):
        read_codes(tmp_path / "a.png", (48, 60))


def test_mask_of_another_shape_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), disc() * np.uint8(255))
    with pytest.raises(PaletteError, match=r"a.png' is 60 x 48 px, of another shape than the photo \(48 x 60 px\)"):
        read_mask(tmp_path / "a.png", (60, 48))
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:-40])
    with pytest.raises(PaletteError, match="Mask .*b.png' is damaged"):
        read_mask(tmp_path / "b.png", (48, 60))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("shape", [(256, 256), (128, 128, 3)])
def test_written_images_hold_every_level(tmp_path, bits, shape):
    levels = np.resize(np.arange(2**bits), shape)
    write_image(tmp_path / "a.png", levels / (2**bits - 1), bits)
    read = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert read.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert (read == (levels if len(shape) == 2 else levels[..., ::-1])).all()


def test_written_images_clip_and_refuse_what_is_no_image(tmp_path):
    write_image(tmp_path / "a.png", np.array([[-1.0, 0.5, 2.0]]))
    assert cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED).tolist() == [[0, 128, 255]]
    for bad, bits in ((np.zeros((4, 4, 2)), 8), (np.zeros((4, 4)), 12), (np.full((4, 4), np.nan), 8)):
        with pytest.raises(ValueError):
            write_image(tmp_path / "b.png", bad, bits)
    assert [f.name for f in tmp_path.iterdir()] == ["a.png"]


def test_written_bytes_depend_on_the_pixels_alone(tmp_path):
    pixels = np.random.default_rng(0).random((64, 64, 3)).astype(np.float32)
    for name in ("a.png", "b.png"):
        write_image(tmp_path / name, pixels, 16)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    kinds, at = [], 8
    written = (tmp_path / "a.png").read_bytes()
    while at < len(written):
        (length,) = struct.unpack(">I", written[at : at + 4])
        kinds.append(written[at + 4 : at + 8])
        at += 12 + length
    assert set(kinds) == {b"IHDR", b"IDAT", b"IEND"}  # no dates, no software


def test_a_failing_write_leaves_no_part_of_a_file(tmp_path, monkeypatch):
    (tmp_path / "a.png").write_text("before")

    def fail(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(image.os, "replace", fail)
    with pytest.raises(OSError):
        write_image(tmp_path / "a.png", np.zeros((8, 8)))
    assert [f.name for f in tmp_path.iterdir()] == ["a.png"] and (tmp_path / "a.png").read_text() == "before"
