"""A data folder of procedural materials in the layout that the suites read, for `dev.py bench --quick` without one."""

import csv
import sys
from pathlib import Path

import cv2
import numpy as np

from ..core.image import srgb_from_linear

FAMILIES = ("bricks", "concrete", "gravel", "planks", "plaster", "weave")
EACH = 4  # per family: three to learn from, the fourth to test on
SIZE = 512


def make_data(folder: str | Path) -> Path:
    """Write pbr/made/<family>_<n>/, INDEX.csv and empty folders beside them, unless they are there; the folder."""
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
    with index.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return folder
