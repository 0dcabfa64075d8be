"""Shelf: the palette's materials along the 3D View's edge, to be dragged onto objects and faces."""

import bpy


class MATERIAL_PALETTE_AST_palette(bpy.types.AssetShelf):
    bl_idname = "MATERIAL_PALETTE_AST_palette"
    bl_space_type = "VIEW_3D"

    @classmethod
    def poll(cls, context):
        return context.mode in {"OBJECT", "EDIT_MESH"} and bool(context.scene.material_palette.palette)

    @classmethod
    def asset_poll(cls, asset):
        return asset.id_type == "MATERIAL" and "Material Palette" in asset.metadata.tags


def register():
    bpy.utils.register_class(MATERIAL_PALETTE_AST_palette)


def unregister():
    bpy.utils.unregister_class(MATERIAL_PALETTE_AST_palette)
