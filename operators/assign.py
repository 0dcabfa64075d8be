"""Assign: the palette's active material to the selected objects."""

from bpy.types import Operator


class MATERIAL_PALETTE_OT_assign(Operator):
    """Give the selected objects the active material of the palette"""

    bl_idname = "material_palette.assign"
    bl_label = "Assign"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        settings = context.scene.material_palette
        if settings.active_material >= len(settings.palette):
            cls.poll_message_set("Extract a palette first")
            return False
        return True

    def execute(self, context):
        settings = context.scene.material_palette
        entry = settings.palette[settings.active_material]
        material = entry.material
        if material is None:
            self.report({"ERROR"}, f"Material of '{entry.name}' was deleted; extract the palette again")
            return {"CANCELLED"}
        if not context.selected_objects:
            self.report({"ERROR"}, "No object is selected")
            return {"CANCELLED"}
        holders, others = [], []
        for obj in context.selected_objects:
            (holders if _give(obj, material) else others).append(obj)
        refused = f"{_names(others)} can't hold a material" if others else ""
        if not holders:
            self.report({"ERROR"}, refused)
            return {"CANCELLED"}
        # a mesh without UV map shows the texture's corner pixel all over
        bare = [obj for obj in holders if obj.type == "MESH" and not obj.data.uv_layers and _is_textured(material)]
        unmapped = f"{_names(bare)} has no UV map, so the texture can't be seen" if bare else ""
        said = f"'{material.name}' assigned to {_names(holders)}"
        warnings = [text for text in (refused, unmapped) if text]
        self.report({"WARNING"} if warnings else {"INFO"}, "; ".join([said, *warnings]))
        return {"FINISHED"}


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


CLASSES = (MATERIAL_PALETTE_OT_assign,)
