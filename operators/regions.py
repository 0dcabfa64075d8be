"""Regions: masks painted over the photo, one 8-bit image each, white where the region is."""

import colorsys
import os
from pathlib import Path

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, IntProperty, StringProperty
from bpy.types import Operator

from ..core.errors import PaletteError
from .setup import NeedsPackages

_GOLDEN_RATIO = 0.618034  # hues this far apart stay distinct however many there are


def add_region(settings, name, mask, automatic=False):
    """Add a region with a mask image of its own to a scene's settings and return it.

    mask: (H, W) bool, top row first, or None for an empty one of the photo's size.
    """
    name = _unused_name(settings, name)
    if mask is None:
        width, height = settings.photo.size
        mask = np.zeros((height, width), bool)
    key = max([settings.last_key, *(known.key for known in (*settings.regions, *settings.palette))]) + 1
    region = settings.regions.add()
    region.key = settings.last_key = key
    region.name = name
    region.mask = _mask_image(name, mask)
    region.colour = colorsys.hsv_to_rgb((len(settings.regions) - 1) * _GOLDEN_RATIO % 1.0, 0.75, 1.0)
    region.automatic = automatic
    settings.active_region = len(settings.regions) - 1
    return region


def set_mask(region, mask):
    """Give `region` the mask (H, W) bool, top row first; the image stays the same while its size does."""
    image, (height, width) = region.mask, mask.shape
    if image is None or tuple(image.size) != (width, height):
        region.mask = _mask_image(region.name, mask)
        if image is not None and image.users == 0:
            bpy.data.images.remove(image)
    else:
        _write_mask(image, mask)
    region.automatic = False


def remove_region(settings, index):
    """Remove a region, and its mask image unless something else uses it."""
    mask = settings.regions[index].mask
    settings.regions.remove(index)
    settings.active_region = min(settings.active_region, max(0, len(settings.regions) - 1))
    if mask is not None and mask.users == 0:
        bpy.data.images.remove(mask)


def read_mask_image(region):
    """Return a region's mask as (H, W) bool, top row first: any pixel that isn't black belongs.

    Raises PaletteError when the mask image or its pixels are gone.
    """
    image = region.mask
    if image is None:
        raise PaletteError(f"Region '{region.name}' has no mask image: remove it, or choose one")
    width, height = image.size
    if not (width and height):
        raise PaletteError(f"Region '{region.name}': its mask image '{image.name}' has no pixels")
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    return (pixels.reshape(height, width, 4)[::-1, :, :3] > 0.0).any(-1)


def read_photo_mask(region, photo):
    """`read_mask_image` of a region of `photo`; raises PaletteError with both sizes where they differ, too."""
    if region.mask is not None and tuple(region.mask.size) != tuple(photo.size):
        wrong, right = ("{} x {} px".format(*image.size) for image in (region.mask, photo))
        raise PaletteError(f"Region '{region.name}': its mask is {wrong}, the photo is {right}; paint it anew")
    return read_mask_image(region)


def follow_active_region(settings, context):
    """Where an Image Editor shows a region's mask, show the active region's instead."""
    if not (context.window_manager and settings.active_region < len(settings.regions)):
        return
    masks = {region.mask for region in settings.regions if region.mask is not None}
    active = settings.regions[settings.active_region].mask
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR" and area.spaces.active.image in masks and active is not None:
                area.spaces.active.image = active


@persistent
def pack_masks_before_save(*_args):
    """Painted pixels live in memory only: put them into the file that is being saved."""
    for scene in bpy.data.scenes:
        for region in scene.material_palette.regions:
            if region.mask is not None and region.mask.is_dirty:
                region.mask.pack()


def _mask_image(name, mask):
    height, width = mask.shape
    image = bpy.data.images.new(f"{name} mask", width, height, alpha=False)
    image.colorspace_settings.name = "Non-Color"
    _write_mask(image, mask)
    return image


def _write_mask(image, mask):
    from . import examine

    rgba = np.ones((*mask.shape, 4), np.float32)
    rgba[..., :3] = mask[::-1, :, None]
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    # undo and saving keep packed pixels only
    image.pack()
    examine.changed(image)


def _unused_name(settings, name):
    taken = {region.name for region in settings.regions}
    unused, number = name, 1
    while unused in taken:
        number += 1
        unused = f"{name} {number}"
    return unused


def image_editor(context):
    """The Image Editor under the mouse, else the largest of the window, else None."""
    if context.area is not None and context.area.type == "IMAGE_EDITOR":
        return context.area
    areas = [area for area in context.window.screen.areas if area.type == "IMAGE_EDITOR"] if context.window else []
    return max(areas, key=lambda area: area.width * area.height, default=None)


def show_photo(context, area):
    """Let the Image Editor `area` show the photo, out of paint mode."""
    space = area.spaces.active
    if space.mode != "VIEW":
        space.mode = "VIEW"
    if space.image != context.scene.material_palette.photo:
        space.image = context.scene.material_palette.photo
    area.tag_redraw()


def painted_region(settings, space):
    """The region whose mask an Image Editor's space shows, or None."""
    image = space.image if space is not None and space.type == "IMAGE_EDITOR" else None
    return next((region for region in settings.regions if image is not None and region.mask == image), None)


def _has_brush(context):
    """Whether there is a brush to paint with.

    From 4.3 on brushes are assets, which Blender takes by itself where it has them; some distributions leave them out.
    Asking for one by its operator at this point ends Blender 5.2 with a crash.
    """
    paint = context.scene.tool_settings.image_paint
    if bpy.app.version < (4, 3, 0) and paint.brush is None:
        paint.brush = bpy.data.brushes.get("TexDraw") or bpy.data.brushes.new("TexDraw", mode="TEXTURE_PAINT")
    return paint.brush is not None


def _paint_colours(context, erase):
    """White belongs to the region, black does not; Ctrl paints the other one."""
    paint = context.scene.tool_settings.image_paint
    # moved into each paint mode with Blender 5.0
    unified = getattr(paint, "unified_paint_settings", None) or context.scene.tool_settings.unified_paint_settings
    for owner in (unified, paint.brush):
        # an essential brush of a library refuses changes; the unified colour is what counts then
        if owner is not None and getattr(owner, "is_editable", True):
            owner.color = (0.0,) * 3 if erase else (1.0,) * 3
            owner.secondary_color = (1.0,) * 3 if erase else (0.0,) * 3


class NeedsPhoto:
    @classmethod
    def poll(cls, context):
        if context.scene.material_palette.photo is not None:
            return True
        cls.poll_message_set("Open a photo first")
        return False


class NeedsRegion:
    @classmethod
    def poll(cls, context):
        settings = context.scene.material_palette
        if settings.active_region < len(settings.regions):
            return True
        cls.poll_message_set("There is no region")
        return False


class MATERIAL_PALETTE_OT_add_region(NeedsPhoto, Operator):
    """Add an empty region, to be painted over the photo"""

    bl_idname = "material_palette.add_region"
    bl_label = "Add Region"
    bl_options = {"REGISTER", "UNDO"}

    name: StringProperty(name="Name", default="Region", options={"SKIP_SAVE"})

    def execute(self, context):
        settings = context.scene.material_palette
        if not all(settings.photo.size):
            self.report({"ERROR"}, f"Photo '{settings.photo.name}' has no pixels; is its file still there?")
            return {"CANCELLED"}
        add_region(settings, self.name, None)
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_remove_region(NeedsRegion, Operator):
    """Remove the active region and its mask"""

    bl_idname = "material_palette.remove_region"
    bl_label = "Remove Region"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        settings = context.scene.material_palette
        remove_region(settings, settings.active_region)
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_explain_region(Operator):
    """What is wrong with this region"""

    bl_idname = "material_palette.explain_region"
    bl_label = "Explain Region"
    bl_options = {"INTERNAL"}

    index: IntProperty(min=0)

    @classmethod
    def description(cls, context, properties):
        return _reason(context.scene.material_palette, properties.index) or cls.__doc__

    def execute(self, context):
        settings = context.scene.material_palette
        settings.active_region = self.index
        self.report({"WARNING"}, _reason(settings, self.index) or "Nothing is wrong with it")
        return {"FINISHED"}


def _reason(settings, index):
    from . import examine

    region = settings.regions[index] if index < len(settings.regions) else None
    seen = examine.known(region) if region else None
    return (region.error or (seen.warning if seen else "")) if region else ""


class MATERIAL_PALETTE_OT_remove_all_regions(NeedsRegion, Operator):
    """Remove all regions and their masks"""

    bl_idname = "material_palette.remove_all_regions"
    bl_label = "Remove All Regions"
    bl_options = {"REGISTER", "UNDO"}

    def invoke(self, context, event):
        return context.window_manager.invoke_confirm(self, event)

    def execute(self, context):
        settings = context.scene.material_palette
        while settings.regions:
            remove_region(settings, 0)
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_paint_region(NeedsPhoto, Operator):
    """Paint the active region over the photo in the Image Editor. Ctrl does the opposite"""

    bl_idname = "material_palette.paint_region"
    bl_label = "Paint Region"
    bl_options = {"REGISTER", "UNDO"}

    erase: BoolProperty(name="Erase", description="Take away instead of adding", options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context, properties):
        return "Take away from the active region with the brush. Ctrl adds" if properties.erase else cls.__doc__

    def execute(self, context):
        settings = context.scene.material_palette
        area = image_editor(context)
        if area is None:
            self.report({"ERROR"}, "No Image Editor in this window to paint in: open one beside this editor")
            return {"CANCELLED"}
        if not settings.regions and bpy.ops.material_palette.add_region() != {"FINISHED"}:
            return {"CANCELLED"}
        region = settings.regions[min(settings.active_region, len(settings.regions) - 1)]
        if region.mask is None:
            self.report({"ERROR"}, f"Region '{region.name}' has no mask image")
            return {"CANCELLED"}
        space = area.spaces.active
        space.image = region.mask
        space.mode = "PAINT"
        if not _has_brush(context):
            self.report({"WARNING"}, "There is no brush to paint with: choose one, or draw with the lasso")
        _paint_colours(context, self.erase)
        region.automatic = False
        area.tag_redraw()
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_show_photo(NeedsPhoto, Operator):
    """Show the photo in the Image Editor again"""

    bl_idname = "material_palette.show_photo"
    bl_label = "Show Photo"
    bl_options = {"REGISTER"}

    def execute(self, context):
        area = image_editor(context)
        if area is None:
            self.report({"ERROR"}, "No Image Editor in this window")
            return {"CANCELLED"}
        show_photo(context, area)
        return {"FINISHED"}


class _ChoosesFolder:
    """Mixin: a folder from the file browser, or from the property `directory` in scripts."""

    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE"})
    filter_folder: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_image: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context, event):
        if self.directory:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}


class MATERIAL_PALETTE_OT_import_masks(_ChoosesFolder, NeedsPackages, NeedsPhoto, Operator):
    """Add one region for each mask image of a folder, named after its file; any pixel that isn't black belongs.
    Corners and measures are read from regions.json beside them"""

    bl_idname = "material_palette.import_masks"
    bl_label = "Import Masks"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        from ..core.region import read_regions
        from .photo import photo_scale
        from .rectify import set_corners, set_measure

        settings = context.scene.material_palette
        folder, scale = bpy.path.abspath(self.directory), photo_scale(settings.photo)
        try:
            regions = read_regions(folder, tuple(settings.photo.size)[::-1], scale)
        except PaletteError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        # the folder is what the user edits elsewhere: importing it again brings the masks up to date
        active = settings.active_region
        for region in regions:
            if region.name not in settings.regions:
                add_region(settings, region.name, region.mask)
            else:  # looked up each time: adding one moves the others
                set_mask(settings.regions[region.name], region.mask)
            known = settings.regions[region.name]
            if region.corners is not None:
                set_corners(known, region.corners)
            if region.measure is not None:
                set_measure(known, *region.measure)
        settings.active_region = active
        self.report({"INFO"}, f"{len(regions)} regions imported")
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_export_masks(_ChoosesFolder, NeedsPackages, NeedsRegion, Operator):
    """Write every region's mask as NAME.png into a folder, to be edited or passed to the command line, and corners and
    measures as regions.json"""

    bl_idname = "material_palette.export_masks"
    bl_label = "Export Masks"
    bl_options = {"REGISTER"}

    def execute(self, context):
        from ..core.image import write_image
        from ..core.region import Region, file_name, write_geometry
        from .photo import photo_scale
        from .rectify import corners_of, measure_of

        folder, settings = bpy.path.abspath(self.directory), context.scene.material_palette
        regions = settings.regions
        try:
            masks = {file_name(region.name): read_mask_image(region) for region in regions}
            if len(masks) < len(regions):
                raise PaletteError("Two regions would have the same file name; rename one")
            if not os.path.isdir(folder):
                raise PaletteError(f"No such folder: {folder}")
            for name, mask in masks.items():
                write_image(os.path.join(folder, f"{name}.png"), mask.astype(np.float32))
            told = [Region(one.name, None, corners_of(one), measure_of(one)) for one in regions]
            write_geometry(told, Path(folder), photo_scale(settings.photo) if settings.photo else 1.0)
        except (PaletteError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{len(masks)} masks written to {folder}")
        return {"FINISHED"}


CLASSES = (
    MATERIAL_PALETTE_OT_add_region,
    MATERIAL_PALETTE_OT_remove_region,
    MATERIAL_PALETTE_OT_remove_all_regions,
    MATERIAL_PALETTE_OT_explain_region,
    MATERIAL_PALETTE_OT_paint_region,
    MATERIAL_PALETTE_OT_show_photo,
    MATERIAL_PALETTE_OT_import_masks,
    MATERIAL_PALETTE_OT_export_masks,
)
