"""Principled BSDF materials from the records of palette.json; the one module of core that touches Blender.

UV -> one Mapping (one scale for all maps) -> Image Textures -> Principled BSDF. A map that is a value becomes the
socket's value and no node. `Controls` changes a material afterwards by its nodes alone: what is at its default has no
node. Everything runs on Blender's main thread.
"""

import os
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
_COLUMN = {
    "coordinate": -1430,
    "mapping": -1210,
    "image": -910,
    "adjust": -580,
    "normal": -320,
    "principled": -60,
    "output": 300,
}
_ROW = 320
_LABELS = {"basecolor": "Base Color", "normal": "Normal", "roughness": "Roughness"}
# `Controls` finds nodes by these names, which the file keeps; labels and places are the artist's.
_NAMES = {
    "mapping": "Palette Mapping",
    "basecolor": "Palette Base Color",
    "normal": "Palette Normal",
    "roughness": "Palette Roughness",
    "height": "Palette Height",
    "normal map": "Palette Normal Map",
    "principled": "Palette Principled",
    "output": "Palette Output",
    "colour": "Palette Colour Adjustment",
    "offset": "Palette Roughness Offset",
    "turn": "Palette Normal Rotation",
    "displacement": "Palette Displacement",
}
RELIEFS = ("NORMAL", "BUMP", "DISPLACEMENT")


def build_material(record, folder, *, pack, preview=None, shared=None):
    """Build one material in the current file and return it.

    record: one "ok" entry of palette.json["materials"]. folder: what the record's files are relative to. pack: store
    the files in the .blend, else refer to them. preview: (256, 256, 4) float32 sRGB-encoded RGBA, top row first, or
    None. shared: {(path, is data): image} of the caller: what is in it is not loaded again, what is not is added. The
    height map gets no node until `Controls.relief` asks for it: it rides along as the custom properties "height"
    (image), "height_scale" (tile widths) and "height_midlevel". Raises PaletteError for a failed record, a file that is
    missing and a constant normal that isn't flat; what was built until then is removed.
    """
    if record["status"] != "ok":
        raise PaletteError(f"material '{record['name']}' failed, there is nothing to build: {record['error']}")
    material = bpy.data.materials.new(record["name"])
    images, shared = [], {} if shared is None else shared
    try:
        _build_tree(material, record, Path(folder), pack, images, shared)
        _keep_height(material, record, Path(folder), pack, images, shared)
        if preview is not None:
            set_preview(material, preview)
    except BaseException:
        bpy.data.materials.remove(material)
        for key, image in [*shared.items()]:
            if image in images and image.users == 0:
                bpy.data.images.remove(shared.pop(key))
        raise
    return material


def set_preview(material, preview):
    """Give `material` the picture `preview` of what it looks like now: (256, 256, 4) float32 sRGB-encoded RGBA in
    [0, 1], top row first; None leaves the one it has."""
    # beside the picture in the file, so that undo takes both back
    material["preview_of"] = Controls(material).look()
    if preview is None:
        return
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


def preview_is_of(material, look):
    """Whether the preview of `material` was made of it with this `Controls.look`."""
    return list(material.get("preview_of", ())) == look


def mark_asset(material, description, author="", licence=""):
    """Mark `material` as an asset of the catalogue "Material Palette"."""
    material.asset_mark()
    asset = material.asset_data
    asset.catalog_id = CATALOG_ID
    asset.description, asset.author, asset.license = description, author, licence
    for tag in ("Material Palette", "tileable", "PBR"):
        asset.tags.new(tag, skip_if_exists=True)


def images_of(material):
    """Return the images `material` uses, the height map with them, each once."""
    nodes = material.node_tree.nodes if material.node_tree else ()
    images = [node.image for node in nodes if node.bl_idname == "ShaderNodeTexImage"]
    images.append(material.get("height"))
    return list(dict.fromkeys(image for image in images if image is not None))


def unpack(material, folder):
    """Let the images that `build_material` has packed refer to their files, which lie in `folder`."""
    for image in images_of(material):
        path = Path(folder) / image.filepath_raw.removeprefix("//")
        if image.packed_file and path.is_file():
            image.unpack(method="REMOVE")
            image.filepath_raw = _relative(str(path))
            image.reload()


def remove_material(material):
    """Remove `material` and the images that nothing else uses."""
    images = images_of(material)
    bpy.data.materials.remove(material)
    for image in images:
        if image.users == 0:
            bpy.data.images.remove(image)


class Controls:
    """What an artist adjusts on a finished material, read from its node tree and written into it.

    `tile_size` in metres (None for a material of constants), `rotation` in radians, `relief` one of RELIEFS, `strength`
    of the relief (1 is as extracted), `roughness_offset` in [-1, 1], `hue` in [0, 1] (0.5 is as extracted),
    `saturation` and `brightness` factors. Reading a control whose node is missing gives its default; setting it does
    nothing where the tree lacks what it would act on. `bool(Controls(material))` is whether build_material made it.
    """

    DEFAULTS = {
        "rotation": 0.0,
        "relief": "NORMAL",
        "strength": 1.0,
        "roughness_offset": 0.0,
        "hue": 0.5,
        "saturation": 1.0,
        "brightness": 1.0,
    }

    def __init__(self, material):
        self._material = material
        self._tree = material.node_tree

    def __bool__(self):
        return self.node("principled") is not None

    def node(self, name):
        """The node that build_material or a control has named so, or None."""
        return self._tree.nodes.get(_NAMES[name]) if self._tree else None

    def values(self):
        """All controls by name, the tile's size among them when there is one."""
        names = [*self.DEFAULTS, *(["tile_size"] if self.tile_size else [])]
        return {name: getattr(self, name) for name in names}

    def set(self, values):
        for name, value in values.items():
            setattr(self, name, value)

    def look(self):
        """What can be seen of the adjustments on a preview, as a list of numbers."""
        principled = self.node("principled")
        adjusted = (self.rotation, self.strength, self.roughness_offset, self.hue, self.saturation, self.brightness)
        constants = (*principled.inputs["Base Color"].default_value[:3], principled.inputs["Roughness"].default_value)
        return [self.tile_size or 0.0, *adjusted, *constants]

    def reset(self):
        """Back to what was extracted."""
        self.set(self.DEFAULTS)
        if self.tile_size:
            self.tile_size = self._material.get("metres_per_tile", 1.0)

    @property
    def tile_size(self):
        mapping = self.node("mapping")
        scale = mapping.inputs["Scale"].default_value[0] if mapping else 0.0
        return 1.0 / scale if scale else None

    @tile_size.setter
    def tile_size(self, metres):
        mapping, strength = self.node("mapping"), self.strength
        if mapping:
            mapping.inputs["Scale"].default_value = (1.0 / metres,) * 3
            self.strength = strength  # displacement is in metres: it follows the tile

    @property
    def rotation(self):
        mapping = self.node("mapping")
        return mapping.inputs["Rotation"].default_value[2] if mapping else 0.0

    @rotation.setter
    def rotation(self, angle):
        mapping = self.node("mapping")
        if not mapping:
            return
        mapping.inputs["Rotation"].default_value[2] = angle
        # The mapping turns where a texel is read; the directions that a normal map holds have to turn with the picture.
        turn = self._between("turn", "ShaderNodeVectorRotate", "normal", ("normal map", "Color"), abs(angle) > 1e-6)
        if turn:
            turn.rotation_type = "Z_AXIS"
            turn.inputs["Center"].default_value = (0.5, 0.5, 0.5)
            turn.inputs["Angle"].default_value = -angle

    @property
    def relief(self):
        if self.node("displacement") is None:
            return "NORMAL"
        return "BUMP" if self._material.displacement_method == "BUMP" else "DISPLACEMENT"

    @relief.setter
    def relief(self, relief):
        """NORMAL: the normal map. BUMP, DISPLACEMENT: the height map instead, since both tell of the same relief."""
        strength, output, bend = self.strength, self.node("output"), self.node("normal map")
        links = self._tree.links
        if relief != "NORMAL" and not (self._material.get("height") and output and self.node("mapping")):
            return
        self._material.displacement_method = {"NORMAL": "BUMP", "BUMP": "BUMP", "DISPLACEMENT": "BOTH"}[relief]
        if relief == "NORMAL":
            for name in ("displacement", "height"):
                if self.node(name):
                    self._tree.nodes.remove(self.node(name))
            if bend:
                links.new(bend.outputs["Normal"], self.node("principled").inputs["Normal"])
        elif self.node("displacement") is None:
            image = _node(self._tree, "ShaderNodeTexImage", "image", 3, "Height", name="height")
            image.image = self._material["height"]
            links.new(self.node("mapping").outputs["Vector"], image.inputs["Vector"])
            raise_ = _node(self._tree, "ShaderNodeDisplacement", "normal", 3, name="displacement")
            raise_.inputs["Midlevel"].default_value = self._material["height_midlevel"]
            links.new(image.outputs["Color"], raise_.inputs["Height"])
            links.new(raise_.outputs["Displacement"], output.inputs["Displacement"])
            for link in [*self.node("principled").inputs["Normal"].links]:
                links.remove(link)
        self.strength = strength

    @property
    def strength(self):
        bend, raise_ = self.node("normal map"), self.node("displacement")
        if raise_:
            return raise_.inputs["Scale"].default_value / max(self._relief_metres(), 1e-12)
        return bend.inputs["Strength"].default_value if bend else 1.0

    @strength.setter
    def strength(self, strength):
        bend, raise_ = self.node("normal map"), self.node("displacement")
        if bend:
            bend.inputs["Strength"].default_value = strength
        if raise_:
            raise_.inputs["Scale"].default_value = strength * self._relief_metres()

    def _relief_metres(self):
        return self._material.get("height_scale", 0.0) * (self.tile_size or 1.0)

    @property
    def roughness_offset(self):
        node = self.node("offset")
        return node.inputs[1].default_value if node else 0.0

    @roughness_offset.setter
    def roughness_offset(self, offset):
        node = self._between("offset", "ShaderNodeMath", "roughness", ("principled", "Roughness"), abs(offset) > 1e-6)
        if node:
            node.operation, node.use_clamp = "ADD", True
            node.inputs[1].default_value = offset

    @property
    def hue(self):
        return self._colour("Hue", 0.5)

    @hue.setter
    def hue(self, hue):
        self._set_colour(hue, self.saturation, self.brightness)

    @property
    def saturation(self):
        return self._colour("Saturation", 1.0)

    @saturation.setter
    def saturation(self, saturation):
        self._set_colour(self.hue, saturation, self.brightness)

    @property
    def brightness(self):
        return self._colour("Value", 1.0)

    @brightness.setter
    def brightness(self, brightness):
        self._set_colour(self.hue, self.saturation, brightness)

    def _colour(self, socket, default):
        node = self.node("colour")
        return node.inputs[socket].default_value if node else default

    def _set_colour(self, hue, saturation, brightness):
        changed = max(abs(hue - 0.5), abs(saturation - 1.0), abs(brightness - 1.0)) > 1e-6
        node = self._between("colour", "ShaderNodeHueSaturation", "basecolor", ("principled", "Base Color"), changed)
        if node:
            for socket, value in (("Hue", hue), ("Saturation", saturation), ("Value", brightness)):
                node.inputs[socket].default_value = value

    def _between(self, name, idname, source, target, wanted):
        """The node `name` on the way from the Image Texture `source` to `target` (node, input), made when it is wanted
        and removed when it isn't; None when it isn't there, as without that texture."""
        node, image, end = self.node(name), self.node(source), self.node(target[0])
        if node is None and wanted and image and end:
            node = _node(self._tree, idname, "adjust", 0, name=name)
            node.location.y = image.location.y
            entrance = "Color" if idname == "ShaderNodeHueSaturation" else 0
            self._tree.links.new(image.outputs["Color"], node.inputs[entrance])
            self._tree.links.new(node.outputs[0], end.inputs[target[1]])
        elif node and not wanted:
            self._tree.nodes.remove(node)
            if image and end:
                self._tree.links.new(image.outputs["Color"], end.inputs[target[1]])
            node = None
        return node


def write_blend(path, palette_json, folder, previews, *, pack):
    """Write the materials of a palette as assets to the .blend `path`, a catalogue file beside it.

    palette_json: the dict of palette.json; failed materials are left out. folder: what its files are relative to; with
    `pack` false the .blend refers to them relative to itself, so both can be moved together. previews: {material name:
    (256, 256, 4) float32}. The current file is as before afterwards, also when this raises.
    """
    path = Path(path)
    records = [record for record in palette_json["materials"] if record["status"] == "ok"]
    built, shared = [], {}
    with _names_free(record["name"] for record in records):
        try:
            for record in records:
                preview = previews.get(record["name"])
                material = build_material(record, folder, pack=pack, preview=preview, shared=shared)
                built.append(material)
                mark_asset(material, f"Extracted from {palette_json['photo']}")
            bpy.data.libraries.write(str(path), set(built), path_remap="RELATIVE", fake_user=True)
        finally:
            for material in built:
                remove_material(material)
    add_catalogue(path.parent)


def add_catalogue(folder):
    """Name the assets' catalogue in the folder's catalogue file; what it lists already stays."""
    path = Path(folder) / "blender_assets.cats.txt"
    text = path.read_text(encoding="utf-8") if path.is_file() else "VERSION 1\n\n"
    if CATALOG_ID not in text:
        part = path.with_name(f".{path.name}.part")  # a full disk must not take the user's catalogues
        try:
            part.write_text(f"{text.rstrip()}\n\n{CATALOG_ID}:{CATALOG_NAME}:{CATALOG_NAME}\n", encoding="utf-8")
            os.replace(part, path)
        except BaseException:
            part.unlink(missing_ok=True)
            raise


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


def _build_tree(material, record, folder, pack, images, shared):
    if material.node_tree is None:  # from Blender 5.0 on every material has a tree and `use_nodes` is deprecated
        material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    principled = _node(tree, "ShaderNodeBsdfPrincipled", "principled", 0, name="principled")
    output = _node(tree, "ShaderNodeOutputMaterial", "output", 0, name="output")
    material["metres_per_tile"] = float(record["metres_per_tile"])
    tree.links.new(principled.outputs["BSDF"], output.inputs["Surface"])
    textures = {}
    for role, map_ in record["maps"].items():
        if role not in _LABELS:
            continue
        if "file" in map_:
            image = _load(folder, map_["file"], pack, shared, data=role != "basecolor")
            images.append(image)
            textures[role] = image
        else:
            _set_constant(principled, role, map_["value"], record["name"])
    if textures:
        _wire_textures(tree, principled, textures, record["metres_per_tile"])
    image = textures.get("basecolor")
    # what the 3D View shows of it in Solid shading
    material.diffuse_color = _mean(image) if image else principled.inputs["Base Color"].default_value


def _mean(image):
    """Mean colour of a base colour's image, linear RGBA."""
    from .image import linear_from_srgb  # needs packages that may be missing

    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    pixels = pixels.reshape(-1, 4)[:, :3]
    # Blender has decoded those of more than 8 bits itself
    return (*(pixels if image.is_float else linear_from_srgb(pixels)).mean(0), 1.0)


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
    mapping = _node(tree, "ShaderNodeMapping", "mapping", 0, "Scale of all maps", name="mapping")
    mapping.inputs["Scale"].default_value = (1.0 / metres_per_tile,) * 3
    tree.links.new(coordinate.outputs["UV"], mapping.inputs["Vector"])
    _frame(tree, "Size of a tile", (coordinate, mapping))
    nodes = []
    for row, role in enumerate(role for role in _LABELS if role in textures):
        node = _node(tree, "ShaderNodeTexImage", "image", row, _LABELS[role], name=role)
        node.image = textures[role]
        tree.links.new(mapping.outputs["Vector"], node.inputs["Vector"])
        nodes.append(node)
        if role == "basecolor":
            tree.links.new(node.outputs["Color"], principled.inputs["Base Color"])
        elif role == "roughness":
            tree.links.new(node.outputs["Color"], principled.inputs["Roughness"])
        else:
            bend = _node(tree, "ShaderNodeNormalMap", "normal", row, name="normal map")
            tree.links.new(node.outputs["Color"], bend.inputs["Color"])
            tree.links.new(bend.outputs["Normal"], principled.inputs["Normal"])
            nodes.append(bend)
    _frame(tree, "Maps", nodes)


def _node(tree, idname, column, row, label="", name=None):
    node = tree.nodes.new(idname)
    node.location = (_COLUMN[column], -row * _ROW)
    node.label = label
    if name:
        node.name = _NAMES[name]
    node.select = False
    return node


def _frame(tree, label, nodes):
    frame = tree.nodes.new("NodeFrame")
    frame.label = label
    for node in nodes:
        node.parent = frame
    frame.select = False


def _keep_height(material, record, folder, pack, images, shared):
    height = record["maps"].get("height", {})
    if "file" not in height:
        return
    image = _load(folder, height["file"], pack, shared, data=True)
    images.append(image)
    material["height"] = image
    material["height_scale"] = float(height["scale"])
    material["height_midlevel"] = float(height["midlevel"])


def _load(folder, file, pack, shared, *, data):
    path = folder / file
    if (path, data) in shared:
        return shared[path, data]
    if not path.is_file():
        raise PaletteError(f"texture file is missing: {path}")
    image = shared[path, data] = bpy.data.images.load(str(path.resolve()), check_existing=False)
    image.name = path.stem
    image.colorspace_settings.name = "Non-Color" if data else "sRGB"
    if pack:
        image.pack()
        # where the texture lay when it was packed is nobody's business and may be gone: unpack beside the .blend
        image.filepath_raw = f"//{file}"
        image.packed_files[0].filepath = f"//{file}"
    else:
        image.filepath_raw = _relative(image.filepath_raw)
    return image


def _relative(path):
    if not bpy.data.filepath:
        return path
    try:
        return bpy.path.relpath(path)
    except ValueError:  # another drive of Windows: only an absolute path leads there
        return path
