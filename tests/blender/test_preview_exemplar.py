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


def test_it_is_of_the_scenes_rectify_mode_corners_and_focal_length(settings, photo_and_masks, monkeypatch):
    from material_palette.core import palette
    from material_palette.operators.rectify import set_corners

    photo, masks = photo_and_masks
    bpy.ops.material_palette.open_photo(filepath=str(photo))
    bpy.ops.material_palette.import_masks(directory=str(masks))
    set_corners(settings.regions[0], [[10, 10], [60, 14], [60, 66], [10, 70]])
    settings.active_region, settings.rectify, settings.focal_length = 0, "quad", 72.0
    seen = []

    def preview(pixels, region, chosen, progress, focal=None):
        seen.append((region.corners.tolist(), chosen.rectify, focal))
        return np.zeros((8, 8, 3), np.uint8), []

    monkeypatch.setattr(palette, "preview_exemplar", preview)
    assert bpy.ops.material_palette.preview_exemplar() == {"FINISHED"}
    assert seen == [([[10, 10], [60, 14], [60, 66], [10, 70]], "quad", pytest.approx(320.0))]


def test_an_image_of_the_users_of_that_name_stays(settings, photo_and_masks):
    photo, masks = photo_and_masks
    bpy.ops.material_palette.open_photo(filepath=str(photo))
    bpy.ops.material_palette.import_masks(directory=str(masks))
    own = bpy.data.images.new("Exemplar", 8, 8)
    for _ in range(2):
        assert bpy.ops.material_palette.preview_exemplar() == {"FINISHED"}
    assert tuple(own.size) == (8, 8) and not any(own.pixels[:3])
    assert sum(image.name.startswith("Exemplar") for image in bpy.data.images) == 2


def test_without_a_region_it_is_refused(settings, photo_and_masks):
    bpy.ops.material_palette.open_photo(filepath=str(photo_and_masks[0]))
    with pytest.raises(RuntimeError, match="No region"):
        bpy.ops.material_palette.preview_exemplar()
