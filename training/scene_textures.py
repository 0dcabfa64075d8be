"""Textures that the pipeline makes of photos of known materials, and how rough those are: what the network will see.

    .venv/bin/python training/scene_textures.py DATA -o FOLDER [--scenes N]

The training sets of DATA, put on the parts of the benchmark's scenes (`benchmarks/scenes.py`, other numbers than there:
other sizes, views and turns of the light) and extracted from their photos by true masks. FOLDER gets
<scene>_<part>.png, SIZE px each, and textures.csv: file, material, mean roughness; a scene that is there is not made
again. Regions of one colour are left out: they never reach the network. `roughness.py --scenes FOLDER` learns from it.
"""

import argparse
import csv
import sys
from pathlib import Path
from types import SimpleNamespace

import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.benchmarks import endtoend, scenes, svbrdf  # noqa: E402
from material_palette.core import palette  # noqa: E402
from material_palette.core.errors import PaletteError  # noqa: E402
from material_palette.core.image import srgb_from_linear, write_image  # noqa: E402

SIZE = 256
FIRST = 1000  # number of the first scene
TABLE = "textures.csv"


def known(data: Path) -> list[endtoend.Known]:
    """The training materials of a data folder."""
    folders = svbrdf.split(data)[0]
    return [
        endtoend.Known(f"{folder.parent.name}/{folder.name}", "", lambda folder=folder: endtoend.read_maps(folder))
        for folder in folders
    ]


def textures(number: int, materials: list[endtoend.Known], size: tuple[int, int], samples: int) -> list[tuple]:
    """Part, material, mean roughness and texture (SIZE, SIZE, 3) float32 linear of a scene's parts."""
    options = SimpleNamespace(size=size, samples=samples)
    _, parts, truth, _, shown = endtoend.photographed(number, materials, options)
    view, found = palette.rectification.look(shown.photo), []
    for part, mask in shown.masks.items():
        try:
            maps = endtoend.extracted(shown.photo, mask, part, "balanced", ("kept",), view, SIZE)[1]["kept"][0]
        except PaletteError as error:
            print(f"{number} {part}: {error}", flush=True)
            continue
        if maps.albedo.ndim == 3:
            found.append((part, parts[part].name, float(truth[part].roughness.mean()), maps.albedo))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--scenes", type=int, default=72, help="18 show every training set once (%(default)s)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    table, materials = options.output / TABLE, known(options.data)
    rows = table.read_text(encoding="utf-8").splitlines() if table.exists() else []
    done = {int(row.split("_")[0]) for row in rows}
    for number in range(FIRST, FIRST + options.scenes):
        if number in done:
            continue
        found = textures(number, materials, (scenes.WIDTH, scenes.HEIGHT), scenes.SAMPLES)
        for part, _, _, texture in found:
            write_image(options.output / f"{number}_{part}.png", srgb_from_linear(texture.clip(0, 1)))
        with table.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([f"{number}_{part}.png", name, f"{r:.4f}"] for part, name, r, _ in found)
        print(number, len(found), flush=True)


if __name__ == "__main__":
    main()
