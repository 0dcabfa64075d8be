#!/usr/bin/env python3
"""TexSD: textures of named materials, without labels, for adapting the decomposer to what the engine samples.

    .venv/bin/python training/texsd.py --model CHECKPOINT -o texsd [--per-class 69] [--resolution 512]

Every class of CLASSES with the paper's prompts in turn, by the sampler of the engine `diffusion`, without a concept.
Writes <class>/<number>.png and texsd.json (prompt and seed of each, the model, the settings). Goes on where an earlier
run with the same settings has ended. Paper: 9,000 textures of 130 classes (Lopes et al. 2024).
"""

import argparse
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import dev

dev.load_package()
from material_palette.core.engines.diffusion import PROMPTS, DiffusionSettings, Engine  # noqa: E402
from material_palette.core.errors import PaletteError  # noqa: E402
from material_palette.core.image import write_image  # noqa: E402

# our own list: 130 surfaces by what they are made of
CLASSES = """
adobe, aluminium, asphalt, bamboo, bark, basalt, birch wood, brass, brick wall, brocade, bronze, brushed steel,
burlap, cardboard, carbon fibre, carpet, cedar wood, cement, ceramic tiles, charcoal, checkered fabric, cherry wood,
clay, cobblestone, concrete, concrete blocks, copper, coral, cork, corduroy, corrugated iron, cotton, cracked earth,
cracked paint, damask, denim, diamond plate, dirt, driftwood, dry grass, ebony, fallen leaves, felt, fieldstone wall,
flagstone, fleece, forest floor, frost, fur, galvanised steel, glazed tiles, gold leaf, granite, grass, gravel, hay,
herringbone parquet, hessian, hexagonal tiles, ice, iron, ivy, knitted wool, lace, lava rock, leather, lichen,
limestone, linen, linoleum, mahogany, maple wood, marble, moss, mosaic, mud, muslin, oak wood, onyx, painted metal,
painted wood, paper, parquet, patina copper, pavement, pebbles, pine needles, pine wood, plaster, plywood, porcelain
tiles, quilted fabric, rammed earth, rattan, red brick, river stones, rock face, roof shingles, roof tiles, rope,
rubber, rubble, rust, sand, sandstone, satin, scratched metal, silk, slate, snow, soil, stone wall, straw, stucco,
suede, tarmac, tatami, terracotta, terrazzo, thatch, travertine, tree roots, tweed, velvet, vinyl floor, walnut wood,
weathered planks, wicker, wood chips, wool
"""
CLASSES = [name.strip() for name in CLASSES.replace("\n", " ").split(",")]


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--model", required=True, help="folder in diffusers' format, .safetensors checkpoint or hub id")
    parser.add_argument("--online", action="store_true", help="fetch the model from the hub if it is not here")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--classes", nargs="+", default=CLASSES, metavar="NAME", help="(130 surfaces)")
    parser.add_argument("--per-class", type=int, default=69, metavar="N", help="textures of each (%(default)s)")
    parser.add_argument("--resolution", type=int, default=512, metavar="PX")
    parser.add_argument("--steps", type=int, default=50, metavar="N")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(argv)
    try:
        return make(options)
    except PaletteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def make(options: argparse.Namespace) -> int:
    engine = Engine(DiffusionSettings(model=options.model, online=options.online, steps=options.steps))
    model = engine.model(lambda fraction, message: None)
    about = {"model": model.identity, "resolution": options.resolution, "steps": options.steps, "seed": options.seed}
    index = options.output / "texsd.json"
    content = {"settings": about, "textures": {}}
    if index.exists():
        content = json.loads(index.read_text(encoding="utf-8"))
        if content["settings"] != about:
            raise PaletteError(
                f"'{index}' was made with {content['settings']}; name another folder, or the same settings"
            )
    options.output.mkdir(parents=True, exist_ok=True)
    start, made, count = time.monotonic(), 0, len(options.classes) * options.per_class
    # class after class in every round, so that a run that ends early has some of each
    for number in range(options.per_class):
        for position, name in enumerate(options.classes):
            path = options.output / name.replace(" ", "_") / f"{number:04}.png"
            key = path.relative_to(options.output).as_posix()
            if key in content["textures"] and path.exists():
                continue
            prompt = PROMPTS[number % len(PROMPTS)].replace("S*", name)
            seed = (options.seed * len(options.classes) + position) * 100_003 + number
            texture = engine.sample_prompt(prompt, (options.resolution,) * 2, seed, options.steps)
            path.parent.mkdir(exist_ok=True)
            write_image(path, texture.pixels)
            content["textures"][key] = {"class": name, "prompt": prompt, "seed": seed}
            index.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
            made += 1
            left = (time.monotonic() - start) / made * (count - len(content["textures"]))
            print(f"{len(content['textures'])} of {count}  {key}  {left / 60:.0f} min left", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
