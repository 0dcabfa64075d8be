"""Runs inside Blender's window: a run while the user undoes, renders, saves, opens another file, disables the extension
or quits.

Environment: PALETTE_PHOTO, PALETTE_MASKS, PALETTE_STATE (JSON, written at the end: "error" is null or a traceback).
"""

import json
import os
import threading
import time
import traceback

import blender_gui
import bpy

NAME = "bl_ext.user_default.material_palette"
STATE = os.environ["PALETTE_STATE"]
PATIENCE = float(os.environ.get("PALETTE_PATIENCE", "1"))


def in_view():
    area = blender_gui.find_area("VIEW_3D")
    return bpy.context.temp_override(
        window=blender_gui.window(), area=area, region=next(r for r in area.regions if r.type == "WINDOW")
    )


def run():
    return bpy.context.window_manager.material_palette_run


def begin():
    """Open the example, begin to extract it and wait until the work is on its way."""
    with in_view():
        bpy.ops.material_palette.open_photo(filepath=os.environ["PALETTE_PHOTO"])
        bpy.ops.material_palette.import_masks(directory=os.environ["PALETTE_MASKS"])
        settings = bpy.context.scene.material_palette
        settings.quality, settings.resolution = "draft", 64
        for region in list(settings.regions)[:-1]:  # the wall; the pavement is of one colour and made at once
            region.enabled = False
        bpy.ops.ed.undo_push(message="Set up")
        bpy.data.objects["Cube"].location.x = 1.0
        bpy.ops.ed.undo_push(message="Move")
        assert bpy.ops.material_palette.extract("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from wait(lambda: run().progress > 0, 240)


def names():
    return [entry.material.name for entry in bpy.context.scene.material_palette.palette]


def wait(condition, seconds):
    end = time.monotonic() + seconds * PATIENCE
    while not condition():
        assert time.monotonic() < end, "too late"
        yield


def pause(seconds):
    end = time.monotonic() + seconds
    yield from wait(lambda: time.monotonic() > end, seconds + 60)


def assert_nothing_left():
    assert not [thread for thread in threading.enumerate() if thread.name == "material_palette"]
    assert not [name for name in os.listdir(bpy.app.tempdir) if name.startswith("material_palette_")]


def story():
    yield from begin()
    before = len(bpy.data.materials)
    with in_view():
        bpy.ops.ed.undo()
    assert bpy.data.objects["Cube"].location.x == 0.0
    assert run().running
    yield from wait(lambda: not run().running, 300)
    assert run().error == ""
    assert len(bpy.data.materials) == before + 1
    assert len(bpy.context.scene.material_palette.palette) == 1
    assert_nothing_left()

    yield from begin()
    scene = bpy.context.scene
    scene.render.engine, scene.render.resolution_percentage = "BLENDER_WORKBENCH", 5
    with in_view():
        assert bpy.ops.render.render() == {"FINISHED"}
        bpy.ops.wm.save_as_mainfile(filepath=STATE + ".blend")
    saved = names()
    assert run().running
    yield from wait(lambda: not run().running, 300)
    assert run().error == "" and len(scene.material_palette.palette) == 1
    assert_nothing_left()

    # a render that goes on in the background while materials are put into the file; the clicks outside end it
    yield from begin()
    scene.render.engine, scene.render.resolution_percentage = "CYCLES", 10
    scene.cycles.samples, scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising = 2**20, False, False
    bpy.context.preferences.view.render_display_type = "NONE"
    with in_view():
        assert bpy.ops.render.render("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    yield from wait(lambda: not run().running, 300)
    assert run().error == "" and len(scene.material_palette.palette) == 1
    assert bpy.app.is_job_running("RENDER")
    open(STATE + ".esc", "w").close()
    yield from wait(lambda: not bpy.app.is_job_running("RENDER"), 60)
    os.remove(STATE + ".esc")
    assert_nothing_left()

    yield from begin()
    bpy.ops.wm.open_mainfile(filepath=STATE + ".blend")
    yield from pause(1)
    assert not run().running and names() == saved
    assert_nothing_left()

    yield from begin()
    bpy.ops.wm.read_homefile(app_template="")
    yield
    assert not run().running
    assert not bpy.context.scene.material_palette.palette
    assert_nothing_left()

    yield from begin()
    bpy.ops.preferences.addon_disable(module=NAME)
    yield
    assert not hasattr(bpy.types.Scene, "material_palette")
    assert_nothing_left()
    before = len(bpy.data.materials)
    bpy.ops.preferences.addon_enable(module=NAME)
    yield from pause(3)
    assert not run().running
    assert len(bpy.data.materials) == before

    # and after all that it still works
    yield from begin()
    yield from wait(lambda: not run().running, 300)
    assert len(bpy.context.scene.material_palette.palette) == 1

    # at last the end of Blender itself; the clicks outside look at how it ended
    yield from begin()
    write(None)
    yield from pause(1)
    assert run().running
    bpy.ops.wm.quit_blender()
    while True:  # it ends when it comes round to it
        yield


def play(scene=story()):  # noqa: B008, one story per run of the script
    try:
        next(scene)
        return 0.2
    except Exception:
        write(traceback.format_exc())
    return None


def write(error):
    with open(STATE + ".part", "w", encoding="utf-8") as file:
        json.dump({"error": error, "temporary": bpy.app.tempdir}, file)
    os.replace(STATE + ".part", STATE)


blender_gui.show_tab("VIEW_3D", "Palette")
blender_gui.step(lambda: bpy.app.timers.register(play, persistent=True))
