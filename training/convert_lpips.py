"""Makes models/stlpips_alex.safetensors of the weights in the wheel `stlpips-pytorch` 0.0.2.

    pip install --no-deps stlpips-pytorch==0.0.2
    python training/convert_lpips.py

The package is not imported (that needs torchvision); its weights are read without running anything they may hold.
"""

import argparse
import hashlib
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
import dev  # noqa: E402

dev.load_package()
from material_palette.core.perceptual import WEIGHTS  # noqa: E402
from material_palette.core.tensors import write_tensors  # noqa: E402

CONVOLUTIONS = ("slice1.0", "slice2.5", "slice3.9", "slice4.11", "slice5.13")


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    spec = find_spec("stlpips_pytorch")
    if spec is None:
        sys.exit("stlpips-pytorch is missing: pip install --no-deps stlpips-pytorch==0.0.2")
    source = Path(spec.submodule_search_locations[0]) / "weights" / "vST0.0" / "alex_shift_tolerant.pth"
    state = torch.load(source, map_location="cpu", weights_only=True)
    tensors = {name: state[f"scaling_layer.{name}"] for name in ("shift", "scale")}
    for i, layer in enumerate(CONVOLUTIONS, 1):
        tensors[f"conv{i}.weight"] = state[f"net.{layer}.weight"].half()
        tensors[f"conv{i}.bias"] = state[f"net.{layer}.bias"]
        tensors[f"importance{i}"] = state[f"lin{i - 1}.model.1.weight"].flatten()
    metadata = {
        "source": "stlpips-pytorch 0.0.2, weights/vST0.0/alex_shift_tolerant.pth",
        "source_sha256": hashlib.sha256(source.read_bytes()).hexdigest(),
        "licence": "BSD-2-Clause, Copyright (c) 2022, Abhijay Ghildyal, Feng Liu",
    }
    WEIGHTS.parent.mkdir(exist_ok=True)
    write_tensors(WEIGHTS, {name: np.asarray(x) for name, x in tensors.items()}, metadata)
    print(f"{WEIGHTS.name}: {WEIGHTS.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
