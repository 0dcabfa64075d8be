"""How far to believe the network: factors on its slopes and on what it takes for light, on training sets left out.

    .venv/bin/python training/calibrate.py DATA WEIGHTS.safetensors

On the sets that `train.py` only watches, in the light of `benchmarks/svbrdf.py`. Prints the mean squared error of
normals and how far they are from the true ones by ST-LPIPS, for factors on the slopes with and without the relief of
`analytic` (GUESS of `core.decomposition.unet`), and squared error and CIEDE2000 of albedo for shares of the light
(GAIN). A factor of 0 leaves the surface flat, a share of 0 the photo.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
import svbrdf as benchmark  # noqa: E402
from material_palette.core import perceptual  # noqa: E402
from material_palette.core.decomposition import analytic, unet  # noqa: E402
from material_palette.core.torus import normal_from_height  # noqa: E402
from train import WATCHED  # noqa: E402

SIZE, LIGHTS = 256, (11, 22)
FACTORS = (0.0, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0)
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("weights", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    albedo = {k: [] for k in SHARES}
    normal = {(k, guess): [] for guess in (0.0, 1.0) for k in FACTORS}
    for folder in benchmark.split(options.data)[0][::WATCHED]:
        material = benchmark.read_material(folder, SIZE)
        truth, lab = material.normal.numpy(), benchmark.cielab(material.albedo.numpy())
        for light in LIGHTS:
            texture = benchmark.photographed(material, light)
            found = unet.decompose(texture, lambda fraction, message: None, options.weights, share=1.0, guess=0.0)
            gain = np.log(np.maximum(found.albedo, 1e-3) / np.maximum(texture, 1e-3))
            for k in SHARES:
                scaled = np.clip(np.maximum(texture, 1e-3) * np.exp(k * gain), 0, 1)
                difference = benchmark.ciede2000(lab, benchmark.cielab(scaled)).mean()
                albedo[k].append((10 * np.mean((scaled - material.albedo.numpy()) ** 2), difference))
            deep = analytic.relief(torch.from_numpy(texture))
            for k, guess in normal if material.has_normal else ():
                scaled = normal_from_height(k * torch.from_numpy(found.height) + guess * deep).numpy()
                distance = perceptual.distance(*(benchmark.as_picture(n) for n in (scaled, truth)))
                normal[k, guess].append((10 * np.mean((scaled - truth) ** 2), distance))
    for name, errors in (
        ("share: MSE x 10, CIEDE2000", albedo),
        ("slopes, analytic relief: MSE x 10, ST-LPIPS", normal),
    ):
        print(f"{name} (mean; median)")
        for k, pairs in errors.items():
            mean, median = np.mean(pairs, 0), np.median(pairs, 0)
            print(f"  {k}: {mean[0]:.4f}, {mean[1]:.3f}; {median[0]:.4f}, {median[1]:.3f}")


if __name__ == "__main__":
    main()
