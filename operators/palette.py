"""The palette's materials: compare with the one before, reset, delete, show the region that one came from."""

import bpy
from bpy.props import IntProperty
from bpy.types import Operator


def active_entry(settings):
    """The palette's active entry, or None."""
    return settings.palette[settings.active_material] if settings.active_material < len(settings.palette) else None


def region_of(settings, key):
    """The region with this key, or None."""
    return next((region for region in settings.regions if region.key == key), None)


def put_in_palette(settings, key, material, keep_before=True):
    """List `material` as that of the region with this key; return its entry.

    A material that the region had already gives it its name, its adjustments and its places in the scene, and is kept
    as the one before, unless keep_before is False.
    """
    from ..core import nodes

    entry = next((entry for entry in settings.palette if entry.key == key), None)
    if entry is None:
        entry = settings.palette.add()
        entry.key = key
        if len(settings.palette) == 1:
            settings.active_material = 0
    old = entry.material
    if old is not None:
        _drop_before(entry)
        adopt_adjustments(material, old)
        take_place(material, old)
        if keep_before:
            entry.previous = old
        else:
            nodes.remove_material(old)
    entry.material = material
    return entry


def adopt_adjustments(material, old):
    """What the artist has changed on `old` holds for `material`."""
    from ..core.nodes import Controls

    if not (Controls(old) and Controls(material)):
        return
    values = Controls(old).values()
    extracted, now = (m.get("metres_per_tile", 1.0) for m in (old, material))
    if values.get("tile_size") and abs(values["tile_size"] / extracted - 1.0) < 1e-4:
        del values["tile_size"]  # as extracted then; now as extracted now
    elif values.get("tile_size"):
        values["tile_size"] *= now / extracted
    Controls(material).set(values)


def take_place(material, old):
    """`material` stands wherever `old` did, under its name."""
    name = old.name
    old.user_remap(material)
    material.name = "Material Palette stand-in"  # it may have the name that the other gets
    old.name = f"{name} (before)"
    material.name = name
    if old.asset_data is not None:
        old.asset_clear()


def _drop_before(entry):
    from ..core import nodes

    old, entry.previous = entry.previous, None
    if old is not None and old.users == 0:
        nodes.remove_material(old)


def drop_before(settings, built):
    """Delete the materials before those of `built` ({region key: session_uid}), whose files were replaced."""
    from ..core import nodes

    for entry in settings.palette:
        if entry.previous and entry.material and entry.material.session_uid == built.get(entry.key):
            nodes.remove_material(entry.previous)


class NeedsMaterial:
    @classmethod
    def poll(cls, context):
        entry = active_entry(context.scene.material_palette)
        if entry is None or entry.material is None:
            cls.poll_message_set("Its material was deleted" if entry else "Extract a palette first")
            return False
        return True


class _NeedsBefore(NeedsMaterial):
    @classmethod
    def poll(cls, context):
        if not super().poll(context):
            return False
        if active_entry(context.scene.material_palette).previous is None:
            cls.poll_message_set("There is nothing to compare with: make a variation, or extract the region again")
            return False
        return True


class MATERIAL_PALETTE_OT_select_material(Operator):
    """Make this the palette's active material and highlight the region that it came from"""

    bl_idname = "material_palette.select_material"
    bl_label = "Select Material"
    bl_options = {"REGISTER", "UNDO", "INTERNAL"}

    index: IntProperty(min=0)

    @classmethod
    def description(cls, context, properties):
        palette = context.scene.material_palette.palette
        entry = palette[properties.index] if properties.index < len(palette) else None
        return f"'{entry.name}'. {cls.__doc__}" if entry else cls.__doc__

    def execute(self, context):
        settings = context.scene.material_palette
        if self.index >= len(settings.palette):
            return {"CANCELLED"}
        settings.active_material = self.index
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_compare(_NeedsBefore, Operator):
    """Put the material from before in the place of this one, everywhere in the scene; again to go back"""

    bl_idname = "material_palette.compare"
    bl_label = "Compare with Before"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        from ..core import nodes

        entry = active_entry(context.scene.material_palette)
        new, old = entry.material, entry.previous
        asset = new.asset_data
        told = (asset.description, asset.author, asset.license) if asset else None
        entry.previous = None
        take_place(old, new)
        entry.material, entry.previous = old, new
        if told is not None:
            nodes.mark_asset(old, *told)
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_discard_before(_NeedsBefore, Operator):
    """Keep the material as it is now and delete the one from before, with its images"""

    bl_idname = "material_palette.discard_before"
    bl_label = "Keep This One"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        _drop_before(active_entry(context.scene.material_palette))
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_reset_material(NeedsMaterial, Operator):
    """Take all adjustments back: the material is as it was extracted"""

    bl_idname = "material_palette.reset_material"
    bl_label = "Reset Adjustments"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context):
        from ..core.nodes import Controls

        Controls(active_entry(context.scene.material_palette).material).reset()
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_delete_material(Operator):
    """Delete the active material from the file, with its images and the material from before"""

    bl_idname = "material_palette.delete_material"
    bl_label = "Delete Material"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context):
        if active_entry(context.scene.material_palette) is None:
            cls.poll_message_set("Extract a palette first")
            return False
        return True

    def execute(self, context):
        from ..core import nodes

        settings = context.scene.material_palette
        entry = active_entry(settings)
        for material in (entry.material, entry.previous):
            if material is not None and material.library is None:
                nodes.remove_material(material)
        settings.palette.remove(settings.active_material)
        settings.active_material = min(settings.active_material, max(0, len(settings.palette) - 1))
        return {"FINISHED"}


class MATERIAL_PALETTE_OT_show_region(NeedsMaterial, Operator):
    """Show in the Image Editor the region of the photo that the active material came from"""

    bl_idname = "material_palette.show_region"
    bl_label = "Show Its Region"
    bl_options = {"REGISTER"}

    def execute(self, context):
        settings = context.scene.material_palette
        entry = active_entry(settings)
        region = region_of(settings, entry.key)
        if region is None:
            self.report({"WARNING"}, f"The region of '{entry.name}' is gone")
            return {"CANCELLED"}
        settings.active_region = list(settings.regions).index(region)
        region.visible = True
        return bpy.ops.material_palette.show_photo()


CLASSES = (
    MATERIAL_PALETTE_OT_select_material,
    MATERIAL_PALETTE_OT_compare,
    MATERIAL_PALETTE_OT_discard_before,
    MATERIAL_PALETTE_OT_reset_material,
    MATERIAL_PALETTE_OT_delete_material,
    MATERIAL_PALETTE_OT_show_region,
)
