"""How models/segmentation.safetensors was made: a linear discriminant of superpixels, fitted on collages.

    .venv/bin/python training/segmentation.py --data DATA              # about 2 minutes on one core
    .venv/bin/python training/segmentation.py --data DATA --quick -o dist/segmentation.safetensors

DATA is a folder with INDEX.csv, pbr/ and textures/. The collages (benchmarks/collage.py) are of textures under CC0,
CC-BY, MIT or in the public domain, none of them of the test split or in a rendered scene, recoloured at random. Within
scatter is that of a material over its superpixels in one collage (light, tilt, place, grain), between scatter that of
the means of materials in one collage; the directions that maximise their ratio are kept and scaled so that within
scatter is 1 along each (Fisher 1936).
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.benchmarks.collage import collage, sources  # noqa: E402
from material_palette.core.segmentation import features  # noqa: E402
from material_palette.core.tensors import write_tensors  # noqa: E402

COLLAGES = 90
FIRST_SEED = 10_000
RECOLOUR = 0.3
DIRECTIONS = 12
RIDGE = 0.05  # of each statistic's own scatter, added to it
LEAST_SUPERPIXELS = 5


def scatter(statistics: np.ndarray, materials: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Of one collage: the covariance of each material's superpixels, and (m, s) the means less their mean."""
    groups = [statistics[materials == index] for index in range(materials.max() + 1)]
    groups = [group for group in groups if len(group) >= LEAST_SUPERPIXELS]
    means = np.stack([group.mean(0) for group in groups])
    return [np.cov(group.T, bias=True) for group in groups], means - means.mean(0)


def discriminant(within: np.ndarray, between: np.ndarray, directions: int) -> np.ndarray:
    """(s, directions) projection that maximises between / within scatter, with within scatter 1."""
    within = within + np.diag(RIDGE * np.diag(within) + 1e-9)
    whitening = np.linalg.inv(np.linalg.cholesky(within)).T
    values, vectors = np.linalg.eigh(whitening.T @ between @ whitening)
    return whitening @ vectors[:, ::-1][:, :directions]


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("-o", "--output", type=Path, default=features.DISCRIMINANT)
    parser.add_argument("--quick", action="store_true", help="two collages, to see that it runs; not to be used")
    arguments = parser.parse_args(argv)
    if arguments.quick and arguments.output == features.DISCRIMINANT:
        parser.error("--quick needs -o: it would overwrite the weights that ship")
    collages = 2 if arguments.quick else COLLAGES
    choices = sources(arguments.data, "free")
    within, between, mean = [], [], []
    for index in range(collages):
        truth = collage(choices, FIRST_SEED + index, recolour=RECOLOUR)
        found = features.measure(truth.pixels, lambda fraction, message: None)
        statistics = features.smoothed_plainly(found.statistics, found)
        labels = cv2.resize(truth.labels.astype(np.uint8), found.labels.shape[::-1], interpolation=cv2.INTER_NEAREST)
        counts = np.zeros((len(found.size), labels.max() + 1), int)
        np.add.at(counts, (found.labels.ravel(), labels.ravel()), 1)
        covariances, means = scatter(statistics, counts.argmax(1))
        within += covariances
        between.append(means)
        mean.append(statistics.mean(0))
        print(f"{index + 1} of {collages}", end="\r", flush=True)
    between = np.concatenate(between)
    projection = discriminant(np.mean(within, 0), between.T @ between / len(between), DIRECTIONS)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    write_tensors(
        arguments.output,
        {"mean": np.mean(mean, 0).astype(np.float32), "projection": projection.astype(np.float32)},
        {"made by": "training/segmentation.py", "textures": ", ".join(source.name for source in choices)},
    )
    print(f"{len(choices)} textures, {len(within)} materials in {collages} collages -> {arguments.output.name}")


if __name__ == "__main__":
    main()
