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


def engines(context):
    """What there is to choose from, and what each lacks, as core.dependencies has it."""
    chosen = preferences(context)
    paths = (chosen.model, chosen.pick_weights, chosen.maps_by) if chosen is not None else ("", "", "")
    return dependencies.engines(*map(bpy.path.abspath, paths), find=missing)


def decomposer(context):
    """What finds the maps, as core.decomposition names it."""
    chosen = preferences(context)
    return f"resnet101={bpy.path.abspath(chosen.maps_by)}" if chosen is not None and chosen.maps_by else "unet"


_WEIGHTS = {"Textures": ("model", "fetch", "concepts", "device"), "Regions": ("pick_weights",), "Maps": ("maps_by",)}
_EMPTY = {  # what an empty field means
    "author": "Of the photos",
    "licence": "Of the photos, such as CC0",
    "model": "None: a folder, a .safetensors file or a hub id",
    "concepts": "The extension's own folder",
    "pick_weights": "What ships",
    "maps_by": "The network that ships",
}


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
    maps_by: StringProperty(
        name="Maps By",
        description="Checkpoint of the network of Material Palette's authors, to find albedo, normals and roughness; "
        "else the network that ships",
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
            column.prop(self, name, placeholder=_EMPTY.get(name, ""))
        found = engines(context)
        for task, icon in (("Textures", "TEXTURE"), ("Regions", "SELECT_SET"), ("Maps", "NODE_MATERIAL")):
            box = layout.box()
            box.label(text=task, icon=icon)
            column = box.column(align=True)
            for engine in found:
                if engine.task == task:
                    _draw_engine(column, engine)
            column = box.column()
            column.use_property_split = True
            for name in _WEIGHTS[task]:
                column.prop(self, name, placeholder=_EMPTY.get(name, ""))
        if missing():
            box = layout.box()
            column = box.column(align=True)
            for entry in missing():
                column.label(text=f"{entry.module}: {entry.reason}", icon="DOT")
            box.operator("material_palette.copy_install_command", icon="COPYDOWN")
            box.label(text="Paste the command into a terminal, then start Blender again.")
        box = layout.box()
        box.label(text="This machine", icon="TIME")
        row = box.row()
        row.label(text=f"{history.count()} materials timed" if history.count() else "No material timed yet")
        row.operator("material_palette.forget_times", text="Forget")
        if history.folder():
            row = box.row()
            row.label(text=str(history.folder()))
            row.operator("wm.path_open", text="Open Folder", icon="FILE_FOLDER").filepath = str(history.folder())


def _draw_engine(column, engine):
    """Ready, or what is missing and how to get it."""
    split = column.split(factor=0.32)
    ready = not (engine.missing or engine.wanted)
    split.label(text=engine.name, icon="CHECKMARK" if ready else "BLANK1")
    row = split.row()
    said = row.row()
    said.active = ready
    said.label(
        text=f"Missing: {', '.join(e.module for e in engine.missing)}" if engine.missing else engine.wanted or "Ready"
    )
    if engine.missing:
        copy = row.operator("material_palette.copy_install_command", text="", icon="COPYDOWN")
        copy.modules = " ".join(entry.module for entry in engine.missing)


class MATERIAL_PALETTE_OT_forget_times(Operator):
    """Forget how long extraction took; the next run tells anew, as after a change of the machine"""

    bl_idname = "material_palette.forget_times"
    bl_label = "Forget Times"
    bl_options = {"INTERNAL"}

    def execute(self, context):
        history.clear()
        return {"FINISHED"}


CLASSES = (MATERIAL_PALETTE_preferences, MATERIAL_PALETTE_OT_forget_times)
