"""Which Python packages this interpreter lacks, why they are needed, and how to get them; imports none of them."""

import importlib.metadata
import importlib.util
import sys
from dataclasses import dataclass


@dataclass(frozen=True)
class Missing:
    """A package that is not there: `module` as imported, `package` as installed, `reason` it is needed for."""

    module: str
    package: str
    reason: str


REQUIRED = (
    Missing("numpy", "numpy", "holds every image"),
    Missing("OpenImageIO", "OpenImageIO", "reads photos and masks, writes textures"),
    Missing("cv2", "opencv-contrib-python-headless", "finds regions and filters images"),
    Missing("torch", "torch", "synthesises the textures"),
)

# for the engine of that name alone
DIFFUSION = (
    Missing("diffusers", "diffusers", "runs Stable Diffusion"),
    Missing("transformers", "transformers", "encodes the prompts"),
    Missing("peft", "peft", "learns a concept"),
    Missing("accelerate", "accelerate", "loads the weights"),
    Missing("safetensors", "safetensors", "reads the weights"),
)


def missing(entries=REQUIRED):
    """Return the list of those `entries` that this interpreter can't find, in their order."""
    return [entry for entry in entries if not _found(entry.module)]


def engines():
    """{engine as a person calls it: names of the packages it lacks}."""
    lacking = [entry.module for entry in missing()]
    finding = [module for module in lacking if module != "torch"]
    return {
        "Patch (textures)": lacking,
        "Diffusion (textures)": lacking + [entry.module for entry in missing(DIFFUSION)],
        "Auto Segment and Pick Material (regions)": finding,
    }


def install_command(entries, python=None):
    """Return the one-line shell command that installs `entries` (list of Missing) for this interpreter.

    numpy is pinned to the version at hand: Blender's own modules are compiled against it.
    """
    packages = [entry.package for entry in entries]
    if "numpy" not in packages:
        packages.append(f"numpy=={importlib.metadata.version('numpy')}")
    return f'"{python or sys.executable}" -m pip install {" ".join(packages)}'


def _found(module):
    # find_spec raises ValueError for a module that stands in sys.modules without a spec, as a stub does
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False
