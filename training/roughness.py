"""Fits how rough a material is on the whole: ridge regression on the pretrained trunk's features of its pictures.

    .venv/bin/python training/roughness.py DATA WEIGHTS.safetensors [--scenes FOLDER] [--collections NAME...]

There are a few dozen real materials to learn it from, which gradient descent learns by heart; a linear map in closed
form does not. Its penalty, the layers it sees, the weight of procedural materials (about the level of the real ones)
and of large collections were chosen on training materials left out, and on whole collections left out: what is new to
a user comes from a collection that is not here. Textures of `scene_textures.py` count as much as the pictures of the
sets lit by `renderings.py`: they are what the network will see. Prints the error on both beside the constant's, how
well metals are told from the rest by the same features, and writes `mean_roughness` into WEIGHTS.
"""

import argparse
import csv
import sys
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.core.decomposition.unet import overview  # noqa: E402
from material_palette.core.tensors import read_tensors, write_tensors  # noqa: E402
from material_palette.models.svbrdf_net import SvbrdfNet  # noqa: E402
from materials import MaterialSet, read_pixels, read_sets  # noqa: E402
from renderings import Source, photographed, stacked  # noqa: E402
from scene_textures import TABLE  # noqa: E402
from train import procedural_sets  # noqa: E402

SIZE = 256  # px of a picture, as `core.decomposition.unet.OVERVIEW`
PICTURES = 5  # of each real material; of a procedural one, one
PROCEDURAL = 240
PENALTY = 1.0  # in units of the features' variance
FOLDS = 9
REPEATS = 1, 2, 4  # of a texture, reduced to what the network recognises it in: a larger one shows more of the surface


def described(net: SvbrdfNet, sets: list[MaterialSet], pictures: int, seed: int) -> tuple[np.ndarray, ...]:
    """Features (N, TEXTURE), mean roughness (N,) and number of the material (N,) of random pictures."""
    source, random = Source(sets, SIZE, seed, most_scale=4.0), np.random.default_rng(seed)
    features, roughness, numbers = [], [], []
    for _ in range(pictures):
        for first in range(0, len(sets), 8):
            some = range(first, min(first + 8, len(sets)))
            batch = stacked([source.crop(i) for i in some])
            features.append(net.recognise(photographed(batch, random))[1].numpy())
            roughness.append(batch["roughness"].mean((1, 2, 3)).numpy())
            numbers.append(np.array(some))
    return tuple(np.concatenate(x) for x in (features, roughness, numbers))


def described_textures(net: SvbrdfNet, folder: Path, names: list[str]) -> tuple[np.ndarray, ...]:
    """As `described`, of the textures of `scene_textures.py` in a folder, as far as they are of materials named."""
    features, roughness, numbers = [], [], []
    with (folder / TABLE).open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if row[1] in names]
    for name, material, mean in rows:
        texture = read_pixels(folder / name).astype(np.float32) / 255
        for times in REPEATS:
            features.append(net.recognise(overview(np.tile(texture, (times, times, 1))))[1].numpy())
            roughness.append(float(mean))
            numbers.append(names.index(material))
    return np.concatenate(features), np.array(roughness), np.array(numbers)


def fit(x: np.ndarray, y: np.ndarray, weight: np.ndarray, drawn: tuple) -> tuple[np.ndarray, float]:
    """Weights and bias of a ridge regression; `drawn`, features and roughness, counts as much as the rest together."""
    level = np.average(y, weights=weight)
    features, roughness = drawn
    share = np.concatenate([weight / weight.sum(), np.full(len(features), 1 / len(features))]) / 2
    target = np.concatenate([y - level, roughness - roughness.mean()])
    x = np.concatenate([x, features]).astype(np.float64)
    mean, deviation = share @ x, x.std(0) + 1e-3
    z = (x - mean) / deviation
    w = np.linalg.solve(z.T @ (z * share[:, None]) + PENALTY * np.eye(z.shape[1]), z.T @ (share * target)) / deviation
    return w, float(level - mean @ w)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--collections", nargs="+", metavar="NAME", help="of DATA, to learn from; default: all")
    parser.add_argument("--scenes", type=Path, metavar="FOLDER", help="of scene_textures.py")
    options = parser.parse_args()
    torch.set_num_threads(1)
    tensors, metadata = read_tensors(options.weights)
    net = SvbrdfNet().eval()
    net.trunk.load_state_dict(
        {
            name.removeprefix("trunk."): torch.from_numpy(x.astype(np.float32))
            for name, x in tensors.items()
            if name.startswith("trunk.")
        }
    )
    training, _ = read_sets(options.data, options.collections)
    collection = np.array([s.name.split("/")[0] for s in training])
    size = np.array([(collection == c).sum() for c in collection])
    parts = {"lit": described(net, training, PICTURES, 0)}
    if options.scenes:
        parts["scenes"] = described_textures(net, options.scenes, [s.name for s in training])
    x, y, number = (np.concatenate(arrays) for arrays in zip(*parts.values(), strict=True))
    kind = np.repeat(list(parts), [len(part[1]) for part in parts.values()])
    drawn = described(net, procedural_sets(PROCEDURAL, 77), 1, 1)[:2]
    weight = size[number] ** -0.5
    for name in parts:
        weight[kind == name] /= weight[kind == name].sum()

    def left_out(fold: np.ndarray, learnt: np.ndarray) -> np.ndarray:
        """Errors of pictures whose group the fit has not seen, and of the mean of the others."""
        errors = np.zeros((len(y), 2))
        for group in np.unique(fold):
            out = fold[number] == group
            seen = learnt & ~out
            w, bias = fit(x[seen], y[seen], weight[seen], drawn)
            errors[out] = np.stack([x[out] @ w + bias - y[out], y[~out].mean() - y[out]], 1)
        return errors

    folds = np.random.default_rng(0).permutation(len(training)) % FOLDS
    for name, fold in (("materials", folds), ("collections", np.unique(collection, return_inverse=True)[1])):
        for learnt in (list(parts)[: n + 1] for n in range(len(parts))):
            errors = left_out(fold, np.isin(kind, learnt))
            for part in parts:
                found, constant = (errors[kind == part] ** 2).mean(0)
                off = np.abs(errors[kind == part, 0])
                print(
                    f"{name} left out, learnt from {', '.join(learnt)}, on {part}: {found:.4f}, "
                    f"constant {constant:.4f}; off by {off.mean():.3f}, median {np.median(off):.3f}"
                )
    metal = np.array([s.metallic is not None and s.metallic.mean() > 127 for s in training])[number]
    score = np.zeros(len(metal))
    for group in np.unique(folds):
        out = folds[number] == group
        w, bias = fit(x[~out], metal[~out].astype(float), weight[~out], (x[~out], metal[~out].astype(float)))
        score[out] = x[out] @ w + bias
    above = (score[metal][:, None] > score[~metal]).mean()
    print(f"metals, {len(set(number[metal]))} of {len(training)} materials: above others in {above:.0%} of pairs")
    w, bias = fit(x, y, weight, drawn)
    tensors["mean_roughness.weight"] = w[None].astype(np.float32)
    tensors["mean_roughness.bias"] = np.array([bias], np.float32)
    write_tensors(options.weights, tensors, metadata)


if __name__ == "__main__":
    main()
