"""Runs inside Blender's window: sets up a scene with the example photo and reports what clicks have made of it.

Environment: PALETTE_PHOTO, PALETTE_MASKS, PALETTE_STATE (a JSON file, rewritten twice a second: what the data holds).
A file PALETTE_STATE.paint asks for the last region to be painted.
"""

import json
import os

import blender_gui
import bpy
import numpy as np

STATE = os.environ["PALETTE_STATE"]


def image_editor():
    area = blender_gui.find_area("IMAGE_EDITOR")
    return bpy.context.temp_override(
        window=blender_gui.window(),
        area=area,
        region=next(region for region in area.regions if region.type == "WINDOW"),
        space_data=area.spaces.active,
    )


def set_up():
    with image_editor():
        assert bpy.ops.material_palette.open_photo(filepath=os.environ["PALETTE_PHOTO"]) == {"FINISHED"}
        assert bpy.ops.material_palette.import_masks(directory=os.environ["PALETTE_MASKS"]) == {"FINISHED"}
        bpy.ops.image.view_all(fit_view=True)
    settings = bpy.context.scene.material_palette
    settings.quality = "draft"
    settings.resolution = 128
    cube = bpy.data.objects["Cube"]
    cube.select_set(True)
    bpy.context.view_layer.objects.active = cube
    bpy.ops.ed.undo_push(message="Set up")
    bpy.app.timers.register(report, persistent=True)


def paint():
    with image_editor():
        assert bpy.ops.material_palette.paint_region() == {"FINISHED"}


def painted():
    """Share of the active region's mask that isn't black."""
    settings = bpy.context.scene.material_palette
    mask = settings.regions[settings.active_region].mask
    pixels = np.empty(len(mask.pixels), np.float32)
    mask.pixels.foreach_get(pixels)
    return float((pixels.reshape(-1, 4)[:, 0] > 0).mean())


def report():
    """Write the state; exists so that the clicks outside can wait for what they cause."""
    if os.path.exists(STATE + ".paint"):
        os.remove(STATE + ".paint")
        paint()
    settings = bpy.context.scene.material_palette
    run = bpy.context.window_manager.material_palette_run
    cube = bpy.data.objects.get("Cube")
    state = {
        "running": run.running,
        "progress": run.progress,
        "message": run.message,
        "error": run.error,
        "regions": [region.name for region in settings.regions],
        "palette": [entry.material.name for entry in settings.palette if entry.material],
        "previews": all(entry.material.preview.is_image_custom for entry in settings.palette if entry.material),
        "materials": sorted(material.name for material in bpy.data.materials),
        "images": len(bpy.data.images),
        "cube": cube.active_material.name if cube and cube.active_material else None,
        "temporary": sorted(name for name in os.listdir(bpy.app.tempdir) if name.startswith("material_palette_")),
        "mode": blender_gui.find_area("IMAGE_EDITOR").spaces.active.mode,
        "brush": bpy.context.tool_settings.image_paint.brush is not None,
        "painted": painted(),
    }
    with open(STATE + ".part", "w", encoding="utf-8") as file:
        json.dump(state, file, ensure_ascii=False)
    os.replace(STATE + ".part", STATE)
    return 0.5


blender_gui.set_area("IMAGE_EDITOR")
blender_gui.step(set_up)
blender_gui.show_tab("IMAGE_EDITOR", "Palette")
