"""Fits how rough a material is on the whole: ridge regression on the pretrained trunk's features of its pictures.

    .venv/bin/python training/roughness.py DATA WEIGHTS.safetensors [--collections NAME...]

There are a few dozen real materials to learn it from, which gradient descent learns by heart; a linear map in closed
form does not. Its penalty, the layers it sees, the weight of procedural materials (about the level of the real ones)
and of large collections were chosen on training materials left out, and on whole collections left out: what is new to
a user comes from a collection that is not here. Prints the error on both beside the constant's, how well metals are
told from the rest by the same features, and writes `mean_roughness` into WEIGHTS.
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
from material_palette.core.tensors import read_tensors, write_tensors  # noqa: E402
from material_palette.models.svbrdf_net import SvbrdfNet  # noqa: E402
from materials import MaterialSet, read_sets  # noqa: E402
from renderings import Source, photographed, stacked  # noqa: E402
from train import procedural_sets  # noqa: E402

SIZE = 256  # px of a picture, as `core.decomposition.unet.OVERVIEW`
PICTURES = 5  # of each real material; of a procedural one, one
PROCEDURAL = 240
PENALTY = 1.0  # in units of the features' variance
FOLDS = 9


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
    x, y, number = described(net, training, PICTURES, 0)
    drawn = described(net, procedural_sets(PROCEDURAL, 77), 1, 1)[:2]
    collection = np.array([s.name.split("/")[0] for s in training])
    size = np.array([(collection == c).sum() for c in collection])
    weight = size[number] ** -0.5

    def left_out(fold: np.ndarray) -> tuple[float, float]:
        errors = []
        for group in np.unique(fold):
            out = fold[number] == group
            w, bias = fit(x[~out], y[~out], weight[~out], drawn)
            errors.append([(x[out] @ w + bias - y[out]) ** 2, (y[~out].mean() - y[out]) ** 2])
        found, constant = (np.concatenate(e).mean() for e in zip(*errors, strict=True))
        return float(found), float(constant)

    folds = np.random.default_rng(0).permutation(len(training)) % FOLDS
    for name, fold in (("materials", folds), ("collections", np.unique(collection, return_inverse=True)[1])):
        found, constant = left_out(fold)
        print(f"{name} left out: {found:.4f}, constant {constant:.4f}")
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
