"""The command line on bad and on partly bad input; needs bpy, for palette.blend."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from textures import pebbles

pytest.importorskip("bpy", reason="palette.blend is written by Blender")
from material_palette.core.command import main  # noqa: E402
from material_palette.core.image import linear_from_srgb  # noqa: E402
from material_palette.core.tensors import write_tensors  # noqa: E402


@pytest.fixture
def inputs(tmp_path):
    """A folder with photo.png, masks/a.png, masks/b.png."""
    photo = pebbles(120, 200)
    photo[:, 110:] = photo[:, 110:, ::-1]
    cv2.imwrite(str(tmp_path / "photo.png"), np.rint(photo * 255).astype(np.uint8))
    (tmp_path / "masks").mkdir()
    for name, columns in {"a": slice(4, 100), "b": slice(112, 196)}.items():
        mask = np.zeros((120, 200), np.uint8)
        mask[4:116, columns] = 255
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), mask)
    return tmp_path


def extract(folder, *more, photos=("photo.png",), masks="masks", out="out"):
    where = ["--masks", str(folder / masks)] if masks else []
    settings = ["--resolution", "96", "--quality", "draft"]
    photos = [str(folder / photo) for photo in photos]
    return main(["extract", *photos, *where, *settings, *more, "-o", str(folder / out)])


def bad_mask(folder, pixels, name="a.png"):
    cv2.imwrite(str(folder / "masks" / name), pixels)


def test_a_palette_is_written(inputs, capsys):
    assert extract(inputs) == 0
    out = inputs / "out"
    names = {p.name for p in out.iterdir()}
    assert {"palette.blend", "palette.json", "palette.png", "masks", "a", "b"} <= names
    content = json.loads((out / "palette.json").read_text(encoding="utf-8"))
    assert [m["status"] for m in content["materials"]] == ["ok", "ok"]
    assert (out / "palette.blend").stat().st_size > 10_000
    # the masks that were used can be passed back
    assert extract(inputs, masks="out/masks", out="again") == 0
    assert (inputs / "again/a/a_basecolor.png").read_bytes() == (out / "a/a_basecolor.png").read_bytes()


def test_a_grey_card_in_another_photo_sets_how_bright_base_colours_are(inputs, capsys):
    cv2.imwrite(str(inputs / "card.png"), np.full((50, 60, 3), 162, np.uint8))  # linear 0.36: twice as bright as it is

    def mean(out):
        encoded = cv2.imread(str(inputs / out / "a/a_basecolor.png")) / 255
        return float(np.mean(linear_from_srgb(encoded)))

    card = f"{inputs / 'card.png'}:5,5 50,40"
    assert extract(inputs) == extract(inputs, "--grey-card", card, out="lit") == 0
    assert mean("lit") / mean("out") == pytest.approx(0.5, rel=0.1)
    settings = json.loads((inputs / "lit/palette.json").read_text(encoding="utf-8"))["settings"]
    assert settings["white_balance"] == "card" and settings["grey_card"] == pytest.approx([0.36] * 3, abs=0.005)
    for wrong, words in (("5,5", "X,Y X,Y"), ("5,5 500,40", "inside the photo's 200 x 120 px")):
        assert extract(inputs, "--grey-card", wrong, out="none") == 2 and words in capsys.readouterr().err
    assert extract(inputs, "--grey-card", card, "--white-balance", "region", out="none") == 2
    assert "leave one out" in capsys.readouterr().err and not (inputs / "none").exists()


def spoil(name):
    """What each case does to the inputs, and the arguments and words of the error that go with it."""

    def photo(content):
        return lambda f: (f / "photo.png").write_bytes(content)

    def truncate(f):
        whole = (f / "photo.png").read_bytes()
        (f / "photo.png").write_bytes(whole[: len(whole) // 2])

    def two_of_one_name(f):
        cv2.imwrite(str(f / "masks" / "a.tif"), np.full((120, 200), 255, np.uint8))

    def existing_output(f):
        (f / "out").mkdir()
        (f / "out" / "mine.txt").write_text("mine")

    nothing = lambda f: None  # noqa: E731
    return {
        "missing photo": (lambda f: (f / "photo.png").unlink(), {}, "photo.png"),
        "empty photo": (photo(b""), {}, "photo.png"),
        "no image": (photo(b"this is no image at all" * 50), {}, "photo.png"),
        "truncated photo": (truncate, {}, "photo.png"),
        "one pixel": (lambda f: cv2.imwrite(str(f / "photo.png"), np.zeros((1, 1, 3), np.uint8)), {}, "1 x 1"),
        "missing masks": (nothing, {"masks": "nowhere"}, "nowhere"),
        "no masks": (lambda f: [p.unlink() for p in (f / "masks").iterdir()], {}, "masks"),
        "mask of another shape": (lambda f: bad_mask(f, np.full((50, 200), 255, np.uint8)), {}, "a.png"),
        "two masks of one name": (two_of_one_name, {}, "a.tif"),
        "resolution 0": (nothing, {"more": ["--resolution", "0"]}, "resolution 0"),
        "huge resolution": (nothing, {"more": ["--resolution", "100000"]}, "8192"),
        "unknown engine": (nothing, {"more": ["--engine", "magic"]}, "engine 'magic'"),
        "unknown segmenter": (nothing, {"masks": None, "more": ["--segment", "magic"]}, "magic"),
        "diffusion's option": (nothing, {"more": ["--tuning-steps", "9"]}, "'patch' has no --tuning-steps"),
        "weights of nothing": (nothing, {"more": ["--weights", "sam"]}, "--masks needs no --weights"),
        "number of given regions": (nothing, {"more": ["--regions", "3"]}, "--regions"),
        "no regions asked": (nothing, {"masks": None}, "--masks"),
        "existing output": (existing_output, {}, "--overwrite"),
        "unwritable output": (nothing, {"out": "photo.png/out"}, "photo.png"),
        "only an empty mask": (lambda f: [bad_mask(f, np.zeros((120, 200)), n) for n in ("a.png", "b.png")], {}, "'a'"),
    }[name]


CASES = [
    "missing photo",
    "empty photo",
    "no image",
    "truncated photo",
    "one pixel",
    "missing masks",
    "no masks",
    "mask of another shape",
    "two masks of one name",
    "resolution 0",
    "huge resolution",
    "unknown engine",
    "unknown segmenter",
    "diffusion's option",
    "weights of nothing",
    "number of given regions",
    "no regions asked",
    "existing output",
    "unwritable output",
    "only an empty mask",
]


@pytest.mark.parametrize("name", CASES)
def test_bad_input_is_named_and_nothing_is_written(inputs, capfd, name):
    change, how, said = spoil(name)
    change(inputs)
    before = sorted(p for p in inputs.rglob("*"))
    assert extract(inputs, *how.get("more", []), masks=how.get("masks", "masks"), out=how.get("out", "out")) == 2
    error = capfd.readouterr().err
    assert said in error and "Traceback" not in error
    assert sorted(p for p in inputs.rglob("*")) == before


@pytest.mark.parametrize("pixels", [np.zeros((120, 200), np.uint8), np.pad(np.full((8, 8), 255, np.uint8), 10)])
def test_one_bad_region_gives_code_3_and_the_others(inputs, capfd, pixels):
    bad_mask(inputs, cv2.copyMakeBorder(pixels, 0, 120 - len(pixels), 0, 200 - len(pixels[0]), cv2.BORDER_CONSTANT))
    assert extract(inputs) == 3
    content = json.loads((inputs / "out" / "palette.json").read_text(encoding="utf-8"))
    assert [m["status"] for m in content["materials"]] == ["failed", "ok"]
    assert "'a'" in content["materials"][0]["error"]
    assert (inputs / "out" / "b" / "b_basecolor.png").exists() and not (inputs / "out" / "a").exists()


def test_overwrite_replaces_the_palette_and_nothing_else(inputs):
    assert extract(inputs) == 0
    (inputs / "out" / "notes.txt").write_text("mine")
    (inputs / "masks" / "b.png").unlink()
    assert extract(inputs) == 2
    assert extract(inputs, "--overwrite", "--seed", "5") == 0
    assert (inputs / "out" / "notes.txt").read_text() == "mine"
    assert not (inputs / "out" / "b").exists()


def test_regions_are_found_without_masks(inputs):
    assert extract(inputs, "--segment", "auto", "--regions", "3", masks=None) == 0
    content = json.loads((inputs / "out" / "palette.json").read_text(encoding="utf-8"))
    assert 1 <= len(content["materials"]) <= 3


def test_several_photos_make_a_folder_each_and_a_bad_one_does_not_stop_the_rest(inputs, capfd):
    (inputs / "masks2" / "photo").mkdir(parents=True)
    (inputs / "masks" / "a.png").rename(inputs / "masks2" / "photo" / "a.png")
    (inputs / "broken.png").write_bytes(b"no image")
    code = extract(inputs, photos=("broken.png", "photo.png"), masks="masks2")
    assert code == 2 and "broken.png" in capfd.readouterr().err
    assert (inputs / "out" / "photo" / "palette.blend").exists()
    assert not (inputs / "out" / "broken").exists()


def test_a_kept_concept_gives_the_same_texture_again_and_others(inputs):
    assert extract(inputs, "--keep-concepts") == 0
    concepts = [str(inputs / f"out/{name}/{name}_concept.json") for name in "ab"]
    assert main(["resample", *concepts, "--resolution", "96", "--quality", "draft", "-o", str(inputs / "again")]) == 0
    first, again = (json.loads((inputs / f"{out}/palette.json").read_text())["materials"] for out in ("out", "again"))
    assert [m["metres_per_tile"] for m in again] == [m["metres_per_tile"] for m in first]
    assert [m["exemplar"] for m in again] == [None, None]
    assert not (inputs / "again/exemplars").exists() and not (inputs / "again/masks").exists()
    for name in "ab":
        file = f"{name}/{name}_basecolor.png"
        assert (inputs / "again" / file).read_bytes() == (inputs / "out" / file).read_bytes()
    large = ["--resolution", "256", "--scale", "2", "--full-maps", "--overwrite", "-o", str(inputs / "again")]
    assert main(["resample", concepts[0], *large]) == 0
    (material,) = json.loads((inputs / "again/palette.json").read_text())["materials"]
    assert material["metres_per_tile"] == pytest.approx(128 / 96)
    assert cv2.imread(str(inputs / "again/a/a_basecolor.png")).shape == (256, 256, 3)


@pytest.mark.parametrize("damage", ["missing", "not json", "no periods", "other shape", "cut short", "no size"])
def test_a_damaged_concept_is_named(inputs, capsys, damage):
    assert extract(inputs, "--keep-concepts") == 0
    path = inputs / "out/a/a_concept.json"
    if damage == "missing":
        path.unlink()
    elif damage == "not json":
        path.write_text("{")
    elif damage == "no periods":
        path.write_text(json.dumps(json.loads(path.read_text()) | {"periods": None}))
    elif damage == "no size":
        path.write_text(json.dumps(json.loads(path.read_text()) | {"metres_per_texel": 0}))
    elif damage == "cut short":
        tensors = path.with_suffix(".safetensors")
        tensors.write_bytes(tensors.read_bytes()[:-9])
    else:
        write_tensors(path.with_suffix(".safetensors"), {"pixels": np.zeros((9, 9, 3)), "mask": np.ones((8, 9), bool)})
    assert main(["resample", str(path), "-o", str(inputs / "again")]) == 2
    assert "a_concept" in capsys.readouterr().err
    assert not (inputs / "again").exists()


def test_resampling_does_not_replace_the_folder_of_its_concept(inputs, capsys):
    assert extract(inputs, "--keep-concepts") == 0
    path = inputs / "out/a/a_concept.json"
    assert main(["resample", str(path), "--overwrite", "-o", str(inputs / "out")]) == 2
    assert "name another folder" in capsys.readouterr().err
    assert path.exists() and (inputs / "out/b/b_basecolor.png").exists()


def test_a_wrong_file_of_weights_is_named_before_anything_is_sampled(inputs, capsys):
    (inputs / "model.ckpt").write_text("hello")
    assert extract(inputs, "--decomposer", f"resnet101={inputs / 'model.ckpt'}") == 2
    said = capsys.readouterr()
    assert "model.ckpt' holds more than tensors, or is no checkpoint" in said.err and "Traceback" not in said.err
    assert "a:" not in said.out and "no material" not in said.err


def test_concepts_of_diffusion_have_a_folder_of_their_own(inputs, capsys):
    assert extract(inputs, "--keep-concepts", "--engine", "diffusion", "--model", "nowhere") == 2
    assert "--concepts DIR" in capsys.readouterr().err
    assert not (inputs / "out").exists()


def test_a_texture_too_small_or_large_for_its_scale_is_refused(inputs, capsys):
    assert extract(inputs, "--resolution", "8192", "--scale", "0.5") == 2
    assert "16384 px" in capsys.readouterr().err


def test_a_camera_that_needs_more_than_the_maps_have_gets_it_from_the_concept(inputs, capsys):
    import bpy
    from material_palette.core.nodes import build_material
    from material_palette.core.palette import read_palette, write_material
    from material_palette.core.reduction import shrink
    from stage import camera, plane

    assert extract(inputs, "--keep-concepts", "--full-maps") == 0
    whole = cv2.imread(str(inputs / "out/a/a_basecolor.png")).astype(float)
    # as a palette that was reduced too far: 24 of 96 texels
    content, materials, _ = read_palette(inputs / "out")
    materials[0].svbrdf = shrink(materials[0].svbrdf, 24)
    content["materials"][0] = write_material(materials[0], inputs / "out" / "a")
    (inputs / "out" / "palette.json").write_text(json.dumps(content))
    blurred = cv2.resize(cv2.imread(str(inputs / "out/a/a_basecolor.png")).astype(float), (96, 96))

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.resolution_x = scene.render.resolution_y = 200
    scene.render.resolution_percentage, scene.frame_end = 100, 1
    plane("wall", build_material(content["materials"][0], inputs / "out", pack=True), 2.0)
    camera("near", (0, 0, 5), scale=1.0)  # a tile is 200 px long
    bpy.ops.wm.save_as_mainfile(filepath=str(inputs / "scene.blend"))
    arguments = ["fit", str(inputs / "out"), "--scene", str(inputs / "scene.blend"), "-o", str(inputs / "near")]
    assert main(arguments) == 0
    assert "a: sampled again from its concept" in capsys.readouterr().out
    (record, *_) = json.loads((inputs / "near/palette.json").read_text())["materials"]
    assert record["metres_per_tile"] == pytest.approx(1.0)
    found = cv2.imread(str(inputs / "near" / record["maps"]["basecolor"]["file"])).astype(float)
    assert found.shape == whole.shape
    # the region's own detail is there again, not a blown-up blur
    assert np.abs(found - whole).mean() < 0.2 * np.abs(blurred - whole).mean()


def test_maps_of_the_same_bits_are_one_file(inputs):
    import bpy
    from material_palette.core.palette import Palette, read_palette, write_palette
    from material_palette.core.reduction import maps_of

    assert extract(inputs, "--full-maps") == 0
    (a, b), settings = read_palette(inputs / "out")[1:]
    b.svbrdf.normal, b.svbrdf.height = a.svbrdf.normal, a.svbrdf.height
    for material in (a, b):
        material.texture = np.zeros((8, 8, 3), np.uint8)
    (inputs / "two").mkdir()
    content = write_palette(Palette(None, "photo.png", [], settings, [a, b]), inputs / "two")
    maps = [record["maps"] for record in content["materials"]]
    assert maps[1]["normal"]["file"] == maps[0]["normal"]["file"] == "a/a_normal.png"
    assert maps[1]["basecolor"]["file"] == "b/b_basecolor.png"
    assert not (inputs / "two/b/b_normal.png").exists()
    assert json.loads((inputs / "two/b/b.json").read_text())["maps"] == maps[1]
    assert np.allclose(maps_of(read_palette(inputs / "two")[1][1].svbrdf)["normal"], a.svbrdf.normal, atol=0.01)

    from material_palette.core.nodes import images_of, write_blend

    write_blend(inputs / "two" / "palette.blend", content, inputs / "two", {}, pack=True)
    bpy.ops.wm.open_mainfile(filepath=str(inputs / "two" / "palette.blend"))
    images = [images_of(bpy.data.materials[name]) for name in "ab"]
    # the normals and the heights
    assert len(set(images[0]) & set(images[1])) == 2


def test_regions_named_as_files_of_the_palette_are_written(inputs):
    (inputs / "masks" / "a.png").rename(inputs / "masks" / "masks.png")
    (inputs / "masks" / "b.png").rename(inputs / "masks" / "palette.json.png")
    assert extract(inputs) == 0
    content = json.loads((inputs / "out" / "palette.json").read_text(encoding="utf-8"))
    assert [m["name"] for m in content["materials"]] == ["masks", "palette.json"]
    files = [m["maps"]["basecolor"]["file"] for m in content["materials"]]
    assert files == ["masks_/masks__basecolor.png", "palette.json_/palette.json__basecolor.png"]
    assert all((inputs / "out" / file).is_file() for file in files)


def test_what_regions_of_the_same_pixels_give_is_stored_once(inputs):
    import bpy
    from material_palette.core.nodes import images_of

    (inputs / "masks" / "b.png").write_bytes((inputs / "masks" / "a.png").read_bytes())
    assert extract(inputs, "--full-maps") == 0
    a, b = (m["maps"] for m in json.loads((inputs / "out/palette.json").read_text())["materials"])
    assert a == b == json.loads((inputs / "out/b/b.json").read_text())["maps"]
    assert all((inputs / "out" / m["file"]).is_file() for m in b.values() if "file" in m)
    assert [p.name for p in (inputs / "out/b").iterdir()] == ["b.json"]
    bpy.ops.wm.open_mainfile(filepath=str(inputs / "out/palette.blend"))
    assert set(images_of(bpy.data.materials["b"])) == set(images_of(bpy.data.materials["a"])) != set()


def test_fitting_at_once_samples_again_from_kept_concepts(inputs, capsys, monkeypatch):
    from material_palette.core import command, reduction
    from material_palette.core.scene import Seen

    whole = reduction.reduce

    def coarse(svbrdf, progress, visible=0.0, parts=1, pixels=None):
        if pixels is None:  # as if no more could be told before a camera came near
            return reduction.Reduction(reduction.shrink(svbrdf, 24))
        return whole(svbrdf, progress, visible, parts, pixels)

    monkeypatch.setattr(reduction, "reduce", coarse)
    monkeypatch.setattr(command, "_look", lambda path, names: {"a": Seen(200.0), "b": Seen(20.0)})
    assert extract(inputs, "--keep-concepts", "--fit-scene", "scene.blend") == 0
    said = capsys.readouterr().out
    assert "a: sampled again from its concept" in said and "b: sampled again" not in said
    assert cv2.imread(str(inputs / "out/a/a_basecolor.png")).shape[0] > 24
    assert (inputs / "out/a/a_concept.json").is_file() and (inputs / "out/b/b_concept.safetensors").is_file()


def test_the_distances_of_all_pairs_are_printed(inputs, capsys):
    assert extract(inputs, "--merge-alike", "0") == 0
    said = capsys.readouterr().out
    assert "a and b are 0." in said and "2 materials of 2 regions" in said
    assert extract(inputs, "--merge-alike", "100", "--overwrite") == 0
    said = capsys.readouterr().out
    assert "a and b are one material: 0." in said and "1 material of 2 regions" in said
    assert "1 of 1 material written" in said
    for wrong in ("nan", "-1"):
        assert extract(inputs, f"--merge-alike={wrong}", "--overwrite") == 2
        assert f"--merge-alike {wrong} is no distance" in capsys.readouterr().err


def test_a_texture_too_small_to_be_judged_is_said(inputs, capsys):
    (inputs / "masks" / "b.png").unlink()
    assert extract(inputs, "--target-error", "0.5", "--resolution", "64", "--scale", "2") == 0
    assert "found nothing: region or texture is too small" in capsys.readouterr().out


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("name, code", [("SIGTERM", 143), ("SIGHUP", 129), ("SIGINT", 130)])
def test_a_signal_ends_a_run_without_a_trace(inputs, name, code):
    run = f"""
import os, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import conftest
from material_palette.core import command, palette

def extract_palette(*_):
    print(len(os.listdir()), flush=True)
    os.kill(os.getpid(), signal.{name})

signal.signal(signal.SIGINT, signal.default_int_handler)
palette.extract_palette = extract_palette
sys.exit(command.main(["extract", "photo.png", "--masks", "masks", "-o", "out"]))
"""
    before = sorted(p.name for p in inputs.iterdir())
    done = subprocess.run([sys.executable, "-c", run], cwd=inputs, capture_output=True, text=True, timeout=120)
    assert int(done.stdout) == len(before) + 1  # the staging folder
    assert done.returncode == code and done.stderr == "interrupted; nothing was written for this photo\n"
    assert sorted(p.name for p in inputs.iterdir()) == before
