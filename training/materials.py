"""PBR sets from folders, in the layouts people have them, as arrays for training and testing."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

# file stems end like this, whatever comes before; the first that is there counts
LAYOUTS = {
    "basecolor": ("basecolor", "_Color", "_diff", "_Base_Color", "_col", "_albedo"),
    "normal": ("normal", "_NormalGL", "_nor_gl", "_Normal", "_nrm"),
    "roughness": ("roughness", "_Roughness", "_rough"),
    "metallic": ("metallic", "_Metalness", "_metal"),
}
SUFFIXES = (".jpg", ".png", ".jpeg", ".webp")


@dataclass
class MaterialSet:
    """uint8 maps, all (H, W): basecolor (H, W, 3) sRGB-encoded, normal (H, W, 3) with +Y up, roughness and metallic."""

    name: str
    basecolor: np.ndarray
    normal: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray | None
    normal_measured: bool  # False where it was derived from a height map of unknown scale


def read_sets(data: Path, only: list[str] | None = None) -> tuple[list[MaterialSet], list[MaterialSet]]:
    """(training, held out) below `data`/pbr/<collection>/<material>/ or, without pbr, of any folders with the maps.

    Held out are the collection `polyhaven` and every fourth material of the others. With `only`, names of collections,
    the others are not there. Raises FileNotFoundError.
    """
    root = data / "pbr" if (data / "pbr").is_dir() else data
    folders: dict[Path, list[Path]] = {}
    for path in sorted(root.rglob("*")):
        if path.is_dir() and _find(path, "basecolor") and _find(path, "normal") and _find(path, "roughness"):
            folders.setdefault(path.parent, []).append(path)
    names = {collection.name for collection in folders}
    if not folders:
        raise FileNotFoundError(f"no PBR sets below '{root}': folders with base colour, normal and roughness")
    for name in only or ():
        if name not in names:
            raise FileNotFoundError(f"no collection '{name}' below '{root}'; there are {', '.join(sorted(names))}")
    training, held_out = [], []
    for collection, sets in sorted(folders.items()):
        if only and collection.name not in only:
            continue
        for i, folder in enumerate(sets):
            (held_out if collection.name == "polyhaven" or i % 4 == 3 else training).append(read_set(folder))
    return training, held_out


def read_set(folder: Path) -> MaterialSet:
    basecolor = read_pixels(_find(folder, "basecolor"))
    h, w = basecolor.shape[:2]

    def same_size(pixels):
        return cv2.resize(pixels, (w, h), interpolation=cv2.INTER_AREA) if pixels.shape[:2] != (h, w) else pixels

    metallic = _find(folder, "metallic")
    return MaterialSet(
        f"{folder.parent.name}/{folder.name}",
        basecolor,
        same_size(read_pixels(_find(folder, "normal"))),
        same_size(read_pixels(_find(folder, "roughness"))[..., 0]),
        same_size(read_pixels(metallic)[..., 0]) if metallic else None,
        not folder.parent.name.endswith("-derived"),
    )


def _find(folder: Path, kind: str) -> Path | None:
    files = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in SUFFIXES]
    for ending in LAYOUTS[kind]:
        for path in files:
            stem = path.stem
            # resolutions are written behind (rock_diff_2k) or before (Rock_2K_Color)
            if stem.endswith(ending) or stem.rsplit("_", 1)[0].endswith(ending):
                return path
    return None


def read_pixels(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 RGB."""
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None:
        raise ValueError(f"'{path}' is not an image that OpenCV reads")
    return np.ascontiguousarray(pixels[..., ::-1])
