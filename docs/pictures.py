"""Makes the README's pictures from the palettes of the two bundled examples: sheets, a render by Cycles, a box's sides.

    .venv/bin/python docs/pictures.py
    .venv/bin/python docs/pictures.py WINDOW.png

The first extracts both examples into dist/pictures/ and writes docs/demo.jpg, docs/render.jpg and docs/sides.jpg, in 4
minutes. The second takes the pictures of the window that `tests/gui/run.sh EXTENSION.zip
WINDOW.png` has left.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
import bpy  # noqa: E402
from material_palette.benchmarks import scenes  # noqa: E402
from material_palette.core import palette  # noqa: E402
from material_palette.core.command import main  # noqa: E402
from material_palette.core.image import srgb_from_linear  # noqa: E402
from material_palette.core.region import Region  # noqa: E402
from material_palette.core.sides import largest_side  # noqa: E402

EXAMPLES = ("viaduct", "facade")
SHOWN = [("viaduct", "masonry"), ("viaduct", "rubble"), ("facade", "stone_wall"), ("facade", "red_wood")]
WINDOWS = {"4-picked": "window-regions", "9-assigned": "window"}  # of tests/gui/artist.sh
REPEATS = 1.0  # of the tile along a wall


def extract(example: str) -> Path:
    source, folder = ROOT / "examples" / example, ROOT / "dist" / "pictures" / example
    where = ["--masks", str(source / "masks"), "--overwrite", "-o", str(folder)]
    if main(["extract", str(source / "photo.jpg"), *where]):
        raise SystemExit(f"the example {example} could not be extracted")
    return folder


def save(picture, path: Path, width: int) -> None:
    height = round(picture.shape[0] * width / picture.shape[1])
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(path), small, [cv2.IMWRITE_JPEG_QUALITY, 88])


def build_scene(folders: dict[str, Path]) -> None:
    """A sphere and a wall of each material on a grey floor, under a sun and a sky."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    for example, folder in folders.items():
        wanted = [name for e, name in SHOWN if e == example]
        with bpy.data.libraries.load(str(folder / "palette.blend")) as (_, to):
            to.materials = wanted
    for i, (_, name) in enumerate(SHOWN):
        x = (i - (len(SHOWN) - 1) / 2) * 2.4
        material = bpy.data.materials[name]
        bpy.ops.mesh.primitive_uv_sphere_add(segments=96, ring_count=48, radius=0.95, location=(x, 0, 0.95))
        place(bpy.context.object, material, 2, 1)
        bpy.ops.object.shade_smooth()
        bpy.ops.mesh.primitive_plane_add(size=2.3, location=(x, 1.6, 1.15), rotation=(1.5708, 0, 0))
        place(bpy.context.object, material, REPEATS, REPEATS)
    bpy.ops.mesh.primitive_plane_add(size=60)
    grey = bpy.data.materials.new("floor")
    grey.diffuse_color = (0.2, 0.2, 0.2, 1)
    bpy.context.object.data.materials.append(grey)
    bpy.ops.object.light_add(type="SUN", rotation=(0.85, -0.65, 0))
    bpy.context.object.data.energy = 2.5
    world = bpy.data.worlds.new("sky")
    scene.world = world
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.75, 0.85, 1.0, 1)
    world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.45
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.rotation_euler = (0, -10.8, 1.95), (1.50, 0, 0)
    camera.data.lens = 40
    scene.camera = camera


def place(thing, material, across: float, up: float) -> None:
    """Assign the material and scale the object's UV map to so many repeats."""
    thing.data.materials.append(material)
    for corner in thing.data.uv_layers.active.data:
        corner.uv = (corner.uv[0] * across, corner.uv[1] * up)


def render(path: Path) -> None:
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.seed = 32, 0
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x, scene.render.resolution_y = 1400, 480
    scene.render.image_settings.file_format = "PNG"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


def sides(folder: Path) -> np.ndarray:
    """A crate of masonry in a rendered photo, the side of it that is learnt from, and its texture, 2 x 2, learnt from
    the whole crate and from that side."""
    materials = {m.name: m.svbrdf for m in palette.read_palette(folder)[1]}
    scene = scenes.Scene("table", 11, (720, 540), 32)
    dressed = dict(zip(scene.things, ("red_paint", "masonry", "rubble", "rubble"), strict=True))
    scene.dress({part: materials[name] for part, name in dressed.items()}, dict.fromkeys(dressed, (0.45, 0.45)))
    shown = scene.show()
    mask, view = shown.masks["crate"], palette.rectification.look(shown.photo)
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    height = 360
    photo = srgb_from_linear(shown.photo)
    dim = np.where(largest_side(shown.photo, mask)[..., None], photo, photo * 0.25)
    panels = []
    for picture in (photo, dim):
        cut = picture[rows[0] - 8 : rows[-1] + 9, columns[0] - 8 : columns[-1] + 9]
        panels.append(cv2.resize(cut, (round(cut.shape[1] * height / cut.shape[0]), height)))
    found = palette.largest_side
    for search in (lambda pixels, mask: mask, found):
        palette.largest_side = search
        settings = palette.Settings(resolution=256)
        made = palette.extract_material(shown.photo, Region("crate", mask), settings, lambda f, message: None, view)
        tile = srgb_from_linear(made.svbrdf.albedo)
        panels.append(cv2.resize(np.tile(tile, (2, 2, 1)), (height, height), interpolation=cv2.INTER_AREA))
    palette.largest_side = found
    return np.rint(np.concatenate(panels, 1)[..., ::-1].clip(0, 1) * 255).astype(np.uint8)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        for picture, name in WINDOWS.items():
            save(cv2.imread(f"{sys.argv[1].removesuffix('.png')}-{picture}.png"), DOCS / f"{name}.jpg", 1400)
        raise SystemExit
    folders = {example: extract(example) for example in EXAMPLES}
    save(cv2.imread(str(folders["viaduct"] / "palette.png")), DOCS / "demo.jpg", 1400)
    build_scene(folders)
    rendered = ROOT / "dist" / "pictures" / "render.png"
    render(rendered)
    save(cv2.imread(str(rendered)), DOCS / "render.jpg", 1400)
    save(sides(folders["viaduct"]), DOCS / "sides.jpg", 1400)
