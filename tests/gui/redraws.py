"""Runs inside Blender's window: how often it redraws and is free to, idle and while extracting, and our share of that.

The Image Editor shows the photo with three regions and the tab Palette. Redraws: a draw handler counts; a timer asks
for the next redraw as soon as Blender is free, as a user's mouse would. With software graphics that is how long drawing
takes. Turns: the same timer without drawing, how often Blender comes round to what waits for it. Ours: wall
milliseconds of the main thread, median and 99th percentile, in the overlay, in all panels of a redraw, in both, and in
one call of our timers and of the running operator; `cpu` the processor's alone. Written to PALETTE_STATE as JSON.
"""

import json
import os
import statistics
import sys
import time

import blender_gui
import bpy

STATE = os.environ["PALETTE_STATE"]
NAME = "bl_ext.user_default.material_palette."
SECONDS = 10
times = []  # of the redraws or turns that are counted
spent = {"overlay": [], "panels": [], "redraw": [], "tick": []}  # (wall, processor) ms
panels = []  # of the redraw that goes on
drawing = True


def timed(function, then):
    """`function`, with what each call takes given to `then`."""

    def run(*arguments):
        wall, processor = time.perf_counter(), time.thread_time()
        try:
            return function(*arguments)
        finally:
            then((1e3 * (time.perf_counter() - wall), 1e3 * (time.thread_time() - processor)))

    return run


def method(draw):
    """Blender gives a method as many arguments as it names."""
    return lambda self, context: draw(self, context)


def total(parts):
    return tuple(sum(part[i] for part in parts) for i in (0, 1))


def on_overlay(milliseconds):
    """The end of a redraw: the sidebar's panels were drawn before it or will be with the next."""
    if drawing:
        times.append(time.monotonic())
        spent["overlay"].append(milliseconds)
        spent["panels"].append(total(panels))
        spent["redraw"].append(total([milliseconds, *panels]))
    panels.clear()


def watch():
    """Put our functions under the clock."""
    overlay, sidebar = sys.modules[NAME + "panels.overlay"], sys.modules[NAME + "panels.sidebar"]
    bpy.types.SpaceImageEditor.draw_handler_remove(overlay._handle, "WINDOW")
    draw = timed(overlay._draw, on_overlay)
    overlay._handle = bpy.types.SpaceImageEditor.draw_handler_add(draw, (), "WINDOW", "POST_PIXEL")
    for section in sidebar._SECTIONS:
        section.draw = method(timed(section.draw, panels.append))
    operator = sys.modules[NAME + "operators.background"].BackgroundOperator
    modal = timed(operator.modal, spent["tick"].append)
    operator.modal = lambda self, context, event: modal(self, context, event)
    for module, name in (("examine", "_look"), ("preview", "_draw")):
        module = sys.modules[NAME + "operators." + module]
        setattr(module, name, timed(getattr(module, name), spent["tick"].append))


def area():
    return blender_gui.find_area("IMAGE_EDITOR")


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
    gaps = sorted(b - a for a, b in zip(times, times[1:], strict=False))
    return {
        "per_second": round(len(gaps) / (times[-1] - times[0]), 1),
        "gap_99": round(gaps[int(0.99 * len(gaps))], 4),
        "gaps_over_50_ms": sum(gap > 0.05 for gap in gaps),
        "longest_gap": round(gaps[-1], 3),
    }


def ours():
    """What was spent since the last time."""
    said = {}
    for kind, calls in spent.items():
        for name, index in (("wall", 0), ("cpu", 1)):
            values = sorted(call[index] for call in calls)
            if values:
                high = values[min(len(values) - 1, round(0.99 * len(values)))]
                said[f"{kind} {name}"] = [round(statistics.median(values), 2), round(high, 2), len(values)]
        calls.clear()
    return said


def story():
    region = next(r for r in area().regions if r.type == "WINDOW")
    with bpy.context.temp_override(window=blender_gui.window(), area=area(), region=region):
        bpy.ops.material_palette.open_photo(filepath=os.environ["PALETTE_PHOTO"])
        bpy.ops.material_palette.import_masks(directory=os.environ["PALETTE_MASKS"])
        bpy.ops.image.view_all(fit_view=True)
    watch()
    result = {}
    yield from measured(5, draw=True)  # shaders are compiled, regions looked at
    ours()
    result["idle"] = {
        "redraws": (yield from measured(SECONDS, True)),
        "turns": (yield from measured(SECONDS, False)),
        "ours": ours(),
    }
    bpy.context.scene.material_palette.show_regions = False
    result["idle, regions hidden"] = {"redraws": (yield from measured(SECONDS, True)), "ours": ours()}
    bpy.context.scene.material_palette.show_regions = True
    with bpy.context.temp_override(window=blender_gui.window(), area=area(), region=region):
        settings = bpy.context.scene.material_palette
        settings.quality, settings.resolution = "best", 1024
        assert bpy.ops.material_palette.extract("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    run = bpy.context.window_manager.material_palette_run
    while run.progress <= 0.02:  # torch is imported, the engine at work
        area().tag_redraw()
        yield
    ours()
    result["extracting"] = {
        "redraws": (yield from measured(SECONDS, True)),
        "turns": (yield from measured(SECONDS, False)),
        "ours": ours(),
    }
    background = sys.modules[NAME + "operators.background"]
    background._REDRAW = 1e9
    result["extracting, progress not drawn"] = {"turns": (yield from measured(SECONDS, False))}
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


blender_gui.set_area("IMAGE_EDITOR")
blender_gui.show_tab("IMAGE_EDITOR", "Palette")
blender_gui.step(lambda: bpy.app.timers.register(play, persistent=True))
