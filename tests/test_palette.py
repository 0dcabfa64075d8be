import hashlib
import importlib
import json
import threading
import time

import cv2
import numpy as np
import pytest
from material_palette.core import decomposition
from material_palette.core.errors import Cancelled, PaletteError
from material_palette.core.image import linear_from_srgb, srgb_from_linear
from material_palette.core.palette import Settings, extract_palette, preview_exemplar, write_palette
from material_palette.core.region import Region
from material_palette.core.torus import WRAP_GATE, wrap_ratio
from textures import pebbles, quiet

SETTINGS = Settings(quality="draft", resolution=128, full_maps=True)
PAINT = np.array([0.5, 0.1, 0.08], np.float32)


def photo_and_regions():
    pixels = linear_from_srgb(pebbles(160, 320))
    pixels[:, 200:] = PAINT
    masks = {name: np.zeros((160, 320), bool) for name in ("gravel", "paint", "speck")}
    masks["gravel"][5:150, 5:190] = True
    masks["paint"][5:150, 210:310] = True
    masks["speck"][3:6, 3:6] = True
    return pixels, [Region(name, mask) for name, mask in masks.items()]


@pytest.fixture(scope="module")
def palette():
    return extract_palette(*photo_and_regions(), SETTINGS, quiet, photo_name="wall.jpg")


@pytest.fixture(scope="module")
def written(palette, tmp_path_factory):
    folder = tmp_path_factory.mktemp("palette")
    return folder, write_palette(palette, folder)


def digests(folder):
    return {p.relative_to(folder): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.rglob("*.png"))}


def test_one_bad_region_is_reported_and_the_others_are_made(palette):
    gravel, paint, speck = palette.materials
    assert [m.status for m in palette.materials] == ["ok", "ok", "failed"]
    assert "speck" in speck.error and "576 px" in speck.error
    assert gravel.svbrdf.albedo.shape == (128, 128, 3)
    assert not np.ndim(paint.svbrdf.roughness)


@pytest.mark.parametrize("where", ["core.palette.cut_exemplar", "core.decomposition.decompose"])
def test_a_mistake_of_ours_costs_one_region(where, monkeypatch, capsys):
    photo, regions = photo_and_regions()
    module, name = where.rsplit(".", 1)
    module = importlib.import_module(f"material_palette.{module}")
    sound = getattr(module, name)

    calls = []

    def broken(*args):
        calls.append(args)
        if len(calls) == 1:  # the gravel's; the paint is a constant
            raise ZeroDivisionError("by nothing")
        return sound(*args)

    monkeypatch.setattr(module, name, broken)
    palette = extract_palette(photo, regions[:2], SETTINGS, quiet)
    assert [m.status for m in palette.materials] == ["failed", "ok"]
    assert "ZeroDivisionError: by nothing" in palette.materials[0].error
    assert "Traceback" in capsys.readouterr().err


def test_a_region_of_one_colour_becomes_a_constant(palette):
    paint = palette.materials[1]
    assert np.allclose(paint.svbrdf.albedo, PAINT, rtol=0.03)
    assert paint.svbrdf.normal.tolist() == [0, 0, 1] and paint.svbrdf.height is None
    assert any("one colour" in warning for warning in paint.warnings)
    assert paint.seconds.get("sample") is None


def test_pieces_beside_a_region_change_nothing():
    photo, (gravel, _, _) = photo_and_regions()
    strays = gravel.mask.copy()
    strays[20:40, 280:300] = True
    clean, soiled = (preview_exemplar(photo, Region("gravel", mask), SETTINGS, quiet) for mask in (gravel.mask, strays))
    assert np.array_equal(clean[0], soiled[0])
    assert soiled[1] == ["1% of the region, pieces beside it, is left out", *clean[1]]


def test_files_are_those_of_the_record_and_every_map_tiles(palette, written):
    folder, content = written
    assert content == json.loads((folder / "palette.json").read_text(encoding="utf-8"))
    assert content["version"] == 1 and content["photo"] == "wall.jpg" and content["settings"]["resolution"] == 128
    gravel, paint, speck = content["materials"]
    assert json.loads((folder / "gravel" / "gravel.json").read_text(encoding="utf-8")) == gravel
    assert set(gravel["maps"]) == set(paint["maps"]) == {"basecolor", "normal", "roughness", "height"}
    assert speck["maps"] == {} and speck["error"]
    files = {m["file"] for m in gravel["maps"].values() if "file" in m}
    assert files == {p.relative_to(folder).as_posix() for p in folder.glob("gravel/*.png")}
    for file in files:
        pixels = cv2.imread(str(folder / file), cv2.IMREAD_UNCHANGED)
        assert pixels.shape[:2] == (128, 128)
        assert pixels.dtype == (np.uint16 if file.endswith("_height.png") else np.uint8)
        assert wrap_ratio(pixels.astype(np.float32)) <= WRAP_GATE, file
    assert not (folder / "paint").joinpath("paint_basecolor.png").exists()
    assert sorted(p.name for p in (folder / "masks").iterdir()) == ["gravel.png", "paint.png", "speck.png"]


def test_what_a_material_was_learnt_from_is_written(palette, written):
    folder, content = written
    for material, record in zip(palette.materials[:2], content["materials"], strict=False):
        assert record["exemplar"] == f"exemplars/{material.name}.png"
        picture = cv2.imread(str(folder / record["exemplar"]))[..., ::-1]
        assert np.array_equal(picture, material.exemplar)
    assert content["materials"][2]["exemplar"] is None
    assert np.abs(palette.materials[0].exemplar.mean() / 255 - pebbles(160, 320)[5:150, 5:190].mean()) < 0.05


def test_files_hold_the_maps(palette, written):
    folder, content = written
    svbrdf, maps = palette.materials[0].svbrdf, content["materials"][0]["maps"]
    colour = cv2.imread(str(folder / maps["basecolor"]["file"]))[..., ::-1] / 255
    assert np.abs(colour - srgb_from_linear(svbrdf.albedo)).max() < 0.6 / 255
    normal = cv2.imread(str(folder / maps["normal"]["file"]))[..., ::-1] / 255 * 2 - 1
    assert np.abs(normal - svbrdf.normal).max() < 1.2 / 255
    height = cv2.imread(str(folder / maps["height"]["file"]), cv2.IMREAD_UNCHANGED) / 65535
    height = (height - maps["height"]["midlevel"]) * maps["height"]["scale"]
    assert np.abs(height - svbrdf.height).max() < maps["height"]["scale"] / 60000


def test_a_mask_written_is_the_region(palette, written):
    mask = cv2.imread(str(written[0] / "masks" / "gravel.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(mask > 0, palette.regions[0].mask)


def test_the_same_seed_gives_the_same_files_and_another_others(written, tmp_path):
    folders = []
    for seed in (0, 1):
        folders.append(tmp_path / str(seed))
        folders[-1].mkdir()
        settings = Settings(quality="draft", resolution=128, seed=seed, full_maps=True)
        write_palette(extract_palette(*photo_and_regions(), settings, quiet), folders[-1])
    one, same, other = (digests(folder) for folder in (written[0], *folders))
    assert same == one
    assert any(other[name] != digest for name, digest in one.items())


def test_a_regions_result_does_not_depend_on_the_others(palette):
    pixels, regions = photo_and_regions()
    alone = extract_palette(pixels, regions[:1], SETTINGS, quiet).materials[0]
    assert np.array_equal(alone.svbrdf.albedo, palette.materials[0].svbrdf.albedo)


def test_progress_rises_to_one_and_materials_arrive_as_they_are_done():
    fractions, arrived = [], []
    extract_palette(
        *photo_and_regions(), SETTINGS, lambda fraction, message: fractions.append(fraction), arrived.append
    )
    assert fractions == sorted(fractions) and fractions[-1] == 1
    assert sorted(m.name for m in arrived) == ["gravel", "paint", "speck"]


def test_a_material_that_fails_behind_the_others_does_not_stop_them(monkeypatch):
    pixels, regions = photo_and_regions()
    again = Region("gravel again", regions[0].mask)
    whole, calls = decomposition.decompose, []

    def fails_at_first(texture, progress, decomposer):
        calls.append(threading.current_thread())
        if len(calls) == 1:
            raise PaletteError("these weights can't be read")
        return whole(texture, progress, decomposer)

    monkeypatch.setattr(decomposition, "decompose", fails_at_first)
    seen = []
    made = extract_palette(pixels, [regions[0], again], SETTINGS, quiet, seen.append).materials
    assert [m.error for m in made] == ["these weights can't be read", None] and seen == made
    assert threading.main_thread() not in calls and len(calls) == 2


def test_what_on_material_raises_ends_the_extraction():
    def full(material):
        raise OSError("no space left on device")

    with pytest.raises(OSError, match="no space left"):
        extract_palette(*photo_and_regions(), SETTINGS, quiet, full)


def test_cancelling_takes_half_a_second_at_most():
    started = []

    def progress(fraction, message):
        if fraction > 0.2:
            started.append(time.process_time())
            raise Cancelled

    pixels, regions = photo_and_regions()
    with pytest.raises(Cancelled):
        extract_palette(pixels, regions[:1] * 3, Settings(resolution=1024), progress)
    # of processor time: other programs may have the processor meanwhile
    assert time.process_time() - started[0] < 0.5


@pytest.mark.parametrize(
    "changed, said",
    [
        ({"engine": "magic"}, "engine 'magic'"),
        ({"quality": "superb"}, "quality 'superb'"),
        ({"resolution": 0}, "resolution 0"),
        ({"resolution": 9000}, "64 to 8192"),
        ({"seed": -1}, "seed -1"),
        ({"white_balance": "warm"}, "white balance 'warm'"),
        ({"white_balance": "card"}, "needs the grey card's colour"),
        ({"white_balance": "card", "grey_card": (0.2, 0.0, 0.1)}, "needs the grey card's colour"),
        ({"metres_per_tile": float("nan")}, "metres per tile"),
    ],
)
def test_a_setting_that_cannot_be_honoured_is_named(changed, said):
    with pytest.raises(PaletteError, match=said):
        extract_palette(*photo_and_regions(), Settings(**changed), quiet)


def test_no_region_is_said():
    with pytest.raises(PaletteError, match="no region"):
        extract_palette(photo_and_regions()[0], [], SETTINGS, quiet)


def test_two_regions_of_one_file_name_are_refused():
    pixels, (gravel, paint, _) = photo_and_regions()
    regions = [Region("a/b", gravel.mask), Region("A_b", paint.mask)]
    with pytest.raises(PaletteError, match="'a/b' and 'A_b' would name one material"):
        extract_palette(pixels, regions, SETTINGS, quiet)


def test_the_sheet_shows_every_material(written):
    picture = cv2.imread(str(written[0] / "palette.png"))
    # the constant paint fills the base colour column of the second row with its own colour
    assert picture.shape[1] > 1500
    expected = srgb_from_linear(PAINT)[::-1] * 255
    assert (np.abs(picture - expected).max(-1) < 6).sum() > 200 * 200
