"""One file per verb of the user."""

import bpy

from . import assign, background, extract, history, palette, photo, regions, segment, setup

_MODULES = (setup, photo, regions, background, segment, extract, palette, assign)


def register():
    for module in _MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
    bpy.app.handlers.load_pre.append(background.stop_before_load)
    bpy.app.handlers.save_pre.append(regions.pack_masks_before_save)


def unregister():
    background.stop()
    background.forget()
    history.forget()
    bpy.app.handlers.save_pre.remove(regions.pack_masks_before_save)
    bpy.app.handlers.load_pre.remove(background.stop_before_load)
    for module in reversed(_MODULES):
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
