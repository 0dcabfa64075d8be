"""Auto Segment: regions found in the photo, on a background thread."""

import contextlib

import numpy as np
from bpy.types import Operator

from ..core.errors import PaletteError
from .background import BackgroundOperator
from .extract import nearest
from .photo import photo_reader
from .preferences import pick_weights
from .regions import add_region, read_mask_image, remove_region

_MOST_TAKEN = 0.5  # share of what is found that may lie in regions of the artist's own; else it is their material


class MATERIAL_PALETTE_OT_segment(BackgroundOperator, Operator):
    """Find regions of one material in what is left of the photo; painted, picked and imported regions stay"""

    bl_idname = "material_palette.segment"
    bl_label = "Auto Segment"

    def prepare(self, context):
        settings = context.scene.material_palette
        read, (width, height) = photo_reader(settings.photo), settings.photo.size
        self.photo = settings.photo.session_uid, width, height
        engine, count, seed = settings.segmentation, settings.auto_regions, settings.seed
        weights = None if engine == "auto" else pick_weights(context)
        if engine != "auto" and not weights:
            raise PaletteError("This needs weights: name them in the extension's preferences, as Pick With")

        def work(progress, send):
            from ..core.segmentation import segment

            progress(0.0, "Reading the photo")
            pixels, warnings = read()
            warnings = list(warnings)
            found = segment(pixels, engine, count, seed, progress, warnings.append, weights)
            return [(region.name, nearest(region.mask, (height, width))) for region in found], warnings

        return work

    def finish(self, context, scene, result):
        settings = scene.material_palette
        if settings.photo is None:
            raise PaletteError("The photo was removed meanwhile; no region was added")
        if (settings.photo.session_uid, *settings.photo.size) != self.photo:
            raise PaletteError("Another photo was chosen meanwhile; no region was added")
        for index in reversed(range(len(settings.regions))):
            if settings.regions[index].automatic:
                remove_region(settings, index)
        first, (found, warnings) = len(settings.regions), result
        taken = _taken(settings, found[0][1].shape)
        for name, mask in found:
            if np.count_nonzero(mask & taken) <= _MOST_TAKEN * np.count_nonzero(mask):
                add_region(settings, name, mask & ~taken, automatic=True)
        added = len(settings.regions) - first
        if added:
            settings.active_region = first
        said = [f"{added} regions found" + (f", {len(found) - added} are yours already" if added < len(found) else "")]
        self.report({"WARNING"} if warnings else {"INFO"}, ". ".join([*said, *(text.rstrip(".") for text in warnings)]))


def _taken(settings, shape):
    """(H, W) bool: what lies in the scene's regions; those whose mask can't be used say so themselves."""
    taken = np.zeros(shape, bool)
    for region in settings.regions:
        with contextlib.suppress(PaletteError, ValueError):
            taken |= read_mask_image(region)
    return taken


CLASSES = (MATERIAL_PALETTE_OT_segment,)
