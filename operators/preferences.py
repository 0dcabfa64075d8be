"""Preferences of the extension: defaults of new scenes, what engines there are, where its folder is."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty
from bpy.types import AddonPreferences, Operator

from ..core import dependencies
from ..properties import QUALITIES, RESOLUTION_RANGE
from . import history
from .setup import missing

PACKAGE = __package__.rpartition(".")[0]


def preferences(context):
    """The extension's preferences, or None where it isn't enabled as an add-on."""
    addon = context.preferences.addons.get(PACKAGE)
    return addon.preferences if addon else None


def apply_defaults(context, settings):
    """Give a scene that gets its first photo the defaults of the preferences, where nothing else was chosen."""
    chosen = preferences(context)
    for name in ("quality", "resolution", "author", "licence"):
        if chosen is not None and not settings.is_property_set(name):
            setattr(settings, name, getattr(chosen, name))


def diffusion_settings(context):
    """What is chosen here of DiffusionSettings, as a dict."""
    chosen = preferences(context)
    if chosen is None:
        return {}
    model, concepts = (bpy.path.abspath(path) for path in (chosen.model, chosen.concepts))
    if not concepts and history.folder():
        concepts = str(Path(history.folder()) / "concepts")
    return {
        "model": model,
        "concepts": concepts,
        "device": "" if chosen.device == "AUTO" else chosen.device,
        "online": chosen.fetch and bpy.app.online_access,
    }


def pick_weights(context):
    """Path of the weights that Pick Material uses instead of what ships, or ""."""
    chosen = preferences(context)
    return bpy.path.abspath(chosen.pick_weights) if chosen is not None else ""


class MATERIAL_PALETTE_preferences(AddonPreferences):
    bl_idname = PACKAGE

    quality: EnumProperty(
        name="Quality", description="Quality that new scenes begin with", items=QUALITIES, default="balanced"
    )
    resolution: IntProperty(
        name="Resolution",
        description="Resolution that new scenes begin with",
        default=1024,
        min=RESOLUTION_RANGE[0],
        max=RESOLUTION_RANGE[1],
        subtype="PIXEL",
    )
    model: StringProperty(
        name="Model",
        description="Of engine Diffusion: a folder in diffusers' format, a .safetensors checkpoint, or a hub id",
        subtype="FILE_PATH",
    )
    fetch: BoolProperty(
        name="Fetch the Model",
        description="Let a hub id be fetched, several GB, where Blender's own Allow Online Access is on too",
    )
    concepts: StringProperty(
        name="Concepts",
        description="Folder where engine Diffusion keeps what it has learnt, to use it again; else the extension's own",
        subtype="DIR_PATH",
    )
    device: EnumProperty(
        name="Device",
        description="Where engine Diffusion computes; engine Patch needs the CPU only",
        items=(
            ("AUTO", "Automatic", "The best there is"),
            ("cuda", "CUDA", "An NVIDIA GPU, or an AMD one under ROCm"),
            ("mps", "Metal", "The GPU of a Mac"),
            ("cpu", "CPU", "Slow: minutes for each material"),
        ),
    )
    pick_weights: StringProperty(
        name="Pick With",
        description="Weights for Pick Material, and for Auto Segment where it is set to them: a folder of Segment "
        "Anything's or a file of Materialistic's; else what ships",
        subtype="FILE_PATH",
    )
    author: StringProperty(name="Author", description="Written into the assets that are made")
    licence: StringProperty(name="Licence", description="Written into the assets that are made, such as CC0")

    def draw(self, context):
        layout = self.layout
        box = layout.box()
        box.label(text="New scenes", icon="SCENE_DATA")
        column = box.column()
        column.use_property_split = True
        for name in ("quality", "resolution", "author", "licence"):
            column.prop(self, name)
        box = layout.box()
        box.label(text="Engines", icon="MATERIAL")
        for name, lacking in dependencies.engines().items():
            row = box.row()
            row.label(text=name, icon="ERROR" if lacking else "CHECKMARK")
            row.label(text=f"Missing: {', '.join(lacking)}" if lacking else "Ready")
        column = box.column()
        column.use_property_split = True
        for name in ("model", "fetch", "concepts", "device", "pick_weights"):
            column.prop(self, name)
        if missing():
            column = box.column(align=True)
            for entry in missing():
                column.label(text=f"{entry.module}: {entry.reason}", icon="DOT")
            box.operator("material_palette.copy_install_command", icon="COPYDOWN")
            box.label(text="Paste the command into a terminal, then start Blender again.")
        box = layout.box()
        box.label(text="This machine", icon="TIME")
        row = box.row()
        row.label(text=f"{history.count()} materials timed, in {history.folder() or 'memory'}")
        row.operator("material_palette.forget_times", text="Forget")


class MATERIAL_PALETTE_OT_forget_times(Operator):
    """Forget how long extraction took; the next run tells anew, as after a change of the machine"""

    bl_idname = "material_palette.forget_times"
    bl_label = "Forget Times"
    bl_options = {"INTERNAL"}

    def execute(self, context):
        history.clear()
        return {"FINISHED"}


CLASSES = (MATERIAL_PALETTE_preferences, MATERIAL_PALETTE_OT_forget_times)
