"""Photo, Regions, Extract, Palette: the same panels in the Image Editor and the 3D View."""

import bpy
from bpy.types import Panel, UIList

from ..operators import examine, history, preview
from ..operators.background import duration, time_left
from ..operators.palette import active_entry
from ..operators.preferences import PACKAGE, engines
from ..operators.regions import painted_region
from ..operators.setup import missing
from . import material

_SPACES = ("IMAGE_EDITOR", "VIEW_3D")


class MATERIAL_PALETTE_UL_regions(UIList):
    def draw_item(self, context, layout, data, item, icon, active_data, active_property, index=0, flt_flag=0):
        seen = examine.known(item)
        row = layout.row(align=True)
        row.prop(item, "enabled", text="")
        swatch = row.row(align=True)
        swatch.ui_units_x = 0.8
        swatch.prop(item, "colour", text="")
        row.separator(factor=0.5)
        name = row.row(align=True)
        name.active = item.enabled
        name.prop(item, "name", text="", emboss=False, icon_value=seen.icon if seen else 0)
        if item.error or (seen and seen.warning):
            row.operator("material_palette.explain_region", text="", icon="ERROR", emboss=False).index = index
        elif seen and seen.area:
            area = row.row(align=True)
            area.alignment = "RIGHT"
            area.active = False
            area.label(text=f"{seen.area:.0%}" if seen.area >= 0.01 else "<1%")
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
        if settings.photo is not None:
            row.operator("material_palette.show_photo", text="", icon="HIDE_OFF")
        else:
            layout.operator("material_palette.open_photo", icon="IMAGE_DATA")
        shown = context.space_data.image if context.space_data.type == "IMAGE_EDITOR" else None
        if bpy.ops.material_palette.use_shown_image.poll() and shown != settings.photo:
            layout.operator("material_palette.use_shown_image", icon="IMAGE_REFERENCE")
        if settings.photo is None and bpy.ops.material_palette.paste_photo.poll():
            layout.operator("material_palette.paste_photo", icon="PASTEDOWN")


class RegionsPanel:
    bl_label = "Regions"
    bl_order = 1

    def draw_header_preset(self, context):
        settings = context.scene.material_palette
        self.layout.prop(settings, "show_regions", text="", icon="OVERLAY", emboss=False)

    def draw(self, context):
        layout = self.layout
        settings = context.scene.material_palette
        row = layout.row()
        row.template_list(
            "MATERIAL_PALETTE_UL_regions", "", settings, "regions", settings, "active_region", rows=5, maxrows=8
        )
        column = row.column(align=True)
        column.operator("material_palette.add_region", text="", icon="ADD")
        column.operator("material_palette.remove_region", text="", icon="REMOVE")
        column.separator()
        column.menu("MATERIAL_PALETTE_MT_region", text="", icon="DOWNARROW_HLT")
        if painted_region(settings, context.space_data):
            _draw_painting(layout, settings)
        else:
            _draw_tools(layout, settings)
            if settings.active_region < len(settings.regions):
                _draw_surface(layout, settings.regions[settings.active_region])
        # last, so that no button moves away from under the mouse when a problem is found
        if settings.active_region < len(settings.regions):
            region = settings.regions[settings.active_region]
            seen = examine.known(region)
            for problem in filter(None, (region.error, seen.warning if seen else "")):
                _draw_text(layout, context, problem, "ERROR")


def _draw_tools(layout, settings):
    row = layout.row(align=True)
    row.operator("material_palette.pick_region", text="Pick Material", icon="EYEDROPPER")
    row.operator("material_palette.paint_region", text="Paint", icon="BRUSH_DATA")
    row = layout.row(align=True)
    for shape in ("LASSO", "POLYGON", "BOX"):
        row.operator("material_palette.draw_region", text=shape.title()).shape = shape
    row = layout.row(align=True)
    row.operator("material_palette.segment", icon="MOD_EXPLODE")
    count = row.row(align=True)
    count.ui_units_x = 4.0
    count.prop(settings, "auto_regions", text="")
    row.prop(settings, "segmentation", text="", icon_only=True)


def _draw_painting(layout, settings):
    box = layout.box()
    row = box.row(align=True)
    row.operator("material_palette.paint_region", text="Add", icon="ADD")
    row.operator("material_palette.paint_region", text="Erase", icon="REMOVE").erase = True
    box.operator("material_palette.show_photo", text="Done", icon="CHECKMARK")
    box.label(text="Ctrl does the opposite", icon="INFO")


def _draw_surface(layout, region):
    """How the region's surface lies, and how large it is."""
    row = layout.row(align=True)
    row.operator("material_palette.corners", text="Corners", icon="MOD_LATTICE", depress=region.has_corners)
    row.operator("material_palette.corners_from_camera", text="", icon="CAMERA_DATA")
    if region.has_corners:
        row.operator("material_palette.clear_corners", text="", icon="X")
    row = layout.row(align=True)
    row.operator("material_palette.measure", text="Measure", icon="DRIVER_DISTANCE", depress=region.has_measure)
    if region.has_measure:
        row.prop(region, "measured_length", text="")
        row.operator("material_palette.clear_measure", text="", icon="X")


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
        enabled = sum(region.enabled for region in settings.regions)
        _draw_quality(column, settings, enabled)
        column.prop(settings, "resolution")
        column.prop(settings, "metres_per_tile")
        _draw_engine_state(layout, context, settings)
        if run.running:
            _draw_progress(layout, run)
        else:
            row = layout.row(align=True)
            row.scale_y = 1.5
            row.operator("material_palette.extract", icon="MATERIAL")
            row.operator("material_palette.extract", text="", icon="RESTRICT_SELECT_OFF").only_active = True
            if enabled:
                seconds = history.expected(settings, settings.quality, enabled)
                layout.label(text=_forecast(seconds, enabled, history.count()), icon="TIME")
        if run.error:
            _draw_text(layout.box(), context, run.error, "ERROR")


class OptionsPanel:
    bl_label = "Options"
    bl_parent = "extract"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context):
        return not missing()

    def draw(self, context):
        layout = self.layout
        settings = context.scene.material_palette
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.active = not context.window_manager.material_palette_run.running
        column = layout.column()
        column.prop(settings, "seed")
        column.prop(settings, "scale")
        target = column.row()
        target.active = settings.engine == "patch"
        target.prop(settings, "target_error")
        column.prop(settings, "rectify")
        column.prop(settings, "focal_length")
        column.prop(settings, "flatten")
        column.prop(settings, "white_balance")
        if settings.white_balance == "card":
            column.prop(settings, "grey_card")
        layout.operator("material_palette.preview_exemplar", icon="IMAGE_BACKGROUND")
        kept = column.row()
        kept.active = settings.engine == "patch"
        kept.prop(settings, "keep_concepts")
        column.prop(settings, "pack")
        if not settings.pack:
            column.prop(settings, "output_folder", text="Folder")
            column.prop(settings, "overwrite")
        column.prop(settings, "author")
        column.prop(settings, "licence")
        layout.operator("material_palette.restore_defaults", icon="LOOP_BACK")


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
        for entry in settings.palette:
            if entry.material is not None:
                preview.follow(entry.material)
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
            row.operator("material_palette.assign")
            row.operator("material_palette.assign", text="Assign and Map").mapping = "UNMAPPED"
            if context.space_data.type == "VIEW_3D":
                shelf = {"text": "Shelf to Drag From", "icon": "ASSET_MANAGER", "toggle": True}
                layout.prop(context.space_data, "show_region_asset_shelf", **shelf)
        else:
            _draw_text(layout, context, f"The material of '{entry.name}' was deleted", "ERROR")
            layout.operator("material_palette.delete_material", text="Remove from Palette", icon="TRASH")
        row = layout.row(align=True)
        row.operator("material_palette.vary", icon="FILE_REFRESH")
        row.operator("material_palette.replace_material", text="Replace", icon="ARROW_LEFTRIGHT")
        if entry.material is not None and entry.material.material_palette.concept:
            layout.operator("material_palette.resample", icon="FULLSCREEN_ENTER")
        if entry.previous is not None:
            row = layout.row(align=True)
            row.operator("material_palette.compare", text="Compare", icon="UV_SYNC_SELECT")
            row.operator("material_palette.discard_before", icon="CHECKMARK")
        for warning in entry.warnings.splitlines():
            _draw_text(layout, context, warning, "INFO")
        layout.operator("material_palette.fit_scene", icon="VIEW_CAMERA")
        row = layout.row(align=True)
        row.operator("material_palette.save_library", text="To Library", icon="ASSET_MANAGER")
        row.operator("material_palette.export", text="Export", icon="EXPORT")


class AdjustPanel:
    bl_label = "Adjust"
    bl_parent = "palette"

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
    for _ in range(-len(settings.palette) % columns):  # a row that isn't full would have wide cells
        grid.column()


def _draw_quality(column, settings, regions):
    """The qualities side by side, below each how long that many regions take."""
    column = column.column(align=True)
    column.use_property_split = False
    column.row(align=True).prop(settings, "quality", expand=True)
    qualities = settings.bl_rna.properties["quality"].enum_items
    seconds = [history.expected(settings, item.identifier, max(1, regions)) for item in qualities]
    if not any(seconds):
        return
    times = column.row(align=True)
    times.active = False
    for one in seconds:
        cell = times.row(align=True)
        cell.alignment = "CENTER"
        cell.label(text=duration(one, brief=True) if one else "")


def _draw_engine_state(layout, context, settings):
    """What the chosen engine lacks, where it isn't the one that ships."""
    if settings.engine == "patch":
        return
    name = settings.bl_rna.properties["engine"].enum_items[settings.engine].name
    engine = next((engine for engine in engines(context) if engine.name == name), None)
    if engine is None or not (engine.missing or engine.wanted):
        return
    lacking = ", ".join(entry.module for entry in engine.missing)
    _draw_text(layout, context, f"Missing: {lacking}" if lacking else engine.wanted, "ERROR")
    layout.operator("preferences.addon_show", text="Preferences", icon="PREFERENCES").module = PACKAGE


def _forecast(seconds, regions, timed):
    what = "1 region" if regions == 1 else f"{regions} regions"
    if not seconds:
        return f"{what}, time not known yet"
    return f"{what}: about {duration(seconds)}{'' if timed else ', a guess'}"


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
    """Labels don't wrap: break `text` at the sidebar's width, as a sentence."""
    text = text[:1].upper() + text[1:]
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
    if hasattr(section, "bl_parent"):
        place["bl_parent_id"] = f"MATERIAL_PALETTE_PT_{section.bl_parent}_{space.lower()}"
    return type(name, (section, Panel), place)


_SECTIONS = (PhotoPanel, RegionsPanel, ExtractPanel, OptionsPanel, PalettePanel, AdjustPanel)
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
