"""Preview Exemplar: what a material would be learnt from, before any is extracted."""

import bpy
import numpy as np
from bpy.types import Operator

from ..core.errors import PaletteError
from .background import BackgroundOperator
from .extract import light, nearest
from .photo import photo_focal, photo_reader
from .rectify import corners_of
from .regions import image_editor, read_photo_mask

NAME = "Exemplar"  # of the image; one is used again and again
_OURS = "material_palette_exemplar"  # custom property that tells it from the user's own images


class MATERIAL_PALETTE_OT_preview_exemplar(BackgroundOperator, Operator):
    """Show what the active region's material would be learnt from: flat, evenly lit, dark where it is left out"""

    bl_idname = "material_palette.preview_exemplar"
    bl_label = "Preview Exemplar"

    def prepare(self, context):
        settings = context.scene.material_palette
        if settings.active_region >= len(settings.regions):
            raise PaletteError("No region to preview: add and paint one")
        region = settings.regions[settings.active_region]
        read, name, mask = photo_reader(settings.photo), region.name, read_photo_mask(region, settings.photo)
        chosen = light(settings) | {"rectify": settings.rectify}
        corners, width = corners_of(region), settings.photo.size[0]
        focal = settings.focal_length / 36.0 or photo_focal(settings.photo)

        def work(progress, send):
            progress(0.0, "Reading the photo")
            from ..core.palette import Settings, preview_exemplar
            from ..core.region import Region

            pixels, _warnings = read()
            region = Region(name, nearest(mask, pixels.shape[:2]))
            if corners is not None:
                region.corners = corners * (pixels.shape[1] / width)
            return preview_exemplar(pixels, region, Settings(**chosen), progress, focal and focal * max(pixels.shape))

        return work

    def finish(self, context, scene, result):
        picture, warnings = result
        height, width = picture.shape[:2]
        image = next((image for image in bpy.data.images if image.get(_OURS) and image.source == "GENERATED"), None)
        if image is None:
            image = bpy.data.images.new(NAME, width, height)
            image[_OURS] = True
        elif tuple(image.size) != (width, height):
            image.scale(width, height)
        rgba = np.ones((height, width, 4), np.float32)
        rgba[..., :3] = picture[::-1] / np.float32(255)
        image.pixels.foreach_set(rgba.ravel())
        image.update()
        area = image_editor(context)
        if area is not None:
            area.spaces.active.image = image
        self.report({"WARNING" if warnings else "INFO"}, "; ".join(warnings) or "Nothing is left out of this region")


CLASSES = (MATERIAL_PALETTE_OT_preview_exemplar,)
