"""The sidebar tab "Palette" of the Image Editor and the 3D View, menus, a shelf of materials, and the regions over the
photo."""

from . import menus, overlay, shelf, sidebar

_MODULES = (sidebar, menus, shelf, overlay)


def register():
    for module in _MODULES:
        module.register()


def unregister():
    for module in reversed(_MODULES):
        module.unregister()
