"""What the list of regions shows of each: thumbnail, area and what is wrong with it. Worked out between redraws."""

import time
from dataclasses import dataclass

import bpy
import bpy.utils.previews
import numpy as np
from bpy.app.handlers import persistent

from ..core.errors import PaletteError
from .photo import photo_state, read_pixels
from .regions import read_photo_mask

_THUMBNAIL = 48  # px of the photo to either side: few enough for the texture to be seen
_QUIET = 0.4  # seconds without a change before a region is looked at again
_LOOKED_AT = 256  # px to either side of what is looked at to see whether a region is of one colour


@dataclass
class Examined:
    """icon: of the thumbnail, 0 for none; area: share of the photo; warning: empty when all is well."""

    icon: int = 0
    area: float = 0.0
    warning: str = ""


_known = {}  # session_uid of the mask image: Examined
_stale = {}  # the same: time of the last change
_seen_in = {}  # the same: state of the photo it was looked at in
_photos = {}  # state of the one photo: (H, W, 3) uint8 sRGB-encoded
_icons = None


def known(region):
    """What is known of a region by now, or None; what isn't, or may have changed, is found out soon."""
    if region.mask is None:
        return Examined(warning="It has no mask image: remove it, or import a mask")
    uid = region.mask.session_uid
    if uid not in _stale and (uid not in _known or _seen_in[uid] != photo_state(region.id_data.material_palette.photo)):
        changed(region.mask)
    return _known.get(uid)


def changed(mask):
    """A mask image may have changed: look at it once it keeps still."""
    if bpy.app.background:
        return
    _stale[mask.session_uid] = time.monotonic()
    if not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=0.1)


@persistent
def all_changed(*_args):
    """After undo or another file nothing is certain."""
    for uid in list(_known):
        _stale[uid] = 0.0
    if _stale and not bpy.app.background and not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=0.1)


def forget():
    global _icons
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)
    for memory in (_known, _stale, _seen_in, _photos):
        memory.clear()
    if _icons is not None:
        bpy.utils.previews.remove(_icons)
        _icons = None


def examine(settings, region):
    """Look at a region now: an Examined without icon, and its thumbnail, (h, w, 4) float32 sRGB-encoded, top row first,
    transparent outside of it, or None."""
    from ..core.exemplar import cut_exemplar
    from ..core.image import linear_from_srgb
    from ..core.region import Region, check_region

    try:
        pixels = _photo(settings.photo)
        mask = read_photo_mask(region, settings.photo)
    except PaletteError as error:
        return Examined(warning=str(error)), None
    examined, thumbnail = Examined(area=float(mask.mean())), None
    if mask.any():
        at, distance = _middle(mask)
        box = _square(at, min(_THUMBNAIL, max(8, distance)))
        thumbnail = np.concatenate([pixels[box] / np.float32(255), mask[box][..., None]], -1).astype(np.float32)
    try:
        check_region(Region(region.name, mask))
        box = _square(_middle(mask)[0], _LOOKED_AT)
        if cut_exemplar(linear_from_srgb(pixels[box] / np.float32(255)), mask[box]).uniform is not None:
            examined.warning = "One colour up to the photo's noise in its middle: its material may become a constant"
    except PaletteError as error:
        examined.warning = str(error)
    return examined, thumbnail


def _middle(mask):
    """Row and column of the region's innermost pixel, and its distance from the outline in px."""
    import cv2

    distance = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, cv2.DIST_MASK_3)[1:-1, 1:-1]
    at = np.unravel_index(distance.argmax(), distance.shape)
    return at, int(distance[at])


def _square(at, half):
    """What of the square around a pixel can lie in the photo."""
    return tuple(slice(max(0, i - half), i + half) for i in at)


def _photo(image):
    from ..core.image import srgb_from_linear

    key = photo_state(image)
    if key not in _photos:
        if image is None:
            raise PaletteError("Open a photo first")
        encoded = np.clip(srgb_from_linear(read_pixels(image)), 0, 1)
        _photos.clear()
        _photos[key] = np.round(encoded * 255).astype(np.uint8)
    return _photos[key]


def _look():
    """Timer: look at one region that has kept still, then redraw the sidebars."""
    from .setup import missing

    if missing():
        _stale.clear()
        return None
    now = time.monotonic()
    masks = {
        region.mask.session_uid: (scene.material_palette, region)
        for scene in bpy.data.scenes
        for region in scene.material_palette.regions
        if region.mask is not None
    }
    for uid in [uid for uid in _stale if uid not in masks]:
        del _stale[uid]
        _known.pop(uid, None)
        _seen_in.pop(uid, None)
    ready = [uid for uid, when in _stale.items() if now - when > _QUIET]
    if ready:
        uid = ready[0]
        del _stale[uid]
        _seen_in[uid] = photo_state(masks[uid][0].photo)
        _known[uid], thumbnail = examine(*masks[uid])
        _known[uid].icon = _icon(uid, thumbnail)
        redraw_sidebars()
    return 0.05 if _stale else None


def _icon(uid, thumbnail):
    global _icons
    if _icons is None:
        _icons = bpy.utils.previews.new()
    if thumbnail is None:
        return 0
    name = str(uid)
    slot = _icons[name] if name in _icons else _icons.new(name)
    upright = thumbnail[::-1].copy()
    upright[..., :3] *= upright[..., 3:]  # drawn as premultiplied
    side = max(upright.shape[:2])
    square = np.zeros((side, side, 4), np.float32)
    top, left = (side - upright.shape[0]) // 2, (side - upright.shape[1]) // 2
    square[top : top + upright.shape[0], left : left + upright.shape[1]] = upright
    slot.image_size = slot.icon_size = (side, side)
    slot.image_pixels_float.foreach_set(square.ravel())
    slot.icon_pixels_float.foreach_set(square.ravel())
    return slot.icon_id


def redraw_sidebars():
    """The sidebars only: drawing the editor itself says that its mask may have changed."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if area.type in {"IMAGE_EDITOR", "VIEW_3D"} and region.type == "UI":
                    region.tag_redraw()


CLASSES = ()
