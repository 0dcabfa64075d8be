"""Runs inside Blender's window: opens the example photo and reports what the clicks outside have made of it.

Environment: PALETTE_PHOTO, PALETTE_STATE (a JSON file, rewritten twice a second: what the data holds). A file
PALETTE_STATE.do holds the name of a function below to be called.
"""

import json
import os

import blender_gui
import bpy
import numpy as np

STATE = os.environ["PALETTE_STATE"]
BLEND = STATE + ".blend"
done = []  # functions that were called, by the order


def editor():
    area = blender_gui.find_area("IMAGE_EDITOR")
    return bpy.context.temp_override(
        window=blender_gui.window(),
        area=area,
        region=next(region for region in area.regions if region.type == "WINDOW"),
        space_data=area.spaces.active,
    )


def palette():
    return bpy.context.scene.material_palette


def set_up():
    with editor():
        assert bpy.ops.material_palette.open_photo(filepath=os.environ["PALETTE_PHOTO"]) == {"FINISHED"}
        bpy.ops.image.view_all(fit_view=True)
    settings = palette()
    settings.quality, settings.resolution, settings.auto_regions = "draft", 128, 4
    cube = bpy.data.objects["Cube"]
    cube.data.uv_layers.remove(cube.data.uv_layers[0])
    cube.select_set(True)
    bpy.context.view_layer.objects.active = cube
    bpy.ops.ed.undo_push(message="Set up")


def fold():
    """Scroll the sidebar to its end."""
    for area in blender_gui.window().screen.areas:
        if area.type == "IMAGE_EDITOR":
            for region in area.regions:
                if region.type == "UI":
                    with bpy.context.temp_override(window=blender_gui.window(), area=area, region=region):
                        bpy.ops.view2d.scroll_down(deltay=600)


def unfold():
    for area in blender_gui.window().screen.areas:
        if area.type == "IMAGE_EDITOR":
            for region in area.regions:
                if region.type == "UI":
                    with bpy.context.temp_override(window=blender_gui.window(), area=area, region=region):
                        bpy.ops.view2d.scroll_up(deltay=6000)


def keep_two():
    """Leave the two smallest regions to be extracted."""
    settings = palette()
    by_area = sorted(settings.regions, key=share)
    for region in settings.regions:
        region.enabled = region.name in {region.name for region in by_area[:2]}
    settings.quality, settings.resolution = "balanced", 256
    bpy.ops.ed.undo_push(message="Choose")


def hurry():
    palette().quality, palette().resolution = "draft", 128
    bpy.ops.ed.undo_push(message="Hurry")


def save():
    bpy.ops.wm.save_as_mainfile(filepath=BLEND)


def reopen():
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=BLEND)


def share(region):
    """Share of the region's mask that isn't black."""
    pixels = np.empty(len(region.mask.pixels), np.float32)
    region.mask.pixels.foreach_get(pixels)
    return float((pixels.reshape(-1, 4)[:, 0] > 0).mean())


def texture_names(material):
    return sorted(node.image.name for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeTexImage")


def photo_rectangle():
    """Left, top, right and bottom of the photo in pixels of the screen."""
    area = blender_gui.find_area("IMAGE_EDITOR")
    region = next(region for region in area.regions if region.type == "WINDOW")
    (left, bottom), (right, top) = (region.view2d.view_to_region(at, at, clip=False) for at in (0.0, 1.0))
    height = blender_gui.window().height
    return [region.x + left, height - region.y - top, region.x + right, height - region.y - bottom]


def report():
    """Write the state; exists so that the clicks outside can wait for what they cause."""
    if os.path.exists(STATE + ".do"):
        with open(STATE + ".do", encoding="utf-8") as file:
            name = file.read().strip()
        os.remove(STATE + ".do")
        globals()[name]()
        done.append(name)
    settings, run = palette(), bpy.context.window_manager.material_palette_run
    cube = bpy.data.objects.get("Cube")
    space = blender_gui.find_area("IMAGE_EDITOR").spaces.active if blender_gui.find_area("IMAGE_EDITOR") else None
    state = {
        "done": done,
        "photo": settings.photo.name if settings.photo else None,
        "rectangle": photo_rectangle() if space else None,
        "mode": space.mode if space else None,
        "brush": bpy.context.tool_settings.image_paint.brush is not None,
        "running": run.running,
        "progress": run.progress,
        "message": run.message,
        "error": run.error,
        "regions": [region.name for region in settings.regions],
        "automatic": [region.name for region in settings.regions if region.automatic],
        "enabled": [region.name for region in settings.regions if region.enabled],
        "active": settings.active_region,
        "shares": [share(region) for region in settings.regions],
        "palette": [entry.material.name for entry in settings.palette if entry.material],
        "images": [", ".join(texture_names(entry.material)) for entry in settings.palette if entry.material],
        "seeds": [entry.seed for entry in settings.palette],
        "before": [entry.previous is not None for entry in settings.palette],
        "previews": all(entry.material.preview.is_image_custom for entry in settings.palette if entry.material),
        "materials": sorted(material.name for material in bpy.data.materials),
        "cube": cube.active_material.name if cube and cube.active_material else None,
        "uv": [layer.name for layer in cube.data.uv_layers] if cube else None,
        "temporary": sorted(name for name in os.listdir(bpy.app.tempdir) if name.startswith("material_palette_")),
    }
    with open(STATE + ".part", "w", encoding="utf-8") as file:
        json.dump(state, file, ensure_ascii=False)
    os.replace(STATE + ".part", STATE)
    return 0.5


blender_gui.set_area("IMAGE_EDITOR")
blender_gui.step(set_up)
blender_gui.show_tab("IMAGE_EDITOR", "Palette")
blender_gui.step(lambda: bpy.app.timers.register(report, persistent=True))
