"""The menu "Material Palette" in the Image Editor's Image menu and the 3D View's Object menu."""

import bpy


class MATERIAL_PALETTE_MT_image(bpy.types.Menu):
    bl_label = "Material Palette"

    def draw(self, context):
        layout = self.layout
        layout.operator("material_palette.use_shown_image", icon="IMAGE_REFERENCE")
        layout.operator("material_palette.open_photo", icon="FILE_FOLDER")
        layout.operator("material_palette.paste_photo", icon="PASTEDOWN")
        layout.separator()
        layout.operator("material_palette.pick_region", icon="EYEDROPPER")
        layout.operator("material_palette.add_region", icon="ADD")
        layout.operator("material_palette.paint_region", icon="BRUSH_DATA")
        layout.operator_menu_enum("material_palette.draw_region", "shape")
        layout.menu("MATERIAL_PALETTE_MT_region")
        layout.operator("material_palette.segment", icon="MOD_EXPLODE")
        layout.separator()
        layout.operator("material_palette.extract", icon="MATERIAL")


class MATERIAL_PALETTE_MT_object(bpy.types.Menu):
    bl_label = "Material Palette"

    def draw(self, context):
        layout = self.layout
        layout.operator("material_palette.extract", icon="MATERIAL")
        layout.separator()
        layout.operator("material_palette.assign", icon="CHECKMARK").mapping = "KEEP"
        layout.operator("material_palette.assign", text="Assign and Map", icon="UV").mapping = "UNMAPPED"
        layout.operator("material_palette.replace_material", icon="ARROW_LEFTRIGHT")


def _draw_image(self, context):
    self.layout.separator()
    self.layout.menu("MATERIAL_PALETTE_MT_image", icon="MATERIAL")


def _draw_object(self, context):
    self.layout.separator()
    self.layout.menu("MATERIAL_PALETTE_MT_object", icon="MATERIAL")


CLASSES = (MATERIAL_PALETTE_MT_image, MATERIAL_PALETTE_MT_object)
_PLACES = (("IMAGE_MT_image", _draw_image), ("VIEW3D_MT_object", _draw_object))


def register():
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    for menu, draw in _PLACES:
        getattr(bpy.types, menu).append(draw)


def unregister():
    for menu, draw in _PLACES:
        getattr(bpy.types, menu).remove(draw)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
