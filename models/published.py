"""Checkpoints that others publish: their tensors without running code, and in what they differ from a network's."""

from pathlib import Path

import numpy as np
import torch

from ..core.errors import PaletteError
from ..core.tensors import read_tensors


def read_state(path: Path) -> dict[str, torch.Tensor]:
    """The tensors, as float32 on the CPU, of a safetensors file, a state dict or a checkpoint of PyTorch Lightning.

    Raises OSError where the file cannot be read, PaletteError where it is no checkpoint or that could run code from it.
    """
    if path.suffix == ".safetensors":
        state = {name: torch.from_numpy(np.array(x)) for name, x in read_tensors(path)[0].items()}
    else:
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except OSError:
            raise
        except Exception:  # a file of another kind is read as a pickle, which may fail in any way
            raise PaletteError(
                f"'{path}' holds more than tensors, or is no checkpoint; it is not opened, as that could run code from "
                "it. If you trust it, save its 'state_dict' alone with torch.save, and choose that file"
            ) from None
        state = state.get("state_dict", state) if isinstance(state, dict) else {}
        state = state if isinstance(state, dict) else {}
    return {name: x.float() for name, x in state.items() if isinstance(name, str) and isinstance(x, torch.Tensor)}


def differences(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> list[str]:
    """What is wrong with the names and shapes found, a sentence each, sorted; empty when they are those expected."""
    shapes, wanted = ({name: tuple(x.shape) for name, x in state.items()} for state in (found, expected))
    wrong = [f"{name} is missing" for name in wanted.keys() - shapes.keys()]
    wrong += [f"{name} is unknown" for name in shapes.keys() - wanted.keys()]
    both = wanted.keys() & shapes.keys()
    return sorted(wrong + [f"{n} is {shapes[n]}, not {wanted[n]}" for n in both if shapes[n] != wanted[n]])
