"""Edits of regions: grow, shrink, smooth, split into islands, merge."""

import bpy
from bpy.props import EnumProperty, FloatProperty
from bpy.types import Operator

from ..core.errors import PaletteError
from .regions import NeedsRegion, add_region, read_mask_image, read_photo_mask, remove_region, set_mask
from .setup import NeedsPackages


class _Edits(NeedsPackages, NeedsRegion):
    """Mixin: `edit(mask)` gives the active region's new mask."""

    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        settings = context.scene.material_palette
        region = settings.regions[settings.active_region]
        try:
            mask = read_mask_image(region)
        except PaletteError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return self.apply(settings, region, mask) or {"FINISHED"}

    def apply(self, settings, region, mask):
        edited = self.edit(mask)
        if mask.any() and not edited.any():
            self.report({"ERROR"}, f"Nothing of '{region.name}' would be left")
            return {"CANCELLED"}
        set_mask(region, edited)


class MATERIAL_PALETTE_OT_grow_region(_Edits, Operator):
    """Grow the active region by a distance, or shrink it by a negative one"""

    bl_idname = "material_palette.grow_region"
    bl_label = "Grow / Shrink Region"

    distance: FloatProperty(
        name="Distance", description="Pixels of the photo; negative shrinks", default=4.0, soft_min=-100, soft_max=100
    )

    @classmethod
    def description(cls, context, properties):
        return "Shrink the active region" if properties.distance < 0 else "Grow the active region"

    def edit(self, mask):
        from ..core.mask import grow

        return grow(mask, self.distance)


class MATERIAL_PALETTE_OT_smooth_region(_Edits, Operator):
    """Round the active region's outline; specks and holes go"""

    bl_idname = "material_palette.smooth_region"
    bl_label = "Smooth Region"

    radius: FloatProperty(name="Radius", description="Pixels of the photo", default=4.0, min=0.1, soft_max=100)

    def edit(self, mask):
        from ..core.mask import smooth

        return smooth(mask, self.radius)


class MATERIAL_PALETTE_OT_split_region(_Edits, Operator):
    """Make a region of its own of each island of the active region"""

    bl_idname = "material_palette.split_region"
    bl_label = "Split into Islands"

    def apply(self, settings, region, mask):
        from ..core.mask import islands

        parts = islands(mask)
        if len(parts) < 2:
            self.report({"INFO"}, f"'{region.name}' is one island")
            return {"CANCELLED"}
        active, name = settings.active_region, region.name
        set_mask(region, parts[0])
        for part in parts[1:]:
            add_region(settings, name, part)
        settings.active_region = active
        self.report({"INFO"}, f"{len(parts)} regions")


_items = []  # Blender needs the strings of a dynamic enum to live on


def _others(_operator, context):
    settings = context.scene.material_palette
    _items[:] = [
        (str(region.key), region.name, f"Merge '{region.name}' into the active region")
        for index, region in enumerate(settings.regions)
        if index != settings.active_region
    ]
    return _items


class MATERIAL_PALETTE_OT_merge_region(_Edits, Operator):
    """Add another region to the active one; the other one goes"""

    bl_idname = "material_palette.merge_region"
    bl_label = "Merge Region"
    bl_property = "other"

    other: EnumProperty(name="Region", description="The region that goes", items=_others)

    @classmethod
    def poll(cls, context):
        if len(context.scene.material_palette.regions) < 2:
            cls.poll_message_set("There is no other region")
            return False
        return super().poll(context)

    def invoke(self, context, event):
        context.window_manager.invoke_search_popup(self)
        return {"FINISHED"}

    def apply(self, settings, region, mask):
        key = region.key
        index, other = next((i, r) for i, r in enumerate(settings.regions) if str(r.key) == self.other)
        try:
            mask |= read_mask_image(other)
        except (PaletteError, ValueError):  # no pixels, or of another photo's size
            self.report({"ERROR"}, f"The mask of '{other.name}' doesn't fit the photo")
            return {"CANCELLED"}
        set_mask(region, mask)
        remove_region(settings, index)
        settings.active_region = next(i for i, r in enumerate(settings.regions) if r.key == key)


class MATERIAL_PALETTE_OT_merge_alike(NeedsPackages, NeedsRegion, Operator):
    """Merge the enabled regions that show one material, judged by texture and colour"""

    bl_idname = "material_palette.merge_alike"
    bl_label = "Merge Alike Regions"
    bl_options = {"REGISTER", "UNDO"}

    most: FloatProperty(
        name="Farthest",
        description="How different regions of one material may be; 0.2 joined 9 of 10 halves of one texture",
        default=0.2,
        min=0.0,
        soft_max=0.5,
    )

    def execute(self, context):
        from ..core import merging
        from ..core.region import Region
        from .extract import nearest
        from .photo import photo_reader

        settings = context.scene.material_palette
        enabled = [region for region in settings.regions if region.enabled]
        try:
            pixels, _ = photo_reader(settings.photo)()
            masks = {region.key: read_photo_mask(region, settings.photo) for region in enabled}
        except PaletteError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        seen = [Region(region.name, nearest(masks[region.key], pixels.shape[:2])) for region in enabled]
        keys = [region.key for region in enabled]
        groups, distances = merging.find_alike(pixels, seen, self.most)
        said = []
        for group in groups:
            first = max(group, key=lambda i: int(masks[keys[i]].sum()))
            others = [i for i in group if i != first]
            if not others:
                continue
            mask = masks[keys[first]]
            for i in others:
                mask = mask | masks[keys[i]]
                apart = distances[min(i, first), max(i, first)]
                said.append(f"'{seen[i].name}' into '{seen[first].name}' ({apart:.2f} apart)")
                remove_region(settings, next(n for n, r in enumerate(settings.regions) if r.key == keys[i]))
            set_mask(next(r for r in settings.regions if r.key == keys[first]), mask)
        nearest_pair = f"; the nearest are {min(distances.values()):.2f} apart" if distances else ""
        self.report({"INFO"}, "Merged " + ", ".join(said) if said else f"No two regions are alike{nearest_pair}")
        return {"FINISHED"} if said else {"CANCELLED"}


class MATERIAL_PALETTE_MT_region(bpy.types.Menu):
    bl_label = "Edit Region"
    bl_description = "More edits of the regions"

    def draw(self, context):
        layout = self.layout
        layout.operator("material_palette.grow_region", text="Grow", icon="FULLSCREEN_ENTER").distance = 4.0
        layout.operator("material_palette.grow_region", text="Shrink", icon="FULLSCREEN_EXIT").distance = -4.0
        layout.operator("material_palette.smooth_region", text="Smooth", icon="MOD_SMOOTH")
        layout.separator()
        layout.operator("material_palette.split_region", icon="MOD_EXPLODE")
        layout.operator("material_palette.merge_region", text="Merge Another Region", icon="AUTOMERGE_ON")
        layout.operator("material_palette.merge_alike", icon="STICKY_UVS_LOC")
        layout.separator()
        layout.operator("material_palette.import_masks", icon="IMPORT")
        layout.operator("material_palette.export_masks", icon="EXPORT")
        layout.separator()
        layout.operator("material_palette.remove_region", icon="REMOVE")
        layout.operator("material_palette.remove_all_regions", icon="TRASH")


CLASSES = (
    MATERIAL_PALETTE_OT_grow_region,
    MATERIAL_PALETTE_OT_smooth_region,
    MATERIAL_PALETTE_OT_split_region,
    MATERIAL_PALETTE_OT_merge_region,
    MATERIAL_PALETTE_OT_merge_alike,
    MATERIAL_PALETTE_MT_region,
)
