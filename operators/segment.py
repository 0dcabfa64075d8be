"""Auto Segment: regions found in the photo, on a background thread."""

from bpy.types import Operator

from ..core.errors import PaletteError
from .background import BackgroundOperator
from .photo import photo_reader
from .regions import add_region, remove_region


class MATERIAL_PALETTE_OT_segment(BackgroundOperator, Operator):
    """Find regions of one material in the photo; painted and imported regions stay"""

    bl_idname = "material_palette.segment"
    bl_label = "Auto Segment"

    def prepare(self, context):
        settings = context.scene.material_palette
        read = photo_reader(settings.photo)
        count, seed = settings.auto_regions, settings.seed

        def work(progress, send):
            from ..core.segmentation import segment

            progress(0.0, "Reading the photo")
            pixels, _warnings = read()
            return segment(pixels, regions=count, seed=seed, progress=progress)

        return work

    def finish(self, context, scene, result):
        settings = scene.material_palette
        if settings.photo is None:
            raise PaletteError("The photo was removed meanwhile; no region was added")
        for index in reversed(range(len(settings.regions))):
            if settings.regions[index].automatic:
                remove_region(settings, index)
        first = len(settings.regions)
        for region in result:
            add_region(settings, region.name, region.mask, automatic=True)
        settings.active_region = first
        self.report({"INFO"}, f"{len(result)} regions found")


CLASSES = (MATERIAL_PALETTE_OT_segment,)
