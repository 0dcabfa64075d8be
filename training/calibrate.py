"""How far to believe the network: factors on its slopes and its mean gain, tried on training sets left out.

    .venv/bin/python training/calibrate.py DATA WEIGHTS.safetensors [--slopes FACTOR]

Squared error wants the mean of what may be; a network that has learnt its materials by heart is surer than that of
new ones. Tries factors on the slopes and on the mean gain, on the sets that `train.py` only watches, in the light of
`benchmarks/svbrdf.py`, and prints mean squared errors. A factor on the slopes that is given is written into WEIGHTS.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]
import svbrdf as benchmark  # noqa: E402
from material_palette.core.decomposition import unet  # noqa: E402
from material_palette.core.tensors import read_tensors, write_tensors  # noqa: E402
from material_palette.core.torus import normal_from_height  # noqa: E402
from train import WATCHED  # noqa: E402

SIZE, LIGHTS = 256, (11, 22)
SLOPES = (0.0, 0.25, 0.5, 0.6, 0.75, 1.0, 1.25)
GAINS = (0.0, 0.25, 0.5, 0.6, 0.75, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--slopes", type=float)
    options = parser.parse_args()
    torch.set_num_threads(1)
    albedo, normal = {k: [] for k in GAINS}, {k: [] for k in SLOPES}
    for folder in benchmark.split(options.data)[0][::WATCHED]:
        material = benchmark.read_material(folder, SIZE)
        for light in LIGHTS:
            texture = benchmark.photographed(material, light)
            found = unet.decompose(texture, lambda fraction, message: None, options.weights)
            gain = np.log(np.maximum(found.albedo, 1e-3) / np.maximum(texture, 1e-3))
            for k in GAINS:
                scaled = np.clip(found.albedo * np.exp((k - 1) * gain.mean((0, 1))), 0, 1)
                albedo[k].append(np.mean((scaled - material.albedo.numpy()) ** 2))
            for k in SLOPES if material.has_normal else ():
                scaled = normal_from_height(k * torch.from_numpy(found.height)).numpy()
                normal[k].append(np.mean((scaled - material.normal.numpy()) ** 2))
    for name, errors in (("mean gain", albedo), ("slope", normal)):
        print(f"{name}:", ", ".join(f"{k:g} -> {10 * np.mean(e):.4f}" for k, e in errors.items()), "(MSE x 10)")
    if options.slopes is None:
        return
    tensors, metadata = read_tensors(options.weights)
    for name in ("heads.weight", "heads.bias"):
        # the gain's channels come first, four to a pixel of the output
        tensors[name][12:] *= options.slopes
    write_tensors(options.weights, tensors, metadata | {"slopes": f"{options.slopes:g}"})


if __name__ == "__main__":
    main()
