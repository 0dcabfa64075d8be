"""The adjustments of an extracted material, in the sidebar and in Properties > Material."""

from bpy.types import Panel

from ..core.nodes import Controls
from ..operators import preview


def draw_controls(layout, material):
    """Draw what can be adjusted on `material`: what it lacks, such as a map's scale without a map, is left out."""
    controls, adjust = Controls(material), material.material_palette
    if not controls:
        layout.label(text="Not made by Material Palette", icon="INFO")
        return
    layout.use_property_split = True
    layout.use_property_decorate = False
    if controls.node("mapping"):
        column = layout.column(align=True)
        column.prop(adjust, "tile_size")
        column.prop(adjust, "rotation")
    if controls.node("normal map") or material.get("height"):
        column = layout.column(align=True)
        if material.get("height"):
            column.prop(adjust, "relief")
        column.prop(adjust, "strength", text="Strength")
        if adjust.relief == "DISPLACEMENT":
            layout.label(text="Needs a finely subdivided mesh", icon="INFO")
    principled = controls.node("principled")
    column = layout.column(align=True)
    if controls.node("roughness"):
        column.prop(adjust, "roughness_offset", text="Roughness ±")
    else:
        column.prop(principled.inputs["Roughness"], "default_value", text="Roughness")
    if controls.node("basecolor"):
        column = layout.column(align=True)
        column.prop(adjust, "hue")
        column.prop(adjust, "saturation")
        column.prop(adjust, "brightness")
    else:
        column.prop(principled.inputs["Base Color"], "default_value", text="Base Color")


class MATERIAL_PALETTE_PT_material(Panel):
    bl_label = "Material Palette"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "material"

    @classmethod
    def poll(cls, context):
        material = getattr(context, "material", None)
        return material is not None and bool(Controls(material))

    def draw(self, context):
        preview.follow(context.material)
        draw_controls(self.layout, context.material)


CLASSES = (MATERIAL_PALETTE_PT_material,)
