"""Principled BSDF materials from the records of palette.json; the one module of core that touches Blender.

UV -> one Mapping (one scale for all maps) -> Image Textures -> Principled BSDF. A map that is a value becomes the
socket's value and no node. Everything runs on Blender's main thread.
"""

from pathlib import Path

import bpy
import numpy as np

from .errors import PaletteError

CATALOG_NAME = "Material Palette"
# Fixed for ever: files made at different times share one catalogue in the Asset Browser.
CATALOG_ID = "6f2b1c0e-8d0a-4a57-9c3e-2f4b7d1a5e60"

PREVIEW_SIZE = 256
_ICON_SIZE = 32

# Left edge of each column and height of an Image Texture's row, from the nodes' drawn sizes in Blender 4.2 to 5.2.
_COLUMN = {"coordinate": -1180, "mapping": -960, "image": -660, "normal": -320, "principled": -60, "output": 300}
_ROW = 320
_LABELS = {"basecolor": "Base Color", "normal": "Normal", "roughness": "Roughness"}


def build_material(record, folder, *, pack, preview=None):
    """Build one material in the current file and return it.

    record: one "ok" entry of palette.json["materials"]. folder: what the record's files are relative to. pack: store
    the files in the .blend, else refer to them. preview: (256, 256, 4) float32 sRGB-encoded RGBA, top row first, or
    None. The height map gets no node: it rides along as the custom properties "height" (image), "height_scale" (tile
    widths) and "height_midlevel", for whoever wants displacement. Raises PaletteError for a failed record, a file that
    is missing and a constant normal that isn't flat; what was built until then is removed.
    """
    if record["status"] != "ok":
        raise PaletteError(f"material '{record['name']}' failed, there is nothing to build: {record['error']}")
    material = bpy.data.materials.new(record["name"])
    images = []
    try:
        _build_tree(material, record, Path(folder), pack, images)
        _keep_height(material, record, Path(folder), pack, images)
        if preview is not None:
            set_preview(material, preview)
    except BaseException:
        bpy.data.materials.remove(material)
        for image in images:
            bpy.data.images.remove(image)
        raise
    return material


def set_preview(material, preview):
    """Give `material` the picture `preview`: (256, 256, 4) float32 sRGB-encoded RGBA in [0, 1], top row first."""
    preview = np.asarray(preview, np.float32)
    if preview.shape != (PREVIEW_SIZE, PREVIEW_SIZE, 4):
        raise PaletteError(f"a preview is {PREVIEW_SIZE} x {PREVIEW_SIZE} RGBA, not an array of shape {preview.shape}")
    # Blender keeps previews bottom row first and draws them as premultiplied
    upright = np.concatenate([preview[..., :3] * preview[..., 3:], preview[..., 3:]], -1)[::-1]
    step = PREVIEW_SIZE // _ICON_SIZE
    icon = upright.reshape(_ICON_SIZE, step, _ICON_SIZE, step, 4).mean((1, 3), dtype=np.float32)
    slot = material.preview_ensure()
    slot.image_size = upright.shape[1::-1]
    slot.image_pixels_float.foreach_set(np.ascontiguousarray(upright).ravel())
    # without its own small picture Blender renders one whenever a list shows the material
    slot.icon_size = icon.shape[1::-1]
    slot.icon_pixels_float.foreach_set(np.ascontiguousarray(icon).ravel())


def mark_asset(material, description):
    """Mark `material` as an asset of the catalogue "Material Palette"."""
    material.asset_mark()
    asset = material.asset_data
    asset.catalog_id = CATALOG_ID
    asset.description = description
    for tag in ("Material Palette", "tileable", "PBR"):
        asset.tags.new(tag, skip_if_exists=True)


def images_of(material):
    """Return the images `material` uses, the height map with them, each once."""
    images = [node.image for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeTexImage"]
    images.append(material.get("height"))
    return list(dict.fromkeys(image for image in images if image is not None))


def remove_material(material):
    """Remove `material` and the images that nothing else uses."""
    images = images_of(material)
    bpy.data.materials.remove(material)
    for image in images:
        if image.users == 0:
            bpy.data.images.remove(image)


def write_blend(path, palette_json, folder, previews, *, pack):
    """Write the materials of a palette as assets to the .blend `path`, a catalogue file beside it.

    palette_json: the dict of palette.json; failed materials are left out. folder: what its files are relative to; with
    `pack` false the .blend refers to them relative to itself, so both can be moved together. previews: {material name:
    (256, 256, 4) float32}. The current file is as before afterwards, also when this raises.
    """
    path = Path(path)
    records = [record for record in palette_json["materials"] if record["status"] == "ok"]
    built = []
    with _names_free(record["name"] for record in records):
        try:
            for record in records:
                material = build_material(record, folder, pack=pack, preview=previews.get(record["name"]))
                built.append(material)
                mark_asset(material, f"Extracted from {palette_json['photo']}")
            bpy.data.libraries.write(str(path), set(built), path_remap="RELATIVE", fake_user=True)
        finally:
            for material in built:
                remove_material(material)
    catalogue = f"VERSION 1\n\n{CATALOG_ID}:{CATALOG_NAME}:{CATALOG_NAME}\n"
    (path.parent / "blender_assets.cats.txt").write_text(catalogue, encoding="utf-8")


class _names_free:
    """While it lasts, no material of the current file has one of `names`: two materials can't share a name."""

    def __init__(self, names):
        self._names = list(names)

    def __enter__(self):
        self._renamed = []
        for name in self._names:
            material = bpy.data.materials.get(name)
            if material is not None and material.library is None:
                self._renamed.append((material, material.name))
                material.name = "Material Palette stand-in"

    def __exit__(self, *_error):
        for material, name in self._renamed:
            material.name = name


def _build_tree(material, record, folder, pack, images):
    if material.node_tree is None:  # from Blender 5.0 on every material has a tree and `use_nodes` is deprecated
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    principled = _node(tree, "ShaderNodeBsdfPrincipled", "principled", 0)
    output = _node(tree, "ShaderNodeOutputMaterial", "output", 0)
    tree.links.new(principled.outputs["BSDF"], output.inputs["Surface"])
    textures = {}
    for role, map_ in record["maps"].items():
        if role not in _LABELS:
            continue
        if "file" in map_:
            image = _load(folder, map_["file"], pack, data=role != "basecolor")
            images.append(image)
            textures[role] = image
        else:
            _set_constant(principled, role, map_["value"], record["name"])
    if textures:
        _wire_textures(tree, principled, textures, record["metres_per_tile"])


def _set_constant(principled, role, value, name):
    if role == "basecolor":
        red, green, blue = value
        principled.inputs["Base Color"].default_value = (red, green, blue, 1.0)
    elif role == "roughness":
        principled.inputs["Roughness"].default_value = value
    elif not np.allclose(value, (0.0, 0.0, 1.0)):
        raise PaletteError(f"material '{name}': a constant normal has to be flat (0, 0, 1), not {tuple(value)}")


def _wire_textures(tree, principled, textures, metres_per_tile):
    coordinate = _node(tree, "ShaderNodeTexCoord", "coordinate", 0)
    mapping = _node(tree, "ShaderNodeMapping", "mapping", 0, "Scale of all maps")
    mapping.inputs["Scale"].default_value = (1.0 / metres_per_tile,) * 3
    tree.links.new(coordinate.outputs["UV"], mapping.inputs["Vector"])
    _frame(tree, f"One tile is {metres_per_tile:g} m", (coordinate, mapping))
    nodes = []
    for row, role in enumerate(role for role in _LABELS if role in textures):
        node = _node(tree, "ShaderNodeTexImage", "image", row, _LABELS[role])
        node.image = textures[role]
        tree.links.new(mapping.outputs["Vector"], node.inputs["Vector"])
        nodes.append(node)
        if role == "basecolor":
            tree.links.new(node.outputs["Color"], principled.inputs["Base Color"])
        elif role == "roughness":
            tree.links.new(node.outputs["Color"], principled.inputs["Roughness"])
        else:
            bend = _node(tree, "ShaderNodeNormalMap", "normal", row)
            tree.links.new(node.outputs["Color"], bend.inputs["Color"])
            tree.links.new(bend.outputs["Normal"], principled.inputs["Normal"])
            nodes.append(bend)
    _frame(tree, "Maps", nodes)


def _node(tree, idname, column, row, label=""):
    node = tree.nodes.new(idname)
    node.location = (_COLUMN[column], -row * _ROW)
    node.label = label
    node.select = False
    return node


def _frame(tree, label, nodes):
    frame = tree.nodes.new("NodeFrame")
    frame.label = label
    for node in nodes:
        node.parent = frame
    frame.select = False


def _keep_height(material, record, folder, pack, images):
    height = record["maps"].get("height", {})
    if "file" not in height:
        return
    image = _load(folder, height["file"], pack, data=True)
    images.append(image)
    material["height"] = image
    material["height_scale"] = float(height["scale"])
    material["height_midlevel"] = float(height["midlevel"])


def _load(folder, file, pack, *, data):
    path = folder / file
    if not path.is_file():
        raise PaletteError(f"texture file is missing: {path}")
    image = bpy.data.images.load(str(path.resolve()), check_existing=False)
    image.name = path.stem
    image.colorspace_settings.name = "Non-Color" if data else "sRGB"
    if pack:
        image.pack()
        # where the texture lay when it was packed is nobody's business and may be gone: unpack beside the .blend
        image.filepath_raw = f"//{file}"
        image.packed_files[0].filepath = f"//{file}"
    elif bpy.data.filepath:
        try:
            image.filepath_raw = bpy.path.relpath(image.filepath_raw)
        except ValueError:  # another drive of Windows: only an absolute path leads there
            pass
    return image
