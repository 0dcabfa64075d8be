"""Runs inside Blender's window for the stories without a file of their own: reports what the clicks outside have made.

Environment: PALETTE_PHOTO, PALETTE_STATE (a JSON file, rewritten twice a second: what the data holds). A file
PALETTE_STATE.do holds the name of a function below to be called.
"""

import importlib
import json
import os
import sys

import blender_gui
import bpy
import numpy as np

STATE = os.environ["PALETTE_STATE"]
BLEND = STATE + ".blend"
CARD = 450, 400  # thousandths of the photo where the eyedropper is put
done = []  # functions that were called, by the order
handle = []  # thousandths of the photo
at_card = []  # linear colour of the photo where the eyedropper is put


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
        for region in area.regions:
            if area.type in {"IMAGE_EDITOR", "VIEW_3D"} and region.type == "UI":
                with bpy.context.temp_override(window=blender_gui.window(), area=area, region=region):
                    bpy.ops.view2d.scroll_down(deltay=6000)


def keep_two():
    """Leave the two smallest regions to be extracted."""
    settings = palette()
    by_area = sorted(settings.regions, key=share)
    for region in settings.regions:
        region.enabled = region.name in {region.name for region in by_area[:2]}
    # long enough on a fast machine, too, for Esc to come before the second is done
    settings.quality, settings.resolution = "best", 1024
    bpy.ops.ed.undo_push(message="Choose")


def hurry():
    palette().quality, palette().resolution = "draft", 128
    bpy.ops.ed.undo_push(message="Hurry")


def save():
    bpy.ops.wm.save_as_mainfile(filepath=BLEND)


def reopen():
    bpy.ops.wm.read_homefile(app_template="", use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=BLEND)


def browse():
    """The properties become a file browser with the photo in it, the rest an Image Editor without a photo."""
    blender_gui.find_area("PROPERTIES").type = "FILE_BROWSER"
    bpy.app.timers.register(enter_folder, first_interval=1.0)


def enter_folder():
    space = blender_gui.find_area("FILE_BROWSER").spaces.active
    if space.params is None:  # not drawn yet
        return 0.5
    space.params.directory = os.path.dirname(os.environ["PALETTE_PHOTO"]).encode()
    space.params.display_type, space.show_region_toolbar = "LIST_VERTICAL", False
    return None


def masks():
    """Two regions of the example; what is kept of them is to be kept."""
    with editor():
        bpy.ops.material_palette.import_masks(directory=os.environ["PALETTE_MASKS"])
        bpy.ops.image.view_all(fit_view=True)
    settings = palette()
    settings.quality, settings.resolution, settings.keep_concepts = "draft", 64, True
    settings.active_region = 1  # not of one colour
    bpy.ops.ed.undo_push(message="Masks")
    # where the handles of its corners are at first
    rectify = sys.modules["bl_ext.user_default.material_palette.operators.rectify"]
    first = rectify.MATERIAL_PALETTE_OT_corners.begin(None, settings.regions[1])[0]
    handle[:] = [round(1000 * part / whole) for part, whole in zip(first, settings.photo.size, strict=True)]


def clear():
    """The corners were no rectangle's."""
    region = palette().regions[palette().active_region]
    region.has_corners = region.has_measure = False
    bpy.ops.ed.undo_push(message="Clear")


def card():
    """White balance by a grey card, which the eyedropper takes from the photo."""
    palette().white_balance = "card"
    blender_gui.find_area("IMAGE_EDITOR").tag_redraw()
    bpy.ops.ed.undo_push(message="Card")
    photo = palette().photo
    width, height = photo.size
    pixels = np.empty(width * height * 4, np.float32)
    photo.pixels.foreach_get(pixels)
    x, y = CARD[0] * width // 1000, (1000 - CARD[1]) * height // 1000
    around = pixels.reshape(height, width, 4)[y - 2 : y + 3, x - 2 : x + 3, :3].mean((0, 1))
    image = importlib.import_module("bl_ext.user_default.material_palette.core.image")
    at_card[:] = image.linear_from_srgb(around).tolist()


def larger():
    palette().resolution = 128
    bpy.ops.ed.undo_push(message="Larger")


def search():
    """As F3 over the Image Editor."""
    with editor():
        bpy.ops.wm.search_menu("INVOKE_DEFAULT")


def look_at_objects():
    """The large area becomes a 3D View with the tab Palette."""
    area = blender_gui.find_area("IMAGE_EDITOR")
    area.type = "VIEW_3D"
    area.spaces.active.show_region_ui = True
    bpy.app.timers.register(choose_tab, first_interval=0.5)


def choose_tab():
    area = blender_gui.find_area("VIEW_3D")
    next(region for region in area.regions if region.type == "UI").active_panel_category = "Palette"
    area.tag_redraw()


def bare_cube():
    bpy.data.objects["Cube"].data.materials.clear()


def one_face():
    """Edit Mode with one face selected."""
    cube = bpy.data.objects["Cube"]
    cube.data.materials.clear()
    bpy.context.view_layer.objects.active = cube
    area = blender_gui.find_area("VIEW_3D")
    region = next(region for region in area.regions if region.type == "WINDOW")
    for index, face in enumerate(cube.data.polygons):
        face.select = index == 2
    with bpy.context.temp_override(window=blender_gui.window(), area=area, region=region):
        bpy.context.tool_settings.mesh_select_mode = (False, False, True)
        bpy.ops.object.mode_set(mode="EDIT")


def leave_edit_mode():
    area = blender_gui.find_area("VIEW_3D")
    region = next(region for region in area.regions if region.type == "WINDOW")
    with bpy.context.temp_override(window=blender_gui.window(), area=area, region=region):
        bpy.ops.object.mode_set(mode="OBJECT")


def two_regions():
    """The wall stays out; one of the others is of one colour."""
    with editor():
        bpy.ops.material_palette.open_photo(filepath=os.environ["PALETTE_PHOTO"])
        bpy.ops.material_palette.import_masks(directory=os.environ["PALETTE_MASKS"])
        bpy.ops.image.view_all(fit_view=True)
    settings = palette()
    settings.quality, settings.resolution, settings.author, settings.licence = "draft", 64, "An Artist", "CC0"
    settings.regions[2].enabled = False
    bpy.ops.ed.undo_push(message="Regions")


def show_preferences():
    """The large area becomes the preferences, open at the extension."""
    import addon_utils

    name = "bl_ext.user_default.material_palette"
    info = next(addon_utils.module_bl_info(m) for m in addon_utils.modules(refresh=False) if m.__name__ == name)
    info["show_expanded"] = True
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = info["name"]
    blender_gui.find_area("IMAGE_EDITOR").type = "PREFERENCES"


def hide_preferences():
    blender_gui.find_area("PREFERENCES").type = "IMAGE_EDITOR"
    blender_gui.show_tab("IMAGE_EDITOR", "Palette")


def diffusion():
    palette().engine = "diffusion"
    blender_gui.find_area("IMAGE_EDITOR").tag_redraw()


def patch():
    palette().engine = "patch"


def add_library():
    """An asset library, a folder to export to, and file browsers within the window."""
    for name in ("library", "exported"):
        os.makedirs(f"{STATE}.{name}", exist_ok=True)
        for root, _, files in os.walk(f"{STATE}.{name}"):
            for file in files:
                os.remove(os.path.join(root, file))
    bpy.context.preferences.filepaths.asset_libraries.new(name="Mine", directory=f"{STATE}.library")
    bpy.context.preferences.view.filebrowser_display_type = "SCREEN"


def choose_folder():
    """Where the file browser that is open looks."""
    space = blender_gui.find_area("FILE_BROWSER").spaces.active
    space.params.directory = f"{STATE}.exported".encode()


def browse_assets():
    """The properties become an Asset Browser with the assets of this file."""
    blender_gui.find_area("PROPERTIES").ui_type = "ASSETS"
    bpy.app.timers.register(enter_file, first_interval=1.0)


def enter_file():
    space = blender_gui.find_area("FILE_BROWSER").spaces.active
    if space.params is None:  # not drawn yet
        return 0.5
    space.params.asset_library_reference, space.show_region_toolbar = "LOCAL", False
    return None


def files(name):
    """What lies in a folder beside the state, however deep."""
    folder = f"{STATE}.{name}"
    return sorted(
        os.path.relpath(os.path.join(root, file), folder) for root, _, found in os.walk(folder) for file in found
    )


def brightness_of_preview(material):
    """Mean of the preview's middle."""
    width, height = material.preview.image_size
    pixels = np.empty(width * height * 4, np.float32)
    material.preview.image_pixels_float.foreach_get(pixels)
    pixels = pixels.reshape(height, width, 4)
    return float(pixels[height // 3 : -height // 3, width // 3 : -width // 3, :3].mean())


def rectangle(area_type, region_type):
    """x, y, width and height of a region in pixels of the screen, from its upper left corner; None without."""
    area = blender_gui.find_area(area_type)
    region = next((r for r in area.regions if r.type == region_type and r.height > 1), None) if area else None
    return (
        [region.x, blender_gui.window().height - region.y - region.height, region.width, region.height]
        if region
        else None
    )


def share(region):
    """Share of the region's mask that isn't black."""
    pixels = np.empty(len(region.mask.pixels), np.float32)
    region.mask.pixels.foreach_get(pixels)
    return float((pixels.reshape(-1, 4)[:, 0] > 0).mean())


def texture_names(material):
    return sorted(node.image.name for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeTexImage")


def pictures(material):
    return [node.image for node in material.node_tree.nodes if node.bl_idname == "ShaderNodeTexImage"]


def paste_is_offered():
    if blender_gui.find_area("IMAGE_EDITOR") is None:
        return None
    with editor():
        return bpy.ops.material_palette.paste_photo.poll()


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
    active = settings.palette[settings.active_material].material if settings.palette else None
    region = settings.regions[settings.active_region] if settings.active_region < len(settings.regions) else None
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
        "faces": [face.material_index for face in cube.data.polygons] if cube else None,
        "slots": [slot.material.name if slot.material else None for slot in cube.material_slots] if cube else None,
        "corners": list(region.corners) if region and region.has_corners else None,
        "measured": list(region.measured) if region and region.has_measure else None,
        "handle": handle,
        "size": list(settings.photo.size) if settings.photo else None,
        "resolution": settings.resolution,
        "widths": sorted({image.size[0] for image in pictures(active)}) if active else None,
        "brightness": active.material_palette.brightness if active else None,
        "card": list(settings.grey_card),
        "at_card": at_card,
        "card_place": " ".join(map(str, CARD)),
        "seen": brightness_of_preview(active) if active and active.preview else None,
        "pastes": paste_is_offered(),
        "browser": rectangle("FILE_BROWSER", "WINDOW"),
        "editor": rectangle("IMAGE_EDITOR", "WINDOW"),
        "sidebar": rectangle("VIEW_3D", "UI") or rectangle("IMAGE_EDITOR", "UI"),
        "view": rectangle("VIEW_3D", "WINDOW"),
        "shelf": rectangle("VIEW_3D", "ASSET_SHELF"),
        "library": files("library"),
        "exported": files("exported"),
        "engine": settings.engine,
        "modal": [operator.bl_idname for operator in blender_gui.window().modal_operators],
        "temporary": sorted(name for name in os.listdir(bpy.app.tempdir) if name.startswith("material_palette_")),
    }
    with open(STATE + ".part", "w", encoding="utf-8") as file:
        json.dump(state, file, ensure_ascii=False)
    os.replace(STATE + ".part", STATE)
    return 0.5


blender_gui.set_area("IMAGE_EDITOR")
blender_gui.show_tab("IMAGE_EDITOR", "Palette")
blender_gui.step(lambda: bpy.app.timers.register(report, persistent=True))
