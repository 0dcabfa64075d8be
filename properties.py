"""What a scene remembers (photo, regions, settings, palette) and what the window shows of a run."""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)
from bpy.types import Image, Material, PropertyGroup

# As in core.palette, which can't be imported where torch is missing; a test holds the two together.
QUALITIES = (
    ("draft", "Draft", "Fast and rough, for a first look"),
    ("balanced", "Balanced", "Good textures in a reasonable time"),
    ("best", "Best", "The closest textures, slowest"),
)
ENGINES = (
    ("patch", "Patch", "Grow the texture from the region's own patches; needs no network and no GPU"),
    ("diffusion", "Diffusion", "Let Stable Diffusion learn the region; needs weights, packages and a GPU: Preferences"),
)
SEGMENTATIONS = (
    ("auto", "Automatic", "By colour and texture, with what ships", "MOD_EXPLODE", 0),
    ("sam", "Segment Anything", "Objects, by weights of yours: Pick With in the preferences", "OBJECT_DATA", 1),
    ("materialistic", "Materialistic", "By weights of yours: Pick With in the preferences", "MATERIAL", 2),
)
WHITE_BALANCES = (
    ("off", "As in the Photo", "Keep the photo's own white balance"),
    ("region", "Grey on Average", "Take the light's colour from the region: for plaster, concrete and other greys"),
    ("card", "Grey Card", "Take the light's colour and brightness from a grey card: pick it with the eyedropper"),
)
RECTIFY = (
    (
        "auto",
        "Automatic",
        "Bring a slanted region to the front, by its corners or by the plane that is found, and turn it by its lines",
    ),
    ("quad", "Corners Only", "Bring only regions with corners to the front"),
    ("off", "Off", "Take every region as the photo shows it"),
)
RESOLUTION_RANGE = (64, 8192)
SCALE_RANGE = (0.25, 8.0)
# Paths that start with "//"; from Blender 4.5 on a property has to say that it takes them.
_BLEND_RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set()


def _photo_is_a_picture(settings, image):
    return image.type == "IMAGE" and all(image != region.mask for region in settings.regions)


def _show_active_mask(settings, context):
    from .operators.regions import follow_active_region

    follow_active_region(settings, context)


def _show_region_of_material(settings, context):
    entry = settings.palette[settings.active_material] if settings.active_material < len(settings.palette) else None
    for index, region in enumerate(settings.regions):
        if entry and region.key == entry.key and settings.active_region != index:
            settings.active_region = index


def _control(name):
    """get and set of a property that is the material's node tree itself: undo, scripts and hand-made edits agree."""

    def get(group):
        from .core.nodes import Controls

        value = getattr(Controls(group.id_data), name)
        return 0.0 if value is None else value

    def set_(group, value):
        from .core.nodes import Controls

        setattr(Controls(group.id_data), name, value)

    return {"get": get, "set": set_}


def _relief(name):
    from .core.nodes import RELIEFS, Controls

    return {
        "get": lambda group: RELIEFS.index(Controls(group.id_data).relief),
        "set": lambda group, value: setattr(Controls(group.id_data), name, RELIEFS[value]),
    }


class MATERIAL_PALETTE_PG_controls(PropertyGroup):
    """What an artist adjusts on an extracted material; it is not stored here, all of it is in the node tree."""

    # what was learnt of the region, where it is kept: JSON, and the tensors' file in base 64, which any file can hold
    concept: StringProperty(options={"HIDDEN"})
    concept_tensors: StringProperty(options={"HIDDEN"})
    tile_size: FloatProperty(
        name="Tile Size",
        description="How wide one repeat of the texture is on a surface whose UV map is in metres",
        min=0.001,
        soft_max=100.0,
        unit="LENGTH",
        **_control("tile_size"),
    )
    rotation: FloatProperty(
        name="Rotation", description="Turn of the texture on the surface", subtype="ANGLE", **_control("rotation")
    )
    relief: EnumProperty(
        name="Relief",
        description="How the surface's relief is made",
        items=(
            ("NORMAL", "Normal Map", "Shade the relief by the normal map; works on any mesh and in any renderer"),
            ("BUMP", "Bump", "Shade the relief by the height map; its depth is in real metres"),
            ("DISPLACEMENT", "Displacement", "Move the surface by the height map; needs a finely subdivided mesh"),
        ),
        **_relief("relief"),
    )
    strength: FloatProperty(
        name="Relief Strength",
        description="Factor on the normal map's slope or on the height",
        min=0.0,
        soft_max=2.0,
        max=10.0,
        **_control("strength"),
    )
    roughness_offset: FloatProperty(
        name="Roughness Offset",
        description="Added to the roughness map: below 0 glossier, above 0 duller",
        min=-1.0,
        max=1.0,
        **_control("roughness_offset"),
    )
    hue: FloatProperty(
        name="Hue",
        description="Turn of the base colour's hue; 0.5 leaves it as it is",
        min=0.0,
        max=1.0,
        **_control("hue"),
    )
    saturation: FloatProperty(
        name="Saturation",
        description="Factor on the base colour's saturation",
        min=0.0,
        max=2.0,
        **_control("saturation"),
    )
    brightness: FloatProperty(
        name="Brightness", description="Factor on the base colour", min=0.0, max=2.0, **_control("brightness")
    )


class MATERIAL_PALETTE_PG_region(PropertyGroup):
    # `name` comes with every PropertyGroup and becomes the material's name
    key: IntProperty(options={"HIDDEN"})  # what ties a material to its region, whatever either is called
    mask: PointerProperty(name="Mask", type=Image, description="White where the region is, the size of the photo")
    colour: FloatVectorProperty(
        name="Colour",
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        max=1.0,
        description="Colour of the region over the photo",
    )
    enabled: BoolProperty(name="Extract", default=True, description="Extract a material from this region")
    corners: FloatVectorProperty(
        name="Corners",
        size=8,
        description="A rectangle on the surface: x and y of four points in px of the photo, clockwise from top left",
    )
    has_corners: BoolProperty(name="Corners Set", description="Rectify this region by its corners")
    measured: FloatVectorProperty(
        name="Measured", size=4, description="x and y of two points on the surface in px of the photo"
    )
    has_measure: BoolProperty(name="Measured", description="The size of this region's tile follows from its measure")
    measured_length: FloatProperty(
        name="Length",
        default=1.0,
        min=0.0001,
        soft_max=100.0,
        unit="LENGTH",
        description="Length of what was measured on the surface",
    )
    visible: BoolProperty(name="Visible", default=True, description="Show the region over the photo")
    error: StringProperty(name="Error", description="Why no material could be made of the region the last time")
    automatic: BoolProperty(
        name="Automatic",
        description="Found by Auto Segment, which replaces it the next time it runs; painting keeps it",
    )


class MATERIAL_PALETTE_PG_extracted(PropertyGroup):
    # `name` is the region's name when the material was made
    key: IntProperty(options={"HIDDEN"})
    material: PointerProperty(name="Material", type=Material)
    previous: PointerProperty(name="Before", type=Material, description="The material that this one took the place of")
    seed: IntProperty(name="Seed", description="The seed that this material was made with")
    warnings: StringProperty(name="Warnings", description="What went less well than it could, one per line")


class MATERIAL_PALETTE_PG_settings(PropertyGroup):
    photo: PointerProperty(
        name="Photo", type=Image, poll=_photo_is_a_picture, description="The photo that materials are extracted from"
    )
    regions: CollectionProperty(type=MATERIAL_PALETTE_PG_region)
    last_key: IntProperty(options={"HIDDEN"})  # of a region, ever: none gets that of one that was removed
    active_region: IntProperty(name="Active Region", min=0, update=_show_active_mask, options={"SKIP_SAVE"})
    show_regions: BoolProperty(
        name="Show Regions", default=True, description="Show the regions over the photo in the Image Editor"
    )
    auto_regions: IntProperty(
        name="Regions", default=8, min=1, max=32, soft_max=16, description="The most regions Auto Segment makes"
    )
    segmentation: EnumProperty(
        name="Segmentation", items=SEGMENTATIONS, description="How Auto Segment tells materials apart"
    )

    engine: EnumProperty(name="Engine", items=ENGINES, description="How a region becomes a texture")
    quality: EnumProperty(name="Quality", items=QUALITIES, default="balanced", description="Speed against closeness")
    resolution: IntProperty(
        name="Resolution",
        default=1024,
        min=RESOLUTION_RANGE[0],
        max=RESOLUTION_RANGE[1],
        soft_max=4096,
        subtype="PIXEL",
        description="Width and height of every map",
    )
    scale: FloatProperty(
        name="Scale",
        default=1.0,
        min=SCALE_RANGE[0],
        max=SCALE_RANGE[1],
        description="How much larger the texture is shown than in the photo; a tile then holds less of the surface",
    )
    keep_concepts: BoolProperty(
        name="Keep Concepts",
        description="Keep what is learnt of each region in its material, so that Resample makes it larger or varies it "
        "without the photo. Adds about 6 bytes per pixel of the region to the file",
    )
    target_error: FloatProperty(
        name="Target Error",
        min=0.0,
        max=1.0,
        soft_max=0.3,
        step=1,
        precision=3,
        description="How far each texture may be from its region, such as 0.1: the cheapest quality predicted to meet "
        "it is chosen region by region. 0: as Quality says",
    )
    seed: IntProperty(name="Seed", min=0, description="The same seed gives the same textures, another one a variation")
    metres_per_tile: FloatProperty(
        name="Tile Size",
        default=1.0,
        min=0.001,
        soft_max=100.0,
        unit="LENGTH",
        description="How wide one tile of the texture is on a surface whose UV map is in metres",
    )
    rectify: EnumProperty(name="Rectify", items=RECTIFY, default="auto", description="How slanted regions are treated")
    focal_length: FloatProperty(
        name="Focal Length",
        min=0.0,
        soft_max=200.0,
        unit="CAMERA",
        description="Of the photo's camera, for a sensor 36 mm wide on its longer side; 0: from the photo, or found",
    )
    flatten: BoolProperty(
        name="Flatten Light",
        default=True,
        description="Take slow changes of light and cast shadows out of the photo; learn from one side of a box",
    )
    white_balance: EnumProperty(
        name="White Balance", items=WHITE_BALANCES, description="What to do about the colour of the light"
    )
    grey_card: FloatVectorProperty(
        name="Grey Card",
        subtype="COLOR",
        size=3,
        min=0.0,
        soft_max=1.0,
        default=(0.18, 0.18, 0.18),
        description="Colour of an 18 % grey card in the photo, or in one of the same light and exposure: base colours "
        "become as bright as they are",
    )
    pack: BoolProperty(
        name="Pack Textures",
        default=True,
        description="Store the textures in the .blend file; else they are written to the output folder",
    )
    output_folder: StringProperty(
        name="Output Folder",
        default="//palette",
        subtype="DIR_PATH",
        options=_BLEND_RELATIVE,
        description="Where the textures are written",
    )
    overwrite: BoolProperty(name="Overwrite", description="Replace what the output folder holds")

    author: StringProperty(name="Author", description="Of the photo; written into the assets made of it")
    licence: StringProperty(
        name="Licence", description="Of the photo, such as CC0 or CC BY 4.0; written into the assets made of it"
    )

    palette: CollectionProperty(type=MATERIAL_PALETTE_PG_extracted)
    active_material: IntProperty(name="Active Material", min=0, options={"SKIP_SAVE"}, update=_show_region_of_material)
    palette_view: EnumProperty(
        name="View",
        description="How the palette is shown",
        items=(("GRID", "Grid", "Large previews", "IMGDISPLAY", 0), ("LIST", "List", "Names", "LONGDISPLAY", 1)),
    )


def _run(attribute):
    def get(_state):
        from .operators import background

        return getattr(background.state(), attribute)

    return get


class MATERIAL_PALETTE_PG_run(PropertyGroup):
    """Read from the run itself, so no file can keep a run that has ended."""

    running: BoolProperty(name="Running", get=_run("running"))
    progress: FloatProperty(name="Progress", subtype="FACTOR", min=0.0, max=1.0, get=_run("progress"))
    message: StringProperty(name="Message", get=_run("message"))
    seconds_left: FloatProperty(name="Seconds Left", description="-1 while unknown", get=_run("seconds_left"))
    error: StringProperty(name="Error", description="Why the last run failed", get=_run("error"))


_CLASSES = (
    MATERIAL_PALETTE_PG_controls,
    MATERIAL_PALETTE_PG_region,
    MATERIAL_PALETTE_PG_extracted,
    MATERIAL_PALETTE_PG_settings,
    MATERIAL_PALETTE_PG_run,
)


def register():
    for cls in _CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.material_palette = PointerProperty(type=MATERIAL_PALETTE_PG_settings)
    bpy.types.Material.material_palette = PointerProperty(type=MATERIAL_PALETTE_PG_controls)
    bpy.types.WindowManager.material_palette_run = PointerProperty(type=MATERIAL_PALETTE_PG_run)


def unregister():
    del bpy.types.WindowManager.material_palette_run
    del bpy.types.Material.material_palette
    del bpy.types.Scene.material_palette
    for cls in reversed(_CLASSES):
        bpy.utils.unregister_class(cls)
