"""Runs inside Blender's window: how often it redraws while idle, and while a palette is extracted.

A draw handler counts; a timer asks for the next redraw as soon as Blender is free, as a user's mouse would. Written to
PALETTE_STATE as JSON: redraws per second, longest gap in seconds, of both.
"""

import json
import os
import time

import blender_gui
import bpy

STATE = os.environ["PALETTE_STATE"]
SECONDS = 15
times = []


def area():
    return blender_gui.find_area("VIEW_3D")


def on_draw():
    times.append(time.monotonic())


def measured():
    gaps = [b - a for a, b in zip(times, times[1:], strict=False)]
    return {"per_second": len(gaps) / (times[-1] - times[0]), "longest_gap": max(gaps)}


def story():
    bpy.types.SpaceView3D.draw_handler_add(on_draw, (), "WINDOW", "POST_PIXEL")
    result = {}
    yield from redraw(3)  # shaders are compiled
    times.clear()
    yield from redraw(SECONDS)
    result["idle"] = measured()
    region = next(r for r in area().regions if r.type == "WINDOW")
    with bpy.context.temp_override(window=blender_gui.window(), area=area(), region=region):
        bpy.ops.material_palette.open_photo(filepath=os.environ["PALETTE_PHOTO"])
        bpy.ops.material_palette.import_masks(directory=os.environ["PALETTE_MASKS"])
        settings = bpy.context.scene.material_palette
        settings.quality, settings.resolution = "best", 1024
        assert bpy.ops.material_palette.extract("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    run = bpy.context.window_manager.material_palette_run
    while run.progress <= 0.02:  # torch is imported, the engine at work
        area().tag_redraw()
        yield
    times.clear()
    yield from redraw(SECONDS)
    assert run.running, run.error
    result["extracting"] = measured() | {"progress": run.progress}
    bpy.ops.material_palette.cancel()
    while run.running:
        yield
    write(result | {"error": None})


def redraw(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        area().tag_redraw()
        yield


def write(result):
    with open(STATE + ".part", "w", encoding="utf-8") as file:
        json.dump(result, file)
    os.replace(STATE + ".part", STATE)


def play(scene=story()):  # noqa: B008, one story per run of the script
    try:
        next(scene)
        return 0.001
    except StopIteration:
        pass
    except Exception as error:
        write({"error": repr(error)})
    return None


blender_gui.step(lambda: bpy.app.timers.register(play, persistent=True))
