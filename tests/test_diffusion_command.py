"""`extract --engine diffusion` from end to end with a tiny random model; needs bpy, for palette.blend."""

import json

import cv2
import numpy as np
import pytest
from textures import pebbles

bpy = pytest.importorskip("bpy", reason="palette.blend is written by Blender")
for package in ("diffusers", "transformers", "peft", "accelerate"):
    pytest.importorskip(package, reason="requirements-diffusion.txt is not installed")
import tiny_diffusion as tiny  # noqa: E402
from material_palette.core.command import main  # noqa: E402
from material_palette.core.image import read_photo  # noqa: E402
from material_palette.core.torus import WRAP_GATE, wrap_ratio  # noqa: E402


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    photo = pebbles(120, 200)
    photo[:, 110:] = photo[:, 110:, ::-1]
    cv2.imwrite(str(folder / "photo.png"), np.rint(photo * 255).astype(np.uint8))
    (folder / "masks").mkdir()
    for name, columns in {"a": slice(4, 100), "b": slice(112, 196)}.items():
        mask = np.zeros((120, 200), np.uint8)
        mask[4:116, columns] = 255
        cv2.imwrite(str(folder / "masks" / f"{name}.png"), mask)
    tiny.write_model(folder / "model")
    return folder


def extract(folder, out, *more):
    arguments = ["extract", str(folder / "photo.png"), "--masks", str(folder / "masks"), "--resolution", "64"]
    arguments += ["--engine", "diffusion", "--tuning-steps", "2", "--steps", "2", "-o", str(folder / out), *more]
    return main(arguments)


def test_a_palette_is_written(inputs):
    kept = ["--model", str(inputs / "model"), "--concepts", str(inputs / "concepts")]
    assert extract(inputs, "out", *kept) == 0
    out = inputs / "out"
    content = json.loads((out / "palette.json").read_text(encoding="utf-8"))
    assert [m["status"] for m in content["materials"]] == ["ok", "ok"]
    assert content["settings"]["engine"] == "diffusion" and content["settings"]["diffusion"]["steps"] == 2
    for name in "ab":
        assert wrap_ratio(read_photo(out / name / f"{name}_basecolor.png").pixels) <= WRAP_GATE
    assert len(list((inputs / "concepts").iterdir())) == 2
    bpy.ops.wm.open_mainfile(filepath=str(out / "palette.blend"))
    assert {m.name for m in bpy.data.materials if m.asset_data} == {"a", "b"}
    # the concepts are there by now, and the same settings give the same files
    assert extract(inputs, "again", *kept) == 0
    assert (inputs / "again/a/a_basecolor.png").read_bytes() == (out / "a/a_basecolor.png").read_bytes()


@pytest.mark.parametrize(
    "more, words",
    [
        ([], "needs a model"),
        (["--model", "nowhere/there/is"], "there is no model"),
        (["--model", "weights.ckpt"], "pickle"),
        (["--model", ".", "--roll", "over"], "roll 'over' is unknown"),
    ],
)
def test_bad_settings_are_said_and_nothing_is_written(inputs, capsys, more, words):
    assert extract(inputs, "bad", *more) == 2
    assert words in capsys.readouterr().err and not (inputs / "bad").exists()
