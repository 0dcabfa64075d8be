"""Photos with known materials: collages of textures under shading, perspective and shadows, rendered scenes, and real
photos with some patches labelled by hand.

A collage is cut into wavy or straight-edged cells, more cells than materials, so that a material lies in several
places. Each cell is a plane of its own: turned, tilted, brighter or darker. Over all lie a slow change of light, a cast
shadow with a soft edge, and the camera's blur and noise. Materials of one collage are of different classes.
"""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..core.image import linear_from_srgb, read_mask, read_photo, srgb_from_linear

LABELS = Path(__file__).with_name("photos.json")
SKY = "sky"
LEAST_SHARE = 0.03  # of the photo, per material
FREE = ("CC0", "CC-BY 3", "CC-BY-4", "MIT", "ublic domain", "ublic-domain")


@dataclass
class Truth:
    """A photo (H, W, 3) linear float32 and its materials (H, W) int: 0.. per material, -1 where unknown; the first
    `scored` of them count, None: all."""

    name: str
    pixels: np.ndarray
    labels: np.ndarray
    scored: int | None = None


@dataclass
class Source:
    """A texture to cut from: an image file, and the folder of its normal map if it has one."""

    name: str
    kind: str  # class in the index
    path: Path
    normal: Path | None


def sources(data: Path, split: str) -> list[Source]:
    """Textures of the split "train" or "test" in sorted order; "free": those of "train" fit to ship weights of.

    Test: all of Poly Haven and every fourth of each other set. What the rendered scenes are made of is in no split.
    """
    with open(data / "INDEX.csv", newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["kind"] in ("pbr", "texture")]
    in_scenes = {
        f"pbr/{part['material']}"
        for file in (data / "scenes").glob("*/truth.json")
        for part in json.loads(file.read_text(encoding="utf-8")).values()
    }
    families = {}
    for row in sorted(rows, key=lambda row: row["path"]):
        families.setdefault(row["path"].rsplit("/", 1)[0], []).append(row)
    found = []
    for family, members in families.items():
        for index, row in enumerate(members):
            test = family.endswith("polyhaven") or index % 4 == 3
            free = any(word in row["licence"] for word in FREE)
            if row["path"] in in_scenes or test != (split == "test") or (split == "free" and not free):
                continue
            path = data / row["path"]
            pbr = row["kind"] == "pbr"
            normal = path / "normal.jpg" if pbr and (path / "normal.jpg").exists() else None
            found.append(Source(row["path"], row["class"], path / "basecolor.jpg" if pbr else path, normal))
    return found


def scenes(data: Path) -> list[Truth]:
    """The rendered scenes of the data folder, in sorted order."""
    found = []
    for folder in sorted((data / "scenes").iterdir()):
        pixels, masks, _ = read_scene(folder)
        labels = np.full(pixels.shape[:2], -1)
        for index, mask in enumerate(masks.values()):
            labels[mask] = index
        found.append(Truth(folder.name, pixels, labels))
    return found


def read_scene(folder: Path) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, str]]:
    """A rendered scene's photo (H, W, 3) linear, and by part its mask (H, W) bool and its material's name."""
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    pixels = read_photo(folder / "photo.png").pixels
    masks = {part: read_mask(folder / "masks" / f"{part}.png", pixels.shape[:2]) for part in truth}
    return pixels, masks, {part: one["material"] for part, one in truth.items()}


def photos(data: Path, file: Path = LABELS) -> list[Truth]:
    """Real photos of the data folder of which some patches are labelled by hand in `file`, in its order.

    They are named "photo_.." or "later_.." by their group: the later were labelled when features and merging were
    chosen, and looked at only for the rule about sky. A patch is [left, top, right, bottom] in percent of the photo,
    well within a material. "sky" comes last among the labels: it is no material to find, but should be in none.
    """
    found = []
    groups = json.loads(file.read_text(encoding="utf-8"))
    for group, name, materials in ((group, *item) for group, named in groups.items() for item in named.items()):
        path = data / "photos" / f"{name}.jpg"
        if not path.exists():
            continue
        pixels = read_photo(path).pixels
        height, width = pixels.shape[:2]
        labels = np.full((height, width), -1)
        for index, material in enumerate(sorted(materials, key=lambda material: material == SKY)):
            for left, top, right, bottom in materials[material]:
                rows = slice(int(top * height / 100), int(bottom * height / 100))
                labels[rows, int(left * width / 100) : int(right * width / 100)] = index
        found.append(Truth(f"{group}_{name}", pixels, labels, len(materials) - (SKY in materials)))
    return found


def collage(choices: list[Source], seed: int, height: int = 640, width: int = 880, recolour: float = 0.0) -> Truth:
    """A collage of 2 to 6 of the `choices`, of different classes; the same seed, the same collage.

    recolour: deviation of the logarithm of a random gain per texture and channel; for training on few textures.
    """
    random = np.random.default_rng(seed)
    cells, owner = _layout(random, random.integers(2, 7), height, width)
    kinds, used = set(), []
    for index in random.permutation(len(choices)):
        if choices[index].kind not in kinds and len(used) <= owner.max():
            kinds.add(choices[index].kind)
            used.append(choices[index])
    light = _unit(random.normal(size=2).tolist() + [1.2])
    textures = [_texture(source, light, random) * np.exp(recolour * random.normal(size=3)) for source in used]
    pixels = np.zeros((height, width, 3), np.float32)
    for cell, material in enumerate(owner):
        inside = cells == cell
        plane = _plane(textures[material].astype(np.float32), random, height, width)
        pixels[inside] = plane[inside] * random.uniform(0.6, 1.3)
    field = _field(random, height, width, 0.5 * max(height, width))
    pixels *= np.exp(0.35 * field)[..., None]
    if random.random() < 0.7:  # a straight-edged cast shadow, bluish
        angle, offset = random.uniform(0, 2 * np.pi), random.uniform(-0.3, 0.3)
        rows, columns = np.mgrid[:height, :width]
        side = (columns / width - 0.5) * np.cos(angle) + (rows / height - 0.5) * np.sin(angle) - offset
        shade = 1 / (1 + np.exp(-side * width / random.uniform(1.5, 6)))
        depth = 1 - shade[..., None] * (1 - random.uniform(0.35, 0.7) * np.array([0.95, 1.0, 1.08]))
        pixels *= depth.astype(np.float32)
    pixels *= random.uniform(0.75, 1.1) * 0.25 / pixels.mean()
    pixels = cv2.GaussianBlur(pixels, (0, 0), 0.6)
    encoded = srgb_from_linear(np.clip(pixels, 0, 1)) + random.normal(0, 0.008, pixels.shape)
    encoded = np.round(np.clip(encoded, 0, 1) * 255) / 255
    return Truth(f"collage_{seed}", linear_from_srgb(encoded), owner[cells])


def _layout(random, materials, height, width) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) cells and (cells,) material of each; every material covers LEAST_SHARE at least."""
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    while True:
        count = materials + random.integers(0, materials + 1)
        wave = random.uniform(0, 0.04) * width if random.random() < 0.6 else 0.0
        warped_rows = rows + wave * _field(random, height, width, 0.08 * width)
        warped_columns = columns + wave * _field(random, height, width, 0.08 * width)
        if random.random() < 0.5:
            points = random.uniform(0, 1, (count, 2)) * (height, width)
            distance = [(warped_rows - y) ** 2 + (warped_columns - x) ** 2 for y, x in points]
            cells = np.argmin(distance, 0)
        else:  # halves of halves: walls, floors, stripes
            cells = np.zeros((height, width), int)
            for cell in range(1, count):
                parent = np.bincount(cells.ravel()).argmax()
                inside = cells == parent
                angle = random.choice([0, np.pi / 2]) + random.normal(0, 0.25)
                along = warped_columns * np.cos(angle) + warped_rows * np.sin(angle)
                cells[inside & (along > np.quantile(along[inside], random.uniform(0.3, 0.7)))] = cell
        owner = np.concatenate([np.arange(materials), random.integers(0, materials, count - materials)])
        share = np.bincount(owner[cells].ravel(), minlength=materials) / cells.size
        if share.min() >= LEAST_SHARE:
            return cells, owner


def _texture(source: Source, light: np.ndarray, random) -> np.ndarray:
    """(h, w, 3) linear, tileable: base colour lit by one light over its normals, or a photographed texture mirrored."""
    colour = read_photo(source.path).pixels
    if source.normal is not None:
        encoded = cv2.imread(str(source.normal))[..., ::-1].astype(np.float32) / 255
        encoded = cv2.resize(encoded, colour.shape[1::-1], interpolation=cv2.INTER_AREA)
        normal = encoded * 2 - 1
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        colour = colour * np.maximum(normal @ light.astype(np.float32), 0.05)[..., None] / light[2]
    elif source.name.startswith("textures/"):
        colour = np.concatenate([colour, colour[:, ::-1]], 1)
        colour = np.concatenate([colour, colour[::-1]], 0)
    scale = random.uniform(0.35, 0.9)
    return cv2.resize(colour, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _plane(texture: np.ndarray, random, height: int, width: int) -> np.ndarray:
    """(H, W, 3): the texture on a turned and tilted plane; a tilt changes the scale by at most 1.8 across the photo."""
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    y, x = rows - height / 2, columns - width / 2
    direction, tilt = random.uniform(0, 2 * np.pi), random.uniform(0, 0.28)
    depth = 1 - tilt * (x * np.cos(direction) + y * np.sin(direction)) / (0.5 * max(height, width))
    turn = random.choice([0, np.pi / 2]) + random.normal(0, 0.2)
    zoom = random.uniform(0.85, 1.2)
    u = zoom * (x * np.cos(turn) - y * np.sin(turn)) / depth + random.uniform(0, texture.shape[1])
    v = zoom * (x * np.sin(turn) + y * np.cos(turn)) / depth + random.uniform(0, texture.shape[0])
    size = texture.shape[1], texture.shape[0]
    return cv2.remap(
        np.pad(texture, ((0, 1), (0, 1), (0, 0)), "wrap"),
        (u % size[0]).astype(np.float32),
        (v % size[1]).astype(np.float32),
        cv2.INTER_LINEAR,
    )


def _field(random, height: int, width: int, scale: float) -> np.ndarray:
    """(H, W) float32 smooth noise of mean 0 and deviation 1, varying over `scale` px."""
    coarse = max(2, round(height / scale)) + 2, max(2, round(width / scale)) + 2
    field = cv2.resize(random.normal(size=coarse).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    return (field - field.mean()) / field.std()


def _unit(vector) -> np.ndarray:
    return np.asarray(vector) / np.linalg.norm(vector)
