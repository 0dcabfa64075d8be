#!/usr/bin/env python3
"""Ablations of the engine `diffusion`, for those who have weights: the wording of the prompt, and what learns.

    .venv/bin/python benchmarks/diffusion.py --model CHECKPOINT --photo PHOTO --masks DIR -o DIR [--seeds 3]

Per region a concept is learnt in every way of INVERSIONS and sampled with every prompt of WORDINGS; the table gives the
median over regions and seeds of the shift-tolerant LPIPS to the region's crops (`sampling.distance`, less is better)
and of the wrap ratio before anything is closed. The paper measures FID, for which there are no weights here: its order
of the wordings is what can be compared, not its numbers. Writes ablation.json and the textures; a second run goes on.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import dev

dev.load_package()
from material_palette.core import torus  # noqa: E402
from material_palette.core.engines.diffusion import (  # noqa: E402
    PROMPTS,
    DiffusionSettings,
    Engine,
    decoding,
    sampling,
    tuning,
)
from material_palette.core.errors import PaletteError  # noqa: E402
from material_palette.core.exemplar import cut_exemplar  # noqa: E402
from material_palette.core.image import read_photo, srgb_from_linear, write_image  # noqa: E402
from material_palette.core.region import read_regions  # noqa: E402

WORDINGS = ("a photo of a S*", "S*", "a S* texture", "top view of S*", *PROMPTS)
TEXT = ("text_encoder", "text_encoder_2")
INVERSIONS = {"unet and text": ("unet", *TEXT), "unet": ("unet",), "text": TEXT, "nothing": ()}


def quiet(fraction, message):
    pass


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--model", required=True, help="folder in diffusers' format, .safetensors checkpoint or hub id")
    parser.add_argument("--online", action="store_true", help="fetch the model from the hub if it is not here")
    parser.add_argument("--photo", type=Path, required=True)
    parser.add_argument("--masks", type=Path, required=True, metavar="DIR")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--seeds", type=int, default=3, metavar="N")
    parser.add_argument("--resolution", type=int, default=512, metavar="PX")
    parser.add_argument("--tuning-steps", type=int, default=800, metavar="N")
    parser.add_argument("--steps", type=int, default=50, metavar="N")
    options = parser.parse_args(argv)
    try:
        rows = run(options)
    except PaletteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print_table("inversion", [row for row in rows if row["prompt"] in PROMPTS])
    print_table("prompt", [row for row in rows if row["inversion"] == "unet and text"])
    return 0


def run(options: argparse.Namespace) -> list[dict]:
    settings = DiffusionSettings(
        model=options.model, online=options.online, steps=options.steps, tuning_steps=options.tuning_steps
    )
    engine = Engine(dataclasses.replace(settings, early_stop=False))
    model = engine.model(quiet)
    photo = read_photo(options.photo)
    options.output.mkdir(parents=True, exist_ok=True)
    index = options.output / "ablation.json"
    rows = json.loads(index.read_text(encoding="utf-8"))["rows"] if index.exists() else []
    known = {(row["region"], row["inversion"], row["prompt"], row["seed"]) for row in rows}
    for region in read_regions(options.masks, photo.pixels.shape[:2]):
        exemplar = cut_exemplar(photo.pixels, region.mask)
        encoded = srgb_from_linear(np.clip(exemplar.pixels, 0, 1))
        for inversion, parts in INVERSIONS.items():
            wanted = [
                (region.name, inversion, prompt, seed)
                for prompt in (WORDINGS if inversion == "unet and text" else PROMPTS)
                for seed in range(options.seeds)
            ]
            if known.issuperset(wanted):
                continue
            start = time.process_time()
            engine.settings = dataclasses.replace(settings, tuning_steps=settings.tuning_steps if parts else 1)
            concept = _learn(engine, model, encoded, exemplar.mask, parts)
            learning = time.process_time() - start
            for key in wanted:
                if key in known:
                    continue
                engine.settings = dataclasses.replace(settings, prompt=key[2], candidates=1)
                texture = engine.sample(concept, (options.resolution,) * 2, key[3], quiet)
                raw = decoding.decode(model, texture.latents, quiet)
                name = "_".join((region.name, inversion, str(WORDINGS.index(key[2])), str(key[3]))).replace(" ", "-")
                write_image(options.output / f"{name}.png", texture.pixels)
                row = dict(zip(("region", "inversion", "prompt", "seed"), key, strict=True))
                row |= {
                    "distance": sampling.distance(texture.pixels, concept.crops),
                    "wrap": torus.wrap_ratio(raw),
                    "learning": learning,
                }
                rows.append(row)
                content = {"model": model.identity, "rows": rows}
                index.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
                print(f"{name}: {row['distance']:.3f}", flush=True)
    return rows


def _learn(engine: Engine, model, encoded: np.ndarray, mask: np.ndarray, parts: tuple[str, ...]):
    """As `Engine.learn`, but only these parts."""
    whole = tuning.tune
    tuning.tune = lambda *arguments: whole(*arguments, only=parts) if parts else _nothing(model)
    try:
        return engine.learn(encoded, mask, quiet)
    finally:
        tuning.tune = whole


def _nothing(model):
    tuning.reset_lora(model)
    return tuning.lora_of(model), []


def print_table(column: str, some: list[dict]) -> None:
    print(f"\n| {column} | LPIPS to the crops | wrap ratio | textures |\n|---|---|---|---|")
    for name in dict.fromkeys(row[column] for row in some):
        group = [row for row in some if row[column] == name]
        distance, wrap = (np.median([row[key] for row in group]) for key in ("distance", "wrap"))
        print(f"| {name} | {distance:.3f} | {wrap:.2f} | {len(group)} |")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
