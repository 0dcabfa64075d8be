"""A data folder of procedural materials in the layout that the suites read, for `dev.py bench --quick` without one."""

import csv
import json
import sys
from pathlib import Path

import cv2
import numpy as np

from ..core.image import srgb_from_linear

FAMILIES = ("bricks", "concrete", "gravel", "planks", "plaster", "weave")
EACH = 4  # per family: three to learn from, the fourth to test on
SIZE = 512


def make_data(folder: str | Path) -> Path:
    """Write pbr/made/<family>_<n>/, scenes/made/, INDEX.csv and empty folders beside them, unless they are there.

    Returns the folder.
    """
    folder = Path(folder)
    index = folder / "INDEX.csv"
    if index.exists():
        return folder
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "training"))
    import procedural

    for name in ("scenes", "textures", "photos"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    rows = []
    for family in FAMILIES:
        for number in range(EACH):
            path = folder / "pbr" / "made" / f"{family}_{number}"
            path.mkdir(parents=True, exist_ok=True)
            maps = procedural.material(90000 + number, SIZE, family)
            for kind, pixels in (
                ("basecolor", srgb_from_linear(maps.albedo)),
                ("normal", maps.normal / 2 + 0.5),
                ("roughness", np.repeat(maps.roughness[..., None], 3, 2)),
                ("height", np.repeat(np.clip(maps.height[..., None] + 0.5, 0, 1), 3, 2)),
            ):
                pixels = np.rint(np.clip(pixels, 0, 1) * 255).astype(np.uint8)[..., ::-1]
                cv2.imwrite(str(path / f"{kind}.jpg"), pixels, [cv2.IMWRITE_JPEG_QUALITY, 95])
            row = {"path": path.relative_to(folder).as_posix(), "kind": "pbr", "class": family}
            rows.append(row | {"source": "training/procedural.py", "licence": "CC0", "resolution": f"{SIZE}x{SIZE}"})
    _make_scene(folder)
    with index.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return folder


def _make_scene(folder: Path) -> None:
    """A photo of two of the materials side by side, in light that falls off; with masks and what they are."""
    side, names = 256, {"left": f"made/bricks_{EACH - 1}", "right": f"made/gravel_{EACH - 1}"}
    scene = folder / "scenes" / "made"
    (scene / "masks").mkdir(parents=True, exist_ok=True)
    halves = [cv2.imread(str(folder / "pbr" / name / "basecolor.jpg")) for name in names.values()]
    photo = np.concatenate([cv2.resize(half, (side, side), interpolation=cv2.INTER_AREA) for half in halves], 1)
    cv2.imwrite(str(scene / "photo.png"), np.rint(photo * np.linspace(1, 0.7, side)[:, None, None]).astype(np.uint8))
    for number, part in enumerate(names):
        mask = np.zeros((side, 2 * side), np.uint8)
        mask[:, number * side : (number + 1) * side] = 255
        cv2.imwrite(str(scene / "masks" / f"{part}.png"), mask)
    truth = {part: {"material": name} for part, name in names.items()}
    (scene / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
