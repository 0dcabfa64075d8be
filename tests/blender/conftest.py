"""Every test here starts from an empty file; `extension` has Material Palette registered in it."""

import sys
from pathlib import Path

import bpy
import numpy as np
import pytest


@pytest.fixture(autouse=True)
def empty_file():
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture
def extension(empty_file):
    package = sys.modules["material_palette"]
    package.register()
    try:
        yield package
    finally:
        package.unregister()


@pytest.fixture
def settings(extension):
    return bpy.context.scene.material_palette


@pytest.fixture
def make_record():
    """make_record(maps, name, **more): an entry of palette.json; every map not given is a constant."""

    def make(maps=None, name="stone", **more):
        constants = {
            "basecolor": {"value": [0.2, 0.3, 0.4]},
            "normal": {"value": [0.0, 0.0, 1.0]},
            "roughness": {"value": 0.7},
            "height": {"value": 0.0},
        }
        record = {
            "name": name,
            "status": "ok",
            "maps": constants | (maps or {}),
            "metres_per_tile": 1.0,
            "seconds": {},
            "reduced": [],
            "warnings": [],
            "error": None,
        }
        return record | more

    return make


@pytest.fixture
def write_maps(tmp_path):
    """write_maps(name, *roles): write random maps below tmp_path; return their "maps" entries."""
    from material_palette.core.image import write_image

    def write(name="stone", roles=("basecolor", "normal", "roughness", "height")):
        rng = np.random.default_rng(0)
        (tmp_path / name).mkdir()
        maps = {}
        for role in roles:
            shape = (16, 16, 3) if role in ("basecolor", "normal") else (16, 16)
            file = f"{name}/{name}_{role}.png"
            write_image(tmp_path / file, rng.random(shape, np.float32), bits=16 if role == "height" else 8)
            maps[role] = {"file": file}
        if "height" in maps:
            maps["height"] |= {"scale": 0.05, "midlevel": 0.5}
        return maps

    return write


@pytest.fixture
def photo_and_masks(tmp_path):
    """Write a noisy photo of two halves and a mask of each; return the photo's path and the mask folder."""
    from material_palette.core.image import write_image

    height, width = 96, 160
    pixels = np.random.default_rng(1).uniform(0.2, 0.8, (height, width, 3)).astype(np.float32)
    pixels[:, width // 2 :] *= (1.0, 0.6, 0.4)
    photo, masks = tmp_path / "photo.png", tmp_path / "masks"
    masks.mkdir()
    write_image(photo, pixels)
    for name, columns in (("left", slice(4, width // 2 - 4)), ("right", slice(width // 2 + 4, width - 4))):
        mask = np.zeros((height, width), np.float32)
        mask[4:-20, columns] = 1.0
        write_image(masks / f"{name}.png", mask)
    return photo, masks


@pytest.fixture
def data_blocks():
    """data_blocks(): the names of every data block of the file by kind, to see what a run has left."""

    def names():
        kinds = {p.identifier for p in bpy.data.bl_rna.properties if p.type == "COLLECTION"}
        return {kind: sorted(block.name for block in getattr(bpy.data, kind)) for kind in kinds}

    return names


@pytest.fixture
def temporary_folders():
    """temporary_folders(): what lies in Blender's temporary folder of this session."""
    return lambda: sorted(Path(bpy.app.tempdir).iterdir())
