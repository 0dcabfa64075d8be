"""The zip that dev.py builds installs into Blender as an extension, works from there and leaves nothing behind."""

import json
import os
import subprocess
import sys
import textwrap
import tomllib
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

import dev

ROOT = Path(dev.__file__).parent


@pytest.fixture(scope="session")
def extension_zip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    assert dev.package(["-o", str(folder)]) == 0
    (path,) = folder.iterdir()
    return path


PRELUDE = """
import sys
sys.path += [p for p in sys.argv.pop(1).split("|") if p]
import bpy
NAME = "bl_ext.user_default.material_palette"
def install(path):
    done = bpy.ops.extensions.package_install_files(repo="user_default", filepath=path, enable_on_install=True)
    assert done == {"FINISHED"}, done
"""


def blender(script, resources, *arguments, packages=""):
    """Run a script with Blender as a module, its user's folder being `resources`; what it printed.

    With `packages`, a folder, only the modules in there exist besides Python's own."""
    alone = ["-I", "-S"] if packages else []
    environ = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
    environ["BLENDER_USER_RESOURCES"] = str(resources)
    command = [sys.executable, *alone, "-c", PRELUDE + textwrap.dedent(script), packages, *arguments]
    done = subprocess.run([str(part) for part in command], cwd=resources, env=environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_zip_is_small_and_holds_only_what_the_extension_needs(extension_zip):
    with zipfile.ZipFile(extension_zip) as archive:
        names = archive.namelist()
    assert extension_zip.stat().st_size < 45e6
    assert {"blender_manifest.toml", "__init__.py", "core/palette.py", "core/nodes.py"} <= set(names)
    folders = {name.split("/")[0] for name in names if "/" in name}
    assert folders <= {"core", "operators", "panels", "models"}
    assert not [name for name in names if name.startswith(".") or "__pycache__" in name or name == "dev.py"]


@pytest.mark.slow
def test_installed_extension_makes_a_palette(extension_zip, tmp_path):
    """Not by path: run from elsewhere, the code that runs is the installed one."""
    rng = np.random.default_rng(0)
    photo = np.clip(rng.normal(120, 40, (200, 300, 3)), 0, 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), photo)
    (tmp_path / "masks").mkdir()
    for index, name in enumerate(["left", "right"]):
        mask = np.zeros((200, 300), np.uint8)
        mask[:, index * 150 : index * 150 + 140] = 255
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), mask)
    script = """
        install(sys.argv[1])
        import importlib, pathlib
        command = importlib.import_module(NAME + ".core.command")
        assert pathlib.Path(command.__file__).is_relative_to(pathlib.Path.cwd()), command.__file__
        sys.exit(command.main(["extract", "photo.png", "--masks", "masks", "--resolution", "128",
                               "--quality", "draft", "-o", "out"]))
    """
    blender(script, tmp_path, extension_zip)
    palette = json.loads((tmp_path / "out" / "palette.json").read_text())
    assert [(m["name"], m["status"]) for m in palette["materials"]] == [("left", "ok"), ("right", "ok")]
    for name in ("palette.png", "masks/left.png", "left/left_basecolor.png"):
        assert (tmp_path / "out" / name).stat().st_size > 0
    check = """
        with bpy.data.libraries.load("out/palette.blend", assets_only=True) as (source, _):
            assert sorted(source.materials) == ["left", "right"], source.materials
    """
    blender(check, tmp_path)


def test_unregister_leaves_nothing(extension_zip, tmp_path):
    script = """
        def seen():
            types = {name for name in dir(bpy.types)}
            for owner in (bpy.types.Scene, bpy.types.WindowManager, bpy.types.Object, bpy.types.Material):
                types |= {owner.__name__ + "." + name for name in dir(owner)}
            handlers = {
                (name, getattr(f, "__module__", ""))
                for name in dir(bpy.app.handlers)
                if isinstance(getattr(bpy.app.handlers, name), list)
                for f in getattr(bpy.app.handlers, name)
            }
            return types | {h for h in handlers if h[1].startswith(NAME)}
        before = seen()
        install(sys.argv[1])
        during = seen()
        assert during != before
        import addon_utils
        addon_utils.disable(NAME, default_set=True)
        assert seen() == before, seen() ^ before
        addon_utils.enable(NAME, default_set=True)
        assert seen() == during, seen() ^ during
    """
    said = blender(script, tmp_path, extension_zip)
    assert "Traceback" not in said


@pytest.mark.skipif(os.name != "posix", reason="needs links")
def test_without_torch_and_opencv_it_enables_and_says_what_is_missing(extension_zip, tmp_path):
    packages = tmp_path / "packages"
    packages.mkdir()
    for path in Path(np.__file__).parent.parent.iterdir():
        if not path.name.lower().startswith(("torch", "functorch", "cv2", "opencv", "__", "distutils")):
            (packages / path.name).symlink_to(path)
    script = """
        for absent in ("torch", "cv2"):
            try:
                __import__(absent)
            except ModuleNotFoundError:
                continue
            raise AssertionError(absent + " is there")
        install(sys.argv[1])
        import importlib
        missing = importlib.import_module(NAME + ".core.dependencies").missing()
        assert {"torch", "cv2"} <= {m.module for m in missing}, missing
        assert all(m.package and m.reason for m in missing)
        code = importlib.import_module(NAME + ".core.command").main(
            ["extract", "photo.png", "--masks", "masks", "-o", "out"])
        assert code == 2, code
    """
    said = blender(script, tmp_path, extension_zip, packages=packages)
    assert "Traceback" not in said and "torch is missing" in said


def test_manifest_names_the_licences_of_what_ships(extension_zip):
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    assert {"SPDX:BSD-2-Clause", "SPDX:Apache-2.0", "SPDX:MIT"} < set(manifest["license"])
    assert len(manifest["copyright"]) == len(manifest["license"])
    with zipfile.ZipFile(extension_zip) as archive:
        for file in (
            "LICENSE",
            "models/stlpips_alex.md",
            "models/LICENSE-Apache-2.0.txt",
            "core/engines/diffusion/clip/LICENSE",
        ):
            assert len(archive.read(file)) > 1000, file


def test_manifest_gives_a_reason_for_each_permission():
    manifest = tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))
    assert manifest["id"] == "material_palette" and "SPDX:GPL-3.0-or-later" in manifest["license"]
    assert manifest["blender_version_min"] == "4.2.0"
    assert "files" in manifest["permissions"]
    for reason in manifest["permissions"].values():
        assert 10 < len(reason) <= 64 and not reason.endswith(".")
