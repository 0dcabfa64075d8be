"""Measure the front of presets, seconds against error, and fit how the error follows from a region: core/front.json.

    python training/front.py DATA [--textures N]

DATA/textures/*.jpg: every fourth is left out of the fit and tells how far predictions are off.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.core import front  # noqa: E402
from material_palette.core.engines import patch  # noqa: E402
from material_palette.core.perceptual import Crops  # noqa: E402

SIDE = 256  # px of exemplars and of textures


def quiet(fraction, message):
    pass


def rows_of(path: Path) -> list[dict]:
    pixels = cv2.imread(str(path))[..., ::-1].astype(np.float32) / 255
    h, w = pixels.shape[:2]
    if min(h, w) < SIDE:
        return []
    pixels = np.ascontiguousarray(pixels[(h - SIDE) // 2 :, (w - SIDE) // 2 :][:SIDE, :SIDE])
    mask = np.ones(pixels.shape[:2], bool)
    concept, crops, spread = patch.learn(pixels, mask, quiet), Crops(pixels, mask), front.spread(pixels, mask)
    rows = []
    for name in patch.PRESETS:
        start = time.process_time()
        texture = patch.sample(concept, (SIDE, SIDE), 0, quiet, name).pixels
        seconds = time.process_time() - start
        error = crops.distance(texture)
        rows.append({"texture": path.stem, "preset": name, "seconds": seconds, "error": error, "spread": spread})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--textures", type=int, default=13)
    options = parser.parse_args()
    torch.set_num_threads(1)
    files = sorted((options.data / "textures").glob("*.jpg"))
    files = files[::3][: options.textures]
    presets, off, spreads = {}, [], []
    rows = [[], []]  # fitted, left out
    for i, path in enumerate(files):
        found = rows_of(path)
        rows[i % 4 == 3] += found
        print(
            path.stem, [(row["preset"], round(row["error"], 4), round(row["seconds"], 2)) for row in found], flush=True
        )
    for name in patch.PRESETS:
        own = [row for row in rows[0] if row["preset"] == name]
        x, y = (np.array([row[key] for row in own]) for key in ("spread", "error"))
        slope, offset = np.polyfit(x, y, 1)
        seconds = float(np.median([row["seconds"] for row in own]))
        presets[name] = {
            "seconds": round(seconds, 2),
            "slope": round(float(slope), 4),
            "offset": round(float(offset), 4),
        }
        spreads += x.tolist()
        for row in rows[1]:
            if row["preset"] == name:
                off.append((abs(offset + slope * row["spread"] - row["error"]), abs(y.mean() - row["error"])))
    content = {
        "measured": f"{SIDE} px textures of {SIDE} px exemplars, CPU seconds, medians",
        "usual_spread": round(float(np.median(spreads)), 4),
        "presets": dict(sorted(presets.items(), key=lambda item: item[1]["seconds"])),
        "fitted_on": len({row["texture"] for row in rows[0]}),
        "left_out": {
            "textures": len({row["texture"] for row in rows[1]}),
            "median_error_of_prediction": round(float(np.median([a for a, _ in off])), 4),
            "of_the_mean": round(float(np.median([b for _, b in off])), 4),
        },
    }
    (ROOT / "core" / "front.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(content, indent=1))


if __name__ == "__main__":
    main()
