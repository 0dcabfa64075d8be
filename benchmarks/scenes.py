"""Small scenes of known materials, built and rendered by Cycles: what `endtoend.py` extracts from and puts back into.

A scene is one of KINDS (room, facade, table) with four parts of one material each, a view and a light, both by its
number. Lengths are metres; every mesh has its UV map in metres, so a material of `tile` metres repeats every `tile`.
"""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import OpenImageIO as oiio

from ..core.exemplar import GREY_CARD, card_colour
from ..core.image import linear_from_srgb, srgb_from_linear
from ..core.material import SVBRDF

WIDTH, HEIGHT, SAMPLES = 512, 384, 8
AGAIN = 0.5, 8  # size and samples of pictures that are only compared with each other
WORLDS = ("courtyard", "city", "forest", "sunrise", "interior", "studio", "sunset")  # that ship with Blender
LEAST_AREA = 60 * 60  # px: a part that shows less of itself is not extracted


@dataclass
class Shown:
    """What a render shows: photo (H, W, 3) float32 linear, exposed as a camera does and rounded to 8 bits; masks, by
    part, (H, W) bool without the borders; uv (H, W, 2) metres; gain: the exposure."""

    photo: np.ndarray
    masks: dict[str, np.ndarray]
    uv: np.ndarray
    gain: float


# part: (metres per tile of its material)
KINDS = {
    "room": {"floor": 1.4, "wall": 1.6, "side": 1.6, "bench": 0.9},
    "facade": {"wall": 1.9, "ground": 1.9, "plinth": 1.0, "column": 1.0},
    "table": {"top": 0.55, "crate": 0.3, "drum": 0.3, "ball": 0.35},
}
# a grey card that is held into the scene, facing the camera: place of its middle, side
CARDS = {"room": ((0.0, -0.4, 0.8), 0.3), "facade": ((0.0, -1.7, 1.2), 0.4), "table": ((0.0, -0.1, 0.17), 0.12)}
# camera: place, target
VIEWS = {
    "room": [((-0.3, -3.3, 1.5), (0.1, 1.2, 0.75)), ((0.9, -3.2, 1.35), (-0.4, 1.2, 0.8))],
    "facade": [((0.2, -6.2, 1.7), (0.1, 0, 1.5)), ((-2.6, -5.4, 1.6), (0.5, 0, 1.4))],
    "table": [((0.0, -1.25, 0.75), (0.0, 0.05, 0.1)), ((0.5, -1.1, 0.95), (-0.02, 0.06, 0.06))],
}


def _mesh(bpy, name, quads, smooth=False):
    """An object of quads: each four corners (3,) and four UVs (2,) in metres."""
    corners = [c for quad, _ in quads for c in quad]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners, [], [tuple(range(4 * i, 4 * i + 4)) for i in range(len(quads))])
    layer = mesh.uv_layers.new(name="metres")
    layer.data.foreach_set("uv", np.array([uv for _, uvs in quads for uv in uvs], np.float32).ravel())
    mesh.polygons.foreach_set("use_smooth", np.full(len(quads), smooth))
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def _rectangle(origin, right, up):
    """A quad from its lower left corner and its two sides; its UVs begin somewhere in the material."""
    origin, right, up = (np.array(v, float) for v in (origin, right, up))
    w, h = np.linalg.norm(right), np.linalg.norm(up)
    start = np.abs(origin).sum() * 0.37
    uvs = np.array([(0, 0), (w, 0), (w, h), (0, h)]) + start
    return [tuple(origin), tuple(origin + right), tuple(origin + right + up), tuple(origin + up)], uvs


def _box(x, y, z, w, d, h, turn=0.0):
    """Front, back, sides and top of a box that stands on (x, y, z), its middle there, turned by radians."""
    c, s = np.cos(turn), np.sin(turn)
    along, deep, up = np.array([c * w, s * w, 0]), np.array([-s * d, c * d, 0]), np.array([0, 0, h])
    low = np.array([x, y, z]) - along / 2 - deep / 2
    return [
        _rectangle(low, along, up),
        _rectangle(low + along, deep, up),
        _rectangle(low + along + deep, -along, up),
        _rectangle(low + deep, -deep, up),
        _rectangle(low + up, along, deep),
    ]


def _drum(x, y, z, radius, height, steps=64):
    """A standing cylinder's side and its top."""
    angles = np.linspace(0, 2 * np.pi, steps + 1)
    ring = np.stack([x + radius * np.sin(angles), y - radius * np.cos(angles)], 1)
    quads = []
    for i in range(steps):
        (x0, y0), (x1, y1) = ring[i], ring[i + 1]
        u0, u1 = radius * angles[i], radius * angles[i + 1]
        corners = [(x0, y0, z), (x1, y1, z), (x1, y1, z + height), (x0, y0, z + height)]
        quads.append((corners, [(u0, 0), (u1, 0), (u1, height), (u0, height)]))
    return quads


def _ball(x, y, z, radius, steps=64):
    """A sphere on (x, y, z), its UVs those of a globe."""
    quads = []
    a, b = np.linspace(0, 2 * np.pi, steps + 1), np.linspace(-np.pi / 2, np.pi / 2, steps // 2 + 1)
    for i in range(steps):
        for j in range(steps // 2):
            corners, uvs = [], []
            for k, m in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)):
                flat = radius * np.cos(b[m])
                place = x + flat * np.sin(a[k]), y - flat * np.cos(a[k]), z + radius + radius * np.sin(b[m])
                corners.append(place)
                uvs.append((radius * a[k], radius * (b[m] + np.pi / 2)))
            quads.append((corners, uvs))
    return quads


def _parts(kind: str, number: int) -> dict[str, tuple[list, bool]]:
    """Quads and whether they are smooth, by part; sizes and turns differ with the number."""
    random = np.random.default_rng(1000 + number)
    turn = random.uniform(-0.5, 0.5)
    if kind == "room":
        return {
            "floor": ([_rectangle((-2.2, -3.6, 0), (4.4, 0, 0), (0, 5.2, 0))], False),
            "wall": ([_rectangle((-2.2, 1.6, 0), (4.4, 0, 0), (0, 0, 2.7))], False),
            "side": ([_rectangle((-2.2, -3.6, 0), (0, 5.2, 0), (0, 0, 2.7))], False),
            "bench": (_box(0.5, 0.4, 0, 1.5, 0.6, 0.62, turn * 0.5), False),
        }
    if kind == "facade":
        return {
            "wall": ([_rectangle((-4, 0, 0.6), (8, 0, 0), (0, 0, 4))], False),
            "ground": ([_rectangle((-6, -7, 0), (12, 0, 0), (0, 7, 0))], False),
            "plinth": (_box(0, 0.02, 0, 8, 0.3, 0.62), False),
            "column": (_drum(1.25 + turn, -1.2, 0, 0.38, 3.6), True),
        }
    return {
        "top": ([_rectangle((-0.8, -0.55, 0), (1.6, 0, 0), (0, 1.1, 0))], False),
        "crate": (_box(-0.3, 0.12, 0, 0.34, 0.3, 0.27, turn), False),
        "drum": (_drum(0.1, 0.22, 0, 0.15, 0.32), True),
        "ball": (_ball(0.38, 0.0, 0, 0.16), True),
    }


def _light(bpy, kind: str, number: int) -> None:
    """A world that ships with Blender, turned; in rooms a lamp besides, outside every second time a sun."""
    random = np.random.default_rng(2000 + number)
    scene = bpy.context.scene
    world = bpy.data.worlds.new("world")
    scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    folder = Path(bpy.utils.system_resource("DATAFILES")) / "studiolights" / "world"
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(str(folder / f"{WORLDS[number % len(WORLDS)]}.exr"))
    where, mapping = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
    mapping.inputs["Rotation"].default_value = (0, 0, random.uniform(0, 2 * np.pi))
    links.new(where.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], nodes["Background"].inputs["Color"])
    world.cycles.sampling_method, world.cycles.sample_map_resolution = "MANUAL", 256  # a table of where it is bright

    def lamp(type_, energy, place, **settings):
        data = bpy.data.lights.new(type_, type_)
        data.energy = energy
        for name, value in settings.items():
            setattr(data, name, value)
        thing = bpy.data.objects.new(type_, data)
        thing.location = place
        scene.collection.objects.link(thing)
        return thing

    if kind == "room":
        lamp("AREA", 90, (random.uniform(-1, 1), random.uniform(-1.5, 0), 2.6), size=0.8, color=(1, 0.86, 0.7))
    elif number % 2:
        sun = lamp("SUN", 2.5, (0, 0, 5), angle=0.01, color=(1, 0.95, 0.86))
        sun.rotation_euler = (random.uniform(0.5, 0.9), 0, random.uniform(-0.8, 0.8))


def _picture(bpy, name: str, pixels: np.ndarray):
    """A float picture of (H, W, 3) or (H, W), rows from the top, or of a constant (1, 1)."""
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, 2)
    h, w = pixels.shape[:2]
    image = bpy.data.images.new(name, w, h, float_buffer=True, alpha=False, is_data=True)
    rgba = np.ones((h, w, 4), np.float32)
    rgba[..., :3] = pixels[::-1]
    image.pixels.foreach_set(rgba.ravel())
    return image


def _material(bpy, name: str, maps: SVBRDF, tile: tuple[float, float]):
    """Principled BSDF of an SVBRDF that repeats every `tile` metres across and up."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["IOR"].default_value = 1.5
    uv, mapping = nodes.new("ShaderNodeUVMap"), nodes.new("ShaderNodeMapping")
    mapping.inputs["Scale"].default_value = (1 / tile[0], 1 / tile[1], 1)
    links.new(uv.outputs["UV"], mapping.inputs["Vector"])

    def texture(kind, value):
        value = np.asarray(value, np.float32)
        node = nodes.new("ShaderNodeTexImage")
        node.image = _picture(bpy, f"{name} {kind}", value if value.ndim > 1 else np.broadcast_to(value, (1, 1, 3)))
        links.new(mapping.outputs["Vector"], node.inputs["Vector"])
        return node.outputs["Color"]

    links.new(texture("albedo", maps.albedo), shader.inputs["Base Color"])
    links.new(texture("roughness", maps.roughness), shader.inputs["Roughness"])
    if maps.metallic is not None:
        links.new(texture("metallic", maps.metallic), shader.inputs["Metallic"])
    if np.ndim(maps.normal) > 1:
        bump = nodes.new("ShaderNodeNormalMap")
        links.new(texture("normal", (np.asarray(maps.normal) + 1) / 2), bump.inputs["Color"])
        links.new(bump.outputs["Normal"], shader.inputs["Normal"])
    return material


class Scene:
    """One scene of this process's Blender; the one before is thrown away."""

    def __init__(self, kind: str, number: int, size: tuple[int, int] = (WIDTH, HEIGHT), samples: int = SAMPLES):
        import bpy
        from mathutils import Vector

        self.bpy, self.kind, self.number, self.samples = bpy, kind, number, samples
        bpy.ops.wm.read_factory_settings(use_empty=True)
        scene = bpy.context.scene
        self.things = {}
        for i, (part, (quads, smooth)) in enumerate(_parts(kind, number).items()):
            self.things[part] = _mesh(bpy, part, quads, smooth)
            self.things[part].pass_index = i + 1
        _light(bpy, kind, number)
        camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        scene.collection.objects.link(camera)
        place, target = VIEWS[kind][number // 3 % len(VIEWS[kind])]
        random = np.random.default_rng(3000 + number)
        camera.location = np.array(place) + random.uniform(-0.06, 0.06, 3) * np.linalg.norm(place)
        camera.rotation_euler = (Vector(target) - camera.location).to_track_quat("-Z", "Y").to_euler()
        camera.data.lens = 30 if kind != "table" else 40
        scene.camera = camera
        scene.render.engine = "CYCLES"
        scene.render.resolution_x, scene.render.resolution_y = size
        scene.cycles.max_bounces = 3
        scene.render.use_persistent_data = True
        scene.cycles.device = "CPU"
        scene.render.threads_mode, scene.render.threads = "FIXED", int(os.environ.get("OMP_NUM_THREADS", "2"))
        layer = scene.view_layers[0]
        layer.use_pass_uv = layer.use_pass_object_index = True
        if hasattr(scene.render.image_settings, "media_type"):  # Blender 5
            scene.render.image_settings.media_type = "MULTI_LAYER_IMAGE"
        scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        scene.render.image_settings.color_depth = "32"

    def dress(self, maps: dict[str, SVBRDF], tiles: dict[str, tuple[float, float]]) -> None:
        """Give each part its material, which repeats every so many metres."""
        for part, thing in self.things.items():
            thing.data.materials.clear()
            thing.data.materials.append(_material(self.bpy, part, maps[part], tiles[part]))

    def render(self, share: float = 1.0, samples: int | None = None) -> np.ndarray:
        """(H, W, 3) float32 linear, not exposed; of this share of the size."""
        self.bpy.context.scene.render.resolution_percentage = round(100 * share)
        return self._rendered(samples or self.samples, True)[0]

    def show(self) -> Shown:
        """A photo of the scene as it is dressed, and the truth about its pixels."""
        self.bpy.context.scene.render.resolution_percentage = 100
        layers = self._rendered(1, False)[1]
        radiance = self.render()
        luminance = radiance @ np.array([0.2126, 0.7152, 0.0722])
        seen = luminance[layers["index"] > 0]
        gain = min(0.2 / np.exp(np.log(np.maximum(seen, 1e-4)).mean()), 0.95 / np.percentile(seen, 98))
        masks = {}
        for i, part in enumerate(self.things, 1):
            mask = cv2.erode((np.round(layers["index"]) == i).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            if mask.sum() >= LEAST_AREA:
                masks[part] = mask
        return Shown(exposed(radiance, gain), masks, layers["uv"], float(gain))

    def show_card(self, gain: float) -> tuple[float, float, float]:
        """What a photo of this exposure shows of a grey card that is held into the scene, linear; it is gone again."""
        bpy, (place, side) = self.bpy, CARDS[self.kind]
        card = _mesh(bpy, "card", [_rectangle((-side / 2, -side / 2, 0), (side, 0, 0), (0, side, 0))])
        card.location, card.rotation_euler = place, bpy.context.scene.camera.rotation_euler
        card.pass_index = len(self.things) + 1
        material = bpy.data.materials.new("card")
        material.use_nodes = True
        shader = material.node_tree.nodes["Principled BSDF"]
        shader.inputs["Base Color"].default_value = (*[GREY_CARD] * 3, 1)
        shader.inputs["Roughness"].default_value, shader.inputs["Specular IOR Level"].default_value = 1.0, 0.0
        card.data.materials.append(material)
        bpy.context.scene.render.resolution_percentage = 100
        index = self._rendered(1, False)[1]["index"]
        photo = exposed(self.render(), gain)
        bpy.data.objects.remove(card)
        y, x = np.nonzero(np.round(index) == len(self.things) + 1)
        (top, bottom), (left, right) = (np.quantile(v, (0.2, 0.8)) for v in (y, x))
        return card_colour(photo, np.array([left, top]), np.array([right, bottom]))

    def _rendered(self, samples: int, smooth: bool) -> tuple[np.ndarray, dict]:
        scene = self.bpy.context.scene
        scene.cycles.samples, scene.cycles.seed = samples, 0
        scene.cycles.filter_width = 1.5 if smooth else 0.01
        scene.cycles.use_denoising = smooth and denoises()
        with tempfile.TemporaryDirectory() as folder:
            scene.render.filepath = str(Path(folder) / "render.exr")
            self.bpy.ops.render.render(write_still=True)
            return _read(scene.render.filepath)


def denoises() -> bool:
    """True where this Blender has the denoiser."""
    import importlib

    importlib.import_module("bpy")  # brings _cycles
    return bool(getattr(importlib.import_module("_cycles"), "with_openimagedenoise", False))


def exposed(radiance: np.ndarray, gain: float) -> np.ndarray:
    """The photo (H, W, 3) float32 linear of a radiance: clipped and rounded to 8 bits sRGB-encoded."""
    encoded = srgb_from_linear(np.clip(radiance * gain, 0, 1).astype(np.float32))
    return linear_from_srgb(np.rint(encoded * 255) / np.float32(255))


def _read(path: str) -> tuple[np.ndarray, dict]:
    """The picture (H, W, 3) of a multilayer EXR, in one part or in several, and its layers uv and index."""
    channels = {}
    source = oiio.ImageInput.open(path)
    try:
        while source.seek_subimage(source.current_subimage(), 0):
            names, pixels = source.spec().channelnames, source.read_image("float")
            for i, name in enumerate(names):
                layer, _, channel = name.rpartition(".")
                channels[layer.rpartition(".")[2], channel] = pixels[..., i]
            if not source.seek_subimage(source.current_subimage() + 1, 0):
                break
    finally:
        source.close()

    def layer(names: tuple[str, ...], wanted: tuple[str, ...]) -> np.ndarray:
        name = next(name for name in names if (name, wanted[0]) in channels)
        return np.stack([channels[name, channel] for channel in wanted], -1)

    index = layer(("Object Index", "IndexOB"), ("X",))[..., 0]
    return layer(("Combined",), tuple("RGB")), {"uv": layer(("UV",), tuple("UV")), "index": index}


def texels_per_metre(shown: Shown, part: str, homography: np.ndarray | None = None) -> float:
    """Photo px per metre of a part's surface, or with a homography (rectified px to photo px) rectified px per metre:
    the square root of the areas' ratio, median over the part."""
    (uy, ux), (vy, vx) = (np.gradient(shown.uv[..., i]) for i in (0, 1))
    area = np.abs(ux * vy - uy * vx)
    inside = cv2.erode(shown.masks[part].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    y, x = np.nonzero(inside & (area > 0))
    area = area[y, x]
    if homography is not None:
        # det of a projective map's derivative is det(H) / w^3
        inverse = np.linalg.inv(homography)
        at = np.stack([x, y, np.ones(len(x))]) + 0.0
        w = inverse[2] @ at
        area = area / np.abs(np.linalg.det(inverse) / w**3)
    return float(np.sqrt(1 / np.median(area)))
