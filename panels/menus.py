"""The menu "Material Palette" in the Image Editor's Image menu and the 3D View's Object and Mesh menus.

Blender's search (F3) finds what stands in menus, so every verb of the artist stands in one.
"""

import bpy


class MATERIAL_PALETTE_MT_all(bpy.types.Menu):
    bl_label = "Material Palette"
    bl_description = "From a photo to materials: photo, regions, extraction, palette"

    def draw(self, context):
        layout = self.layout
        layout.operator("material_palette.use_shown_image", icon="IMAGE_REFERENCE")
        layout.operator("material_palette.open_photo", icon="FILE_FOLDER")
        layout.operator("material_palette.paste_photo", icon="PASTEDOWN")
        layout.operator("material_palette.show_photo", icon="HIDE_OFF")
        layout.separator()
        layout.operator("material_palette.pick_region", icon="EYEDROPPER")
        layout.operator("material_palette.add_region", icon="ADD")
        layout.operator("material_palette.paint_region", icon="BRUSH_DATA")
        layout.operator_menu_enum("material_palette.draw_region", "shape", icon="GREASEPENCIL")
        layout.operator("material_palette.segment", icon="MOD_EXPLODE")
        layout.menu("MATERIAL_PALETTE_MT_region")
        layout.menu("MATERIAL_PALETTE_MT_surface")
        layout.separator()
        layout.operator("material_palette.preview_exemplar", icon="IMAGE_BACKGROUND")
        layout.operator("material_palette.extract", icon="MATERIAL")
        layout.operator("material_palette.restore_defaults", icon="LOOP_BACK")
        layout.separator()
        layout.operator("material_palette.assign", icon="CHECKMARK").mapping = "KEEP"
        layout.operator("material_palette.assign", text="Assign and Map", icon="UV").mapping = "UNMAPPED"
        layout.operator("material_palette.replace_material", icon="ARROW_LEFTRIGHT")
        layout.menu("MATERIAL_PALETTE_MT_palette")


class MATERIAL_PALETTE_MT_surface(bpy.types.Menu):
    bl_label = "Surface of Region"
    bl_description = "How the active region's surface lies, and how large it is"

    def draw(self, context):
        layout = self.layout
        layout.operator("material_palette.corners", icon="MOD_LATTICE")
        layout.operator("material_palette.corners_from_camera", icon="CAMERA_DATA")
        layout.operator("material_palette.clear_corners", icon="X")
        layout.separator()
        layout.operator("material_palette.measure", icon="DRIVER_DISTANCE")
        layout.operator("material_palette.clear_measure", icon="X")


class MATERIAL_PALETTE_MT_palette(bpy.types.Menu):
    bl_label = "Palette"
    bl_description = "What can be done with the palette and its active material"

    def draw(self, context):
        layout = self.layout
        layout.operator("material_palette.vary", icon="FILE_REFRESH")
        layout.operator("material_palette.resample", icon="FULLSCREEN_ENTER")
        layout.operator("material_palette.compare", icon="UV_SYNC_SELECT")
        layout.operator("material_palette.discard_before", icon="CHECKMARK")
        layout.operator("material_palette.reset_material", icon="LOOP_BACK")
        layout.operator("material_palette.show_region", icon="RESTRICT_SELECT_OFF")
        layout.operator("material_palette.delete_material", icon="TRASH")
        layout.separator()
        layout.operator("material_palette.fit_scene", icon="VIEW_CAMERA")
        layout.operator("material_palette.save_library", icon="ASSET_MANAGER")
        layout.operator("material_palette.export", icon="EXPORT")


def _draw(self, context):
    self.layout.separator()
    self.layout.menu("MATERIAL_PALETTE_MT_all", icon="MATERIAL")


CLASSES = (MATERIAL_PALETTE_MT_surface, MATERIAL_PALETTE_MT_palette, MATERIAL_PALETTE_MT_all)
# of the Image Editor, and of the 3D View in Object and in Edit Mode
_PLACES = ("IMAGE_MT_image", "VIEW3D_MT_object", "VIEW3D_MT_edit_mesh")


def register():
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    for menu in _PLACES:
        getattr(bpy.types, menu).append(_draw)


def unregister():
    for menu in _PLACES:
        getattr(bpy.types, menu).remove(_draw)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
