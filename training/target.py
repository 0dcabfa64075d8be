"""Textures without labels for adapting the decomposer: what the pipeline makes of the regions of photos.

    .venv/bin/python training/target.py [--close] PHOTO... -o FOLDER

Regions by `auto`, or all of each photo (`--close`: photos of one material); textures by the engine `patch`; one
<photo>_<number>.png of SIZE px each. `training/train.py --target FOLDER` trains with them.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.core.engines import patch  # noqa: E402
from material_palette.core.errors import PaletteError  # noqa: E402
from material_palette.core.exemplar import cut_exemplar  # noqa: E402
from material_palette.core.image import read_photo, srgb_from_linear, write_image  # noqa: E402
from material_palette.core.segmentation import segment  # noqa: E402

SIZE, REGIONS = 320, 6


def quiet(fraction: float, message: str) -> None:
    pass


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("--close", action="store_true", help="each photo shows one material")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    for path in options.photos:
        photo = read_photo(path)
        if options.close:
            masks = [np.ones(photo.pixels.shape[:2], bool)]
        else:
            masks = [region.mask for region in segment(photo.pixels, regions=REGIONS)]
        for i, mask in enumerate(masks):
            try:
                exemplar = cut_exemplar(photo.pixels, mask)
                encoded = srgb_from_linear(np.clip(exemplar.pixels, 0, 1)).astype(np.float32)
                texture = patch.sample(patch.learn(encoded, exemplar.mask, quiet), (SIZE, SIZE), i, quiet, "draft")
            except PaletteError as error:
                print(f"{path.stem} {i}: {error}", flush=True)
                continue
            write_image(options.output / f"{path.stem}_{i}.png", np.clip(texture.pixels, 0, 1))
        print(path.stem, flush=True)


if __name__ == "__main__":
    main()
