"""Fits how rough a material is on the whole: ridge regression on the pretrained trunk's features of its pictures.

    .venv/bin/python training/roughness.py DATA WEIGHTS.safetensors [--procedural N]

There are a few dozen real materials to learn it from, which gradient descent learns by heart; a linear map in closed
form, its penalty chosen on materials left out, does not. Procedural materials are added, since they are endless. Prints
the error on materials left out and held out beside the constant's, and writes `mean_roughness` into WEIGHTS.
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
from material_palette.core.decomposition.unet import load  # noqa: E402
from material_palette.core.tensors import read_tensors, write_tensors  # noqa: E402
from material_palette.models.svbrdf_net import SvbrdfNet  # noqa: E402
from materials import MaterialSet, read_sets  # noqa: E402
from renderings import Source, photographed, stacked  # noqa: E402
from train import procedural_sets  # noqa: E402

SIZE = 256  # px of a picture
PICTURES = {"training": 10, "procedural": 2, "held out": 6}  # of each material
PROCEDURAL_WEIGHT = 2.0
PENALTIES = (100, 300, 1000, 3000, 10_000, 30_000)
FOLDS = 8


def described(net: SvbrdfNet, sets: list[MaterialSet], pictures: int, seed: int) -> tuple[np.ndarray, ...]:
    """Features (N, GLOBAL), mean roughness (N,) and number of the material (N,) of random pictures."""
    source, random = Source(sets, SIZE, seed, most_scale=4.0), np.random.default_rng(seed)
    features, roughness, numbers = [], [], []
    for _ in range(pictures):
        for first in range(0, len(sets), 8):
            some = range(first, min(first + 8, len(sets)))
            batch = stacked([source.crop(i) for i in some])
            features.append(net.describe(photographed(batch, random)).numpy())
            roughness.append(batch["roughness"].mean((1, 2, 3)).numpy())
            numbers.append(np.array(some))
    return tuple(np.concatenate(x).astype(np.float64) for x in (features, roughness, numbers))


def ridge(x: np.ndarray, y: np.ndarray, weight: np.ndarray, penalty: float) -> np.ndarray:
    return np.linalg.solve(x.T @ (x * weight[:, None]) + penalty * np.eye(x.shape[1]), x.T @ (y * weight))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--procedural", type=int, default=600)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    net = load(options.weights)
    training, held_out = read_sets(options.data)
    drawn = procedural_sets(options.procedural, options.seed + 1)
    x, y, number = described(net, training, PICTURES["training"], options.seed)
    px, py, _ = described(net, drawn, PICTURES["procedural"], options.seed + 1)
    tx, ty, tnumber = described(net, held_out, PICTURES["held out"], options.seed + 2)

    mean, deviation = x.mean(0), (x.std(0) + 1e-3) * np.sqrt(10)
    level = y.mean()
    x, px, tx = ((a - mean) / deviation for a in (x, px, tx))
    both, target = np.concatenate([x, px]), np.concatenate([y, py]) - level
    weight = np.concatenate([np.ones(len(y)), np.full(len(py), PROCEDURAL_WEIGHT)])
    fold = np.random.default_rng(0).permutation(len(training))[number.astype(int)] % FOLDS
    fold = np.concatenate([fold, np.full(len(py), -1)])

    def left_out(penalty: float) -> float:
        errors = []
        for i in range(FOLDS):
            w = ridge(both[fold != i], target[fold != i], weight[fold != i], penalty)
            errors.append((both[fold == i] @ w - target[fold == i]) ** 2)
        return float(np.concatenate(errors).mean())

    tried = {penalty: left_out(penalty) for penalty in PENALTIES}
    best = min(tried, key=tried.get)
    w = ridge(both, target, weight, best)
    found = tx @ w + level
    haven = np.array([held_out[int(i)].name.startswith("polyhaven/") for i in tnumber])
    print(f"left out: {tried[best]:.4f}, constant {y.var():.4f} (penalty {best})")
    for name, some in (("held out", np.ones(len(ty), bool)), ("of these polyhaven", haven)):
        error, constant = ((found - ty)[some] ** 2).mean(), ((level - ty)[some] ** 2).mean()
        print(f"{name}: {error:.4f}, constant {constant:.4f}")

    tensors, metadata = read_tensors(options.weights)
    tensors["mean_roughness.weight"] = (w / deviation)[None].astype(np.float32)
    tensors["mean_roughness.bias"] = np.array([level - (mean / deviation) @ w], np.float32)
    write_tensors(options.weights, tensors, metadata)


if __name__ == "__main__":
    main()
