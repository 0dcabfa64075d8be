"""Which Python packages this interpreter lacks, why they are needed, and how to get them; imports none of them."""

import importlib.metadata
import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path


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

# for weights of Segment Anything in these forms
TRANSFORMERS = (Missing("transformers", "transformers", "runs Segment Anything"),)
ONNX = (Missing("onnxruntime", "onnxruntime", "runs Segment Anything"),)
ALL = (*REQUIRED, *DIFFUSION, *ONNX)


def missing(entries=REQUIRED):
    """Return the list of those `entries` that this interpreter can't find, in their order."""
    return [entry for entry in entries if not _found(entry.module)]


@dataclass(frozen=True)
class Engine:
    """One way to do a `task`. missing: the packages it lacks; wanted: else what is to be chosen first."""

    task: str
    name: str
    missing: tuple[Missing, ...] = ()
    wanted: str = ""


def engines(model="", pick="", maps="", find=missing):
    """All engines, by task. model, pick, maps: paths of the weights that are chosen for textures, regions and maps, or
    "". find: as `missing`; a caller may remember what it found."""
    folder = Path(pick)
    onnx = bool(pick) and any(folder.glob("*coder*.onnx"))
    sam = onnx or (bool(pick) and (folder / "config.json").exists())
    materialistic = bool(pick) and not sam and folder.exists()

    def engine(task, name, packages, ready=True, wanted=""):
        return Engine(task, name, tuple(find(packages)), "" if ready else wanted)

    return (
        engine("Textures", "Patch", REQUIRED),
        engine(
            "Textures",
            "Diffusion",
            (*REQUIRED, *DIFFUSION),
            bool(model),
            "Model: Stable Diffusion 1.x, 2.x or SDXL, yours to get",
        ),
        engine("Regions", "Auto Segment and Pick", tuple(entry for entry in REQUIRED if entry.module != "torch")),
        engine(
            "Regions",
            "Segment Anything",
            (*REQUIRED, *(ONNX if onnx else TRANSFORMERS)),
            sam,
            "Pick With: a folder of SAM, SAM 2 or MobileSAM, yours to get",
        ),
        engine(
            "Regions", "Materialistic", REQUIRED, materialistic, "Pick With: the checkpoint that its authors publish"
        ),
        engine("Maps", "U-Net", REQUIRED),
        engine(
            "Maps",
            "ResNet-101",
            REQUIRED,
            bool(maps) and Path(maps).is_file(),
            "Maps By: model.ckpt, which Material Palette's authors publish",
        ),
    )


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
