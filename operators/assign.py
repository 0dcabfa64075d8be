"""Assign: the palette's active material to objects or faces, mapped at its real size, or in the place of another."""

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty
from bpy.types import Operator

from .palette import NeedsMaterial, active_entry

UV_NAME = "Palette Metres"  # one unit of it is a metre


class MATERIAL_PALETTE_OT_assign(NeedsMaterial, Operator):
    """Give the selected objects, or in Edit Mode the selected faces, the active material of the palette"""

    bl_idname = "material_palette.assign"
    bl_label = "Assign"
    bl_options = {"REGISTER", "UNDO"}

    mapping: EnumProperty(
        name="Mapping",
        description="Where the texture lies on the objects",
        items=(
            ("KEEP", "Keep", "Leave the UV maps as they are"),
            ("UNMAPPED", "Map Unmapped", "Box mapping at real-world scale for meshes without UV map"),
            ("ALL", "Map All", "Box mapping at real-world scale for all, in a UV map of its own"),
        ),
        options={"SKIP_SAVE"},
    )

    @classmethod
    def description(cls, context, properties):
        if properties.mapping == "KEEP":
            return cls.__doc__
        which = "meshes without UV map" if properties.mapping == "UNMAPPED" else "meshes"
        return f"{cls.__doc__}. The {which} get a box mapping on which the texture has its size in metres"

    def execute(self, context):
        material = active_entry(context.scene.material_palette).material
        if not context.selected_objects and context.mode != "EDIT_MESH":
            self.report({"ERROR"}, "No object is selected")
            return {"CANCELLED"}
        if context.mode == "EDIT_MESH":
            objects, others = _assign_faces(context, material), []
            if not objects:
                self.report({"ERROR"}, "No face is selected")
                return {"CANCELLED"}
        else:
            objects, others = [], []
            for obj in context.selected_objects:
                (objects if _give(obj, material) else others).append(obj)
        refused = f"{_names(others)} can't hold a material" if others else ""
        if not objects:
            self.report({"ERROR"}, refused)
            return {"CANCELLED"}
        meshes = [obj for obj in objects if obj.type == "MESH"]
        if self.mapping != "KEEP":
            mapped = [obj for obj in meshes if self.mapping == "ALL" or not obj.data.uv_layers]
            for obj in {obj.data: obj for obj in mapped}.values():
                map_box(obj)
        # a mesh without UV map shows the texture's corner pixel all over
        bare = [obj for obj in meshes if not obj.data.uv_layers and _is_textured(material)]
        unmapped = f"{_names(bare)} has no UV map: use Assign and Map" if bare else ""
        said = f"'{material.name}' assigned to {_names(objects)}"
        warnings = [text for text in (refused, unmapped) if text]
        self.report({"WARNING"} if warnings else {"INFO"}, "; ".join([said, *warnings]))
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_replace_material(NeedsMaterial, Operator):
    """Put the active material of the palette in the place of another one, on every object of the file"""

    bl_idname = "material_palette.replace_material"
    bl_label = "Replace Material"
    bl_options = {"REGISTER", "UNDO"}
    bl_property = "other"

    def _others(self, context):
        entry = active_entry(context.scene.material_palette)
        ours = [entry.material, entry.previous] if entry else []
        others = [material for material in bpy.data.materials if material not in ours and not material.is_grease_pencil]
        _items[:] = [(material.name_full, material.name, "") for material in others if material.users]
        return _items

    other: EnumProperty(name="Material", description="The material that is replaced", items=_others)
    everywhere: BoolProperty(
        name="Everywhere", default=True, description="In the whole file, else on the selected objects only"
    )

    def invoke(self, context, event):
        context.window_manager.invoke_search_popup(self)
        return {"FINISHED"}

    def execute(self, context):
        settings = context.scene.material_palette
        material = active_entry(settings).material
        other = next(m for m in bpy.data.materials if m.name_full == self.other)
        count = 0
        for obj in bpy.data.objects if self.everywhere else context.selected_objects:
            for slot in obj.material_slots:
                if slot.material == other and obj.is_editable and (slot.link == "OBJECT" or obj.data.is_editable):
                    slot.material = material
                    count += 1
        if not count:
            self.report({"WARNING"}, f"No object has '{other.name}'")
            return {"CANCELLED"}
        self.report({"INFO"}, f"'{other.name}' replaced {count} times")
        return {"FINISHED"}


_items = []  # Blender needs the strings of a dynamic enum to live on


def map_box(obj):
    """Give a mesh object a UV map in metres: each face is projected along the axis it faces most, upright on walls.

    The object's scale counts, so that the texture has its real size on it; objects that share the mesh share the map.
    """
    mesh, scale = obj.data, np.abs(np.array(obj.matrix_world.to_scale(), np.float32))
    edits = mesh.is_editmode
    if edits:
        obj.update_from_editmode()
        bpy.ops.object.mode_set(mode="OBJECT")
    layer = mesh.uv_layers.get(UV_NAME) or mesh.uv_layers.new(name=UV_NAME)
    points = np.empty(len(mesh.vertices) * 3, np.float32)
    mesh.vertices.foreach_get("co", points)
    corners, totals = np.empty(len(mesh.loops), np.int32), np.empty(len(mesh.polygons), np.int32)
    mesh.loops.foreach_get("vertex_index", corners)
    mesh.polygons.foreach_get("loop_total", totals)
    normals = np.empty(len(mesh.polygons) * 3, np.float32)
    mesh.polygons.foreach_get("normal", normals)
    if len(totals):
        uv = box_uv(points.reshape(-1, 3) * scale, corners, totals, normals.reshape(-1, 3) / np.maximum(scale, 1e-9))
        layer.data.foreach_set("uv", uv.ravel())
    mesh.uv_layers.active = layer
    layer.active_render = True
    mesh.update()
    if edits:
        bpy.ops.object.mode_set(mode="EDIT")


def box_uv(points, corners, totals, normals):
    """(n, 2) float32 for n face corners.

    points (v, 3) in metres; corners (n,) vertex of each face corner; totals (f,) corners of each face; normals (f, 3)
    of any length. Seen from outside, u runs to the right and, but for floors and ceilings, v up.
    """
    axis = np.abs(normals).argmax(1)
    sign = np.where(np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0, -1.0, 1.0)
    axis, sign = np.repeat(axis, totals), np.repeat(sign, totals)
    x, y, z = points[corners].T
    u = np.choose(axis, [y * sign, -x * sign, x])
    v = np.choose(axis, [z, z, y * sign])
    return np.stack([u, v], 1).astype(np.float32)


def _assign_faces(context, material):
    """Give the selected faces of the meshes in Edit Mode the material; return the objects that had any."""
    import bmesh

    assigned = []
    for obj in context.objects_in_mode_unique_data:
        faces = [face for face in bmesh.from_edit_mesh(obj.data).faces if face.select]
        if not faces or not (obj.is_editable and obj.data.is_editable):
            continue
        names = [slot.material for slot in obj.material_slots]
        if material not in names:
            if not names:
                obj.data.materials.append(None)  # else the other faces would get it too
            obj.data.materials.append(material)
        index = [slot.material for slot in obj.material_slots].index(material)
        for face in faces:
            face.material_index = index
        bmesh.update_edit_mesh(obj.data, loop_triangles=False, destructive=False)
        assigned.append(obj)
    return assigned


def _give(obj, material):
    """Put `material` into the object's active slot; return whether it is there: some objects refuse."""
    if not (hasattr(obj.data, "materials") and obj.is_editable and obj.data.is_editable):
        return False
    obj.active_material = material
    return obj.active_material == material


def _is_textured(material):
    return any(node.bl_idname == "ShaderNodeTexImage" for node in material.node_tree.nodes)


def _names(objects):
    names = [f"'{obj.name}'" for obj in objects]
    return ", ".join(names) if len(names) <= 4 else f"{', '.join(names[:3])} and {len(names) - 3} more"


CLASSES = (MATERIAL_PALETTE_OT_assign, MATERIAL_PALETTE_OT_replace_material)
