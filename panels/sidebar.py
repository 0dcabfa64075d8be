"""Photo, Regions, Extract, Palette: the same panels in the Image Editor and the 3D View."""

import bpy
from bpy.types import Panel, UIList

from ..operators import history
from ..operators.background import duration, time_left
from ..operators.palette import active_entry
from ..operators.setup import missing
from . import material

_SPACES = ("IMAGE_EDITOR", "VIEW_3D")


class MATERIAL_PALETTE_UL_regions(UIList):
    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        row = layout.row(align=True)
        row.prop(item, "enabled", text="")
        swatch = row.row(align=True)
        swatch.ui_units_x = 1.0
        swatch.prop(item, "colour", text="")
        row.separator(factor=0.5)
        name = row.row(align=True)
        name.active = item.enabled
        name.prop(item, "name", text="", emboss=False, icon="ERROR" if item.error or not item.mask else "NONE")
        row.prop(item, "visible", text="", emboss=False, icon="HIDE_OFF" if item.visible else "HIDE_ON")


class MATERIAL_PALETTE_UL_palette(UIList):
    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        if item.material is None:
            layout.label(text=f"{item.name} (deleted)", icon="ERROR")
            return
        row = layout.row(align=True)
        row.prop(item.material, "name", text="", emboss=False, icon_value=layout.icon(item.material))
        if item.warnings:
            row.label(text="", icon="INFO")


class PhotoPanel:
    bl_label = "Photo"
    bl_order = 0

    def draw(self, context):
        layout = self.layout
        settings = context.scene.material_palette
        row = layout.row(align=True)
        row.prop(settings, "photo", text="")
        row.operator("material_palette.open_photo", text="", icon="FILE_FOLDER")
        if settings.photo is None:
            layout.operator("material_palette.open_photo", icon="IMAGE_DATA")
        else:
            row.operator("material_palette.show_photo", text="", icon="HIDE_OFF")


class RegionsPanel:
    bl_label = "Regions"
    bl_order = 1

    def draw(self, context):
        layout = self.layout
        settings = context.scene.material_palette
        row = layout.row()
        row.template_list(
            "MATERIAL_PALETTE_UL_regions", "", settings, "regions", settings, "active_region", rows=4, maxrows=8
        )
        column = row.column(align=True)
        column.operator("material_palette.add_region", text="", icon="ADD")
        column.operator("material_palette.remove_region", text="", icon="REMOVE")
        column.separator()
        column.operator("material_palette.paint_region", text="", icon="BRUSH_DATA")
        if settings.active_region < len(settings.regions) and settings.regions[settings.active_region].error:
            _draw_text(layout, context, settings.regions[settings.active_region].error, "ERROR")
        row = layout.row(align=True)
        row.operator("material_palette.import_masks", text="Import", icon="IMPORT")
        row.operator("material_palette.export_masks", text="Export", icon="EXPORT")
        row = layout.row(align=True)
        row.operator("material_palette.segment", icon="MOD_EXPLODE")
        count = row.row(align=True)
        count.ui_units_x = 4.0
        count.prop(settings, "auto_regions", text="")


class ExtractPanel:
    bl_label = "Extract"
    bl_order = 2

    def draw(self, context):
        layout = self.layout
        settings = context.scene.material_palette
        run = context.window_manager.material_palette_run
        if missing():
            _draw_set_up(layout)
            return
        column = layout.column()
        column.use_property_split = True
        column.use_property_decorate = False
        column.active = not run.running
        column.prop(settings, "engine")
        column.prop(settings, "quality")
        column.prop(settings, "resolution")
        column.prop(settings, "metres_per_tile")
        column.prop(settings, "seed")
        column.prop(settings, "flatten")
        column.prop(settings, "pack")
        if not settings.pack:
            column.prop(settings, "output_folder", text="Folder")
            column.prop(settings, "overwrite")
        if run.running:
            _draw_progress(layout, run)
        else:
            enabled = sum(region.enabled for region in settings.regions)
            row = layout.row(align=True)
            row.scale_y = 1.5
            row.operator("material_palette.extract", icon="MATERIAL")
            row.operator("material_palette.extract", text="", icon="RESTRICT_SELECT_OFF").only_active = True
            if enabled:
                layout.label(text=_forecast(history.expected(settings, enabled), enabled), icon="TIME")
        if run.error:
            _draw_text(layout.box(), context, run.error, "ERROR")


class PalettePanel:
    bl_label = "Palette"
    bl_order = 3

    def draw(self, context):
        layout = self.layout
        settings = context.scene.material_palette
        if not settings.palette:
            layout.label(text="Materials appear here", icon="MATERIAL")
            return
        layout.row().prop(settings, "palette_view", expand=True)
        if settings.palette_view == "GRID":
            _draw_grid(layout, context, settings)
        else:
            layout.template_list(
                "MATERIAL_PALETTE_UL_palette", "", settings, "palette", settings, "active_material", rows=3, maxrows=10
            )
        entry = active_entry(settings)
        if entry is None:
            return
        if entry.material is not None:
            row = layout.row(align=True)
            row.prop(entry.material, "name", text="")
            row.operator("material_palette.show_region", text="", icon="RESTRICT_SELECT_OFF")
            row.operator("material_palette.delete_material", text="", icon="TRASH")
            row = layout.row(align=True)
            row.scale_y = 1.3
            row.operator("material_palette.assign", icon="CHECKMARK")
        else:
            _draw_text(layout, context, f"The material of '{entry.name}' was deleted", "ERROR")
            layout.operator("material_palette.delete_material", text="Remove from Palette", icon="TRASH")
        row = layout.row(align=True)
        row.operator("material_palette.vary", icon="FILE_REFRESH")
        if entry.previous is not None:
            row.operator("material_palette.compare", text="Compare", icon="UV_SYNC_SELECT")
            row.operator("material_palette.discard_before", text="", icon="CHECKMARK")
        for warning in entry.warnings.splitlines():
            _draw_text(layout, context, warning, "INFO")


class AdjustPanel:
    bl_label = "Adjust"
    bl_order = 4

    @classmethod
    def poll(cls, context):
        entry = active_entry(context.scene.material_palette)
        return entry is not None and entry.material is not None

    def draw(self, context):
        material.draw_controls(self.layout, active_entry(context.scene.material_palette).material)
        self.layout.operator("material_palette.reset_material", icon="LOOP_BACK")


def _draw_grid(layout, context, settings):
    """Previews with a button each below, as many in a row as the sidebar has room for."""
    width = context.region.width / context.preferences.system.ui_scale
    columns = max(1, min(len(settings.palette), int(width // 95)))
    grid = layout.grid_flow(row_major=True, columns=columns, even_columns=True, even_rows=True, align=True)
    for index, entry in enumerate(settings.palette):
        cell = grid.column(align=True)
        cell.template_icon(icon_value=cell.icon(entry.material) if entry.material else 0, scale=4.5)
        name = entry.material.name if entry.material else f"{entry.name} (deleted)"
        icon = "INFO" if entry.warnings else "NONE"
        chosen = index == settings.active_material
        cell.operator("material_palette.select_material", text=name, depress=chosen, icon=icon).index = index


def _forecast(seconds, regions):
    what = "1 region" if regions == 1 else f"{regions} regions"
    return f"{what}: about {duration(seconds)}" if seconds else f"{what}; the first run tells how long it takes"


def _draw_progress(layout, run):
    row = layout.row(align=True)
    row.scale_y = 1.5
    left = time_left(run.seconds_left)
    row.progress(factor=run.progress, text=f"{run.progress:.0%}   {left}" if left else f"{run.progress:.0%}")
    row.operator("material_palette.cancel", text="", icon="X")
    layout.label(text=run.message)


def _draw_set_up(layout):
    box = layout.box()
    box.label(text="Set up: Python packages are missing", icon="ERROR")
    column = box.column(align=True)
    for entry in missing():
        column.label(text=f"{entry.module}: {entry.reason}", icon="DOT")
    box.operator("material_palette.copy_install_command", icon="COPYDOWN")
    column = box.column(align=True)
    column.label(text="Paste the command into a terminal,")
    column.label(text="then start Blender again.")


def _draw_text(layout, context, text, icon):
    """Labels don't wrap: break `text` at the sidebar's width."""
    scale = context.preferences.system.ui_scale
    length = max(16, int(context.region.width / (7.5 * scale)) - 6)
    column = layout.column(align=True)
    line = ""
    for word in text.split():
        if line and len(line) + len(word) >= length:
            column.label(text=line, icon=icon)
            line, icon = "", "BLANK1"
        line = f"{line} {word}".strip()
    column.label(text=line, icon=icon)


def _panel(section, space):
    name = f"MATERIAL_PALETTE_PT_{section.bl_label.lower()}_{space.lower()}"
    place = {"bl_idname": name, "bl_space_type": space, "bl_region_type": "UI", "bl_category": "Palette"}
    if section is AdjustPanel:
        place["bl_parent_id"] = f"MATERIAL_PALETTE_PT_palette_{space.lower()}"
    return type(name, (section, Panel), place)


_SECTIONS = (PhotoPanel, RegionsPanel, ExtractPanel, PalettePanel, AdjustPanel)
CLASSES = (
    MATERIAL_PALETTE_UL_regions,
    MATERIAL_PALETTE_UL_palette,
    *material.CLASSES,
    *(_panel(section, space) for space in _SPACES for section in _SECTIONS),
)


def register():
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister():
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
