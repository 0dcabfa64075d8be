"""Export: the palette as files for other programs, or as a .blend in an asset library."""

import os
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, StringProperty
from bpy.types import Operator

from ..core.errors import PaletteError
from .setup import NeedsPackages


class _NeedsPalette:
    @classmethod
    def poll(cls, context):
        if any(entry.material for entry in context.scene.material_palette.palette):
            return True
        cls.poll_message_set("Extract a palette first")
        return False


class _ExportsPalette(NeedsPackages, _NeedsPalette):
    """Mixin: works on the palette's materials that are there."""

    def materials(self, context):
        settings = context.scene.material_palette
        chosen = settings.palette[settings.active_material :][:1] if self.only_active else settings.palette
        return list(dict.fromkeys(entry.material for entry in chosen if entry.material))


class MATERIAL_PALETTE_OT_export(_ExportsPalette, Operator):
    """Write the palette, adjustments and all, for other programs: MaterialX documents with their maps, and glTF's
    texture sets"""

    bl_idname = "material_palette.export"
    bl_label = "Export Palette"
    bl_options = {"REGISTER"}

    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE"})
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    only_active: BoolProperty(name="Only the Active Material", description="Leave the others of the palette out")
    materialx: BoolProperty(
        name="MaterialX", default=True, description="A .mtlx document per material, with its maps beside it"
    )
    gltf: BoolProperty(
        name="glTF Textures",
        default=True,
        description="Base colour, normal, and occlusion, roughness and metallic in the channels of one picture",
    )

    def invoke(self, context, event):
        if self.directory:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        from ..core.region import file_name

        folder = Path(bpy.path.abspath(self.directory))
        materials, owners = self.materials(context), {}
        try:
            if not folder.is_dir():
                raise PaletteError(f"No such folder: {folder}")
            for material in materials:
                owner = owners.setdefault(file_name(material.name).casefold(), material)
                if owner != material:
                    one, other = owner.name, material.name
                    raise PaletteError(f"Materials '{one}' and '{other}' would share one file name; rename one")
            for material in materials:
                self._write(material, file_name(material.name), folder)
        except (PaletteError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{len(materials)} materials written to {folder}")
        return {"FINISHED"}

    def _write(self, material, name, folder):
        from ..core import export
        from ..core.image import srgb_from_linear, write_image
        from ..core.nodes import Controls

        maps, tile_size, rotation, relief = adjusted_maps(material)
        controls = Controls(material)
        nodes = {kind: controls.node(kind) for kind in ("basecolor", "normal", "roughness")}
        # Blender has floats of more than 8 bits
        bits = {kind: 16 if node and node.image and node.image.is_float else 8 for kind, node in nodes.items()}
        bits["height"] = 16
        folder = folder / name
        folder.mkdir(exist_ok=True)
        if self.gltf:
            straight = {}
            if maps["normal"] is not None:  # the pictures of this set aren't turned
                straight["normal"] = export.adjust_normal(maps["normal"], 1.0, -rotation)
            export.write_gltf_maps(folder, name, maps | straight, bits)
        if self.materialx:
            # the relief is told once, as the material has it
            maps["height" if controls.relief == "NORMAL" else "normal"] = None
            listed = dict(maps) | {"height_scale": relief}
            for kind, value in maps.items():
                if np.ndim(value) < 2:
                    continue
                encoded = {"basecolor": lambda v: np.clip(srgb_from_linear(v), 0, 1), "normal": lambda v: (v + 1) / 2}
                turned = "_turned" if kind == "normal" and rotation else ""
                listed[kind] = f"{name}_{kind}{turned}.png"
                write_image(folder / listed[kind], encoded.get(kind, lambda v: v)(value), bits[kind])
            export.write_materialx(folder / f"{name}.mtlx", name, listed, tile_size, rotation)


def adjusted_maps(material):
    """What a material of ours looks like: (maps, tile_size, rotation, relief in metres).

    maps: "basecolor" (H, W, 3) linear or (3,), "normal" (H, W, 3) unit vectors or None, "roughness" (H, W) or float,
    "metallic" float, "height" (H, W) in [0, 1] or None; adjustments are in them. Raises PaletteError for a material
    that isn't ours.
    """
    return adjuster(material)()


def adjuster(material, most=None, height=True):
    """Read `material` now; return a function without bpy, for any thread, that gives what `adjusted_maps` does.

    most: px, the longest side of a map that is wanted, None for all there is. height: whether that map is wanted.
    """
    from ..core.nodes import Controls

    controls = Controls(material)
    if not controls:
        raise PaletteError(f"'{material.name}' was not made by Material Palette, or its nodes were taken apart")

    def picture(kind):
        node = controls.node(kind)
        return read_map(node.image, most) if node and node.image else None

    maps = {kind: picture(kind) for kind in ("basecolor", "normal", "roughness")}
    image = material.get("height") if height else None
    maps["height"] = read_map(image, most)[..., 0] if image is not None else None
    inputs = controls.node("principled").inputs
    maps["metallic"] = float(inputs["Metallic"].default_value)
    constant = np.array(inputs["Base Color"].default_value[:3], np.float32), float(inputs["Roughness"].default_value)
    values, tile_size = controls.values(), controls.tile_size
    relief = material.get("height_scale", 0.0) * (tile_size or 1.0) * values["strength"]

    def adjust():
        from ..core.export import adjust_colour, adjust_normal

        colour, normal, roughness = (maps[kind] for kind in ("basecolor", "normal", "roughness"))
        colours = values["hue"], values["saturation"], values["brightness"]
        colour = constant[0] if colour is None else adjust_colour(colour, *colours)
        if normal is not None:
            normal = adjust_normal(normal * 2 - 1, values["strength"], values["rotation"])
        if roughness is None:
            roughness = constant[1]
        else:
            roughness = np.clip(roughness[..., 0] + values["roughness_offset"], 0, 1)
        adjusted = {"basecolor": colour, "normal": normal, "roughness": roughness}
        return maps | adjusted, tile_size, values["rotation"], relief

    return adjust


def read_map(image, most=None):
    """(H, W, 3) float32, top row first: a base colour linear, other maps as stored; averaged down, as
    stored, to sides of at most `most` px."""
    from ..core.image import linear_from_srgb

    width, height = image.size
    if not (width and height):
        raise PaletteError(f"Texture '{image.name}' has no pixels; is its file still there?")
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(height, width, 4)[::-1, :, :3]
    step = -(-max(width, height) // most) if most else 1
    if step > 1:
        rows, columns = height // step, width // step
        pixels = pixels[: rows * step, : columns * step].reshape(rows, step, columns, step, 3).mean((1, 3))
    # Blender has decoded those of more than 8 bits itself
    if image.colorspace_settings.name == "sRGB" and not image.is_float:
        pixels = linear_from_srgb(pixels)
    return np.ascontiguousarray(pixels)


_items = []  # Blender needs the strings of a dynamic enum to live on


def _libraries(_operator, context):
    libraries = context.preferences.filepaths.asset_libraries
    _items[:] = [(library.name, library.name, library.path) for library in libraries if library.path]
    return _items or [("", "No asset library", "Add one in Blender's preferences")]


class MATERIAL_PALETTE_OT_save_library(_ExportsPalette, Operator):
    """Save the palette, textures and all, as a .blend in an asset library, to be used from other files"""

    bl_idname = "material_palette.save_library"
    bl_label = "Save to Asset Library"
    bl_options = {"REGISTER"}

    library: EnumProperty(
        name="Library", description="One of the asset libraries in Blender's preferences", items=_libraries
    )
    name: StringProperty(name="File", description="Name of the .blend; a number is added when it is taken")
    only_active: BoolProperty(name="Only the Active Material", description="Leave the others of the palette out")

    def invoke(self, context, event):
        photo = context.scene.material_palette.photo
        self.name = f"{os.path.splitext(photo.name)[0]} palette" if photo else "palette"
        return context.window_manager.invoke_props_dialog(self, confirm_text="Save")

    def execute(self, context):
        from ..core import nodes
        from ..core.region import file_name

        library = next((x for x in context.preferences.filepaths.asset_libraries if x.name == self.library), None)
        if library is None:
            self.report({"ERROR"}, "There is no asset library; add one in Blender's preferences")
            return {"CANCELLED"}
        folder = Path(bpy.path.abspath(library.path))
        try:
            folder.mkdir(parents=True, exist_ok=True)  # that of a new Blender is named before it is made
        except OSError as error:
            self.report({"ERROR"}, f"There is no folder {folder}, and it can't be made: {error.strerror}")
            return {"CANCELLED"}
        name, number = file_name(self.name.strip() or "palette"), 1
        path = folder / f"{name}.blend"
        while path.exists():
            number += 1
            path = folder / f"{name} {number}.blend"
        materials = self.materials(context)
        packed = [image for m in materials for image in nodes.images_of(m) if not image.packed_file]
        try:
            for image in packed:
                image.pack()
            bpy.data.libraries.write(str(path), set(materials), path_remap="RELATIVE", fake_user=True, compress=True)
            nodes.add_catalogue(folder)
        except (RuntimeError, OSError) as error:
            self.report({"ERROR"}, f"{path} can't be written: {error}")
            return {"CANCELLED"}
        finally:
            for image in packed:
                if image.packed_file:
                    image.unpack(method="REMOVE")
        try:
            bpy.ops.asset.library_refresh()
        except RuntimeError:  # no Asset Browser is open
            pass
        self.report({"INFO"}, f"{len(materials)} materials saved in {path}")
        return {"FINISHED"}


CLASSES = (MATERIAL_PALETTE_OT_export, MATERIAL_PALETTE_OT_save_library)
