"""One file per verb of the user."""

import bpy

from . import (
    assign,
    background,
    draw_region,
    edit_region,
    examine,
    exemplar,
    export,
    extract,
    fit,
    history,
    palette,
    photo,
    pick,
    preferences,
    preview,
    rectify,
    regions,
    segment,
    setup,
)

_MODULES = (
    setup,
    photo,
    regions,
    edit_region,
    draw_region,
    pick,
    rectify,
    background,
    segment,
    extract,
    exemplar,
    palette,
    assign,
    fit,
    export,
    preferences,
)
_HANDLERS = (
    ("load_pre", background.stop_before_load),
    ("load_post", examine.all_changed),
    ("undo_post", examine.all_changed),
    ("redo_post", examine.all_changed),
    ("save_pre", regions.pack_masks_before_save),
)


def register():
    for module in _MODULES:
        for cls in module.CLASSES:
            bpy.utils.register_class(cls)
    for name, function in _HANDLERS:
        getattr(bpy.app.handlers, name).append(function)


def unregister():
    background.stop()
    for module in (background, history, examine, preview, pick, draw_region):
        module.forget()
    for name, function in _HANDLERS:
        getattr(bpy.app.handlers, name).remove(function)
    for module in reversed(_MODULES):
        for cls in reversed(module.CLASSES):
            bpy.utils.unregister_class(cls)
