"""Runs inside Blender's window: how often it redraws, and how often it is free to, idle and while extracting.

Redraws: a draw handler counts; a timer asks for the next redraw as soon as Blender is free, as a user's mouse would.
With software graphics that is how long drawing takes. Turns: the same timer without drawing, how often Blender comes
round to what waits for it. Written to PALETTE_STATE as JSON: per second, and the longest gap in seconds.
"""

import json
import os
import time

import blender_gui
import bpy

STATE = os.environ["PALETTE_STATE"]
SECONDS = 10
times = []
drawing = True


def area():
    return blender_gui.find_area("VIEW_3D")


def on_draw():
    if drawing:
        times.append(time.monotonic())


def measured(seconds, draw):
    """Let a generator's result be what was counted for so many seconds."""
    global drawing
    drawing = draw
    times.clear()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if draw:
            area().tag_redraw()
        else:
            times.append(time.monotonic())
        yield
    gaps = [b - a for a, b in zip(times, times[1:], strict=False)]
    return {"per_second": round(len(gaps) / (times[-1] - times[0]), 1), "longest_gap": round(max(gaps), 3)}


def story():
    bpy.types.SpaceView3D.draw_handler_add(on_draw, (), "WINDOW", "POST_PIXEL")
    result = {}
    yield from measured(3, draw=True)  # shaders are compiled
    result["idle"] = {"redraws": (yield from measured(SECONDS, True)), "turns": (yield from measured(SECONDS, False))}
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
    result["extracting"] = {
        "redraws": (yield from measured(SECONDS, True)),
        "turns": (yield from measured(SECONDS, False)),
    }
    assert run.running, run.error
    bpy.ops.material_palette.cancel()
    while run.running:
        yield
    write(result | {"error": None})


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
