"""Preview: the picture of a material follows what the artist adjusts on it, once the sliders keep still."""

import threading
import time

import bpy
import numpy as np

from ..core.errors import PaletteError
from ..core.nodes import Controls, preview_is_of, set_preview
from .examine import redraw_sidebars
from .export import adjuster
from .setup import missing

_QUIET = 0.3  # seconds without a change before a preview is drawn anew
_SIDE = 512  # px: longer side of the maps that it is drawn from

_stale = {}  # session_uid of the material: its look, and when that was first seen
_running = None  # of the one that is being drawn: session_uid, look, thread, list for the picture


def follow(material):
    """A panel shows `material`: should its preview be of something else by now, it is drawn anew soon."""
    if bpy.app.background or missing() or not material.is_editable or not Controls(material):
        return
    look = Controls(material).look()
    if preview_is_of(material, look):
        return
    if _stale.get(material.session_uid, (None,))[0] != look:
        _stale[material.session_uid] = look, time.monotonic()
    if not bpy.app.timers.is_registered(_draw):
        bpy.app.timers.register(_draw, first_interval=0.1)


def forget():
    global _running
    if bpy.app.timers.is_registered(_draw):
        bpy.app.timers.unregister(_draw)
    _stale.clear()
    _running = None


def painter(material):
    """A function without bpy that draws `material` as adjusted, (256, 256, 4) float32 sRGB-encoded RGBA.

    Raises PaletteError for a material that isn't ours or has lost a texture.
    """
    adjust, metres = adjuster(material, _SIDE, height=False), material.get("metres_per_tile", 1.0)

    def paint():
        from ..core.brdf import render_sphere
        from ..core.image import srgb_from_linear
        from ..core.material import SVBRDF

        maps, tile_size, rotation, _relief = adjust()
        tiles = 2.0 * metres / tile_size if tile_size else 2.0
        normal = maps["normal"] if maps["normal"] is not None else np.array([0, 0, 1], np.float32)
        svbrdf = SVBRDF(maps["basecolor"], normal, maps["roughness"], metallic=maps["metallic"])
        sphere = render_sphere(svbrdf, tiles=min(max(tiles, 0.1), 32.0), rotation=rotation)
        return np.concatenate([srgb_from_linear(sphere[..., :3]), sphere[..., 3:]], -1)

    return paint


def _draw():
    """Timer: draw one preview at a time, on a thread, for torch takes seconds to import the first time."""
    global _running
    if _running is not None:
        uid, look, thread, picture = _running
        if thread.is_alive():
            return 0.05
        _running = None
        material = _material(uid)
        if material is not None and Controls(material) and Controls(material).look() == look:
            set_preview(material, picture[0] if picture else None)
            redraw_sidebars()
    ready = [uid for uid, (_look, since) in _stale.items() if time.monotonic() - since > _QUIET]
    if ready:
        look, _since = _stale.pop(ready[0])
        material = _material(ready[0])
        if material is not None and Controls(material):
            _running = ready[0], look, *_begin(material)
    return 0.05 if _stale or _running else None


def _begin(material):
    picture = []
    try:
        paint = painter(material)
    except PaletteError:  # what can't be drawn keeps the picture it has
        paint = None

    def work():
        import torch

        torch.set_num_threads(1)
        picture.append(paint())

    thread = threading.Thread(target=work if paint else lambda: None, name="material_palette_preview", daemon=True)
    thread.start()
    return thread, picture


def _material(uid):
    return next((material for material in bpy.data.materials if material.session_uid == uid), None)


CLASSES = ()
