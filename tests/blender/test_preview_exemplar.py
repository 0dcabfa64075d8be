"""Preview Exemplar, as a script in background mode runs it."""

import bpy
import numpy as np
import pytest


def test_the_active_regions_exemplar_becomes_an_image_and_is_made_anew(settings, photo_and_masks):
    photo, masks = photo_and_masks
    bpy.ops.material_palette.open_photo(filepath=str(photo))
    bpy.ops.material_palette.import_masks(directory=str(masks))
    for index in (0, 1):
        settings.active_region = index
        assert bpy.ops.material_palette.preview_exemplar() == {"FINISHED"}
        image = bpy.data.images["Exemplar"]
        pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
        image.pixels.foreach_get(pixels)
        assert pixels.reshape(-1, 4)[:, :3].std() > 0.01
    assert sum(image.name.startswith("Exemplar") for image in bpy.data.images) == 1


def test_without_a_region_it_is_refused(settings, photo_and_masks):
    bpy.ops.material_palette.open_photo(filepath=str(photo_and_masks[0]))
    with pytest.raises(RuntimeError, match="No region"):
        bpy.ops.material_palette.preview_exemplar()
