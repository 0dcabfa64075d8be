"""The sidebar tab "Palette" of the Image Editor and the 3D View, menus, and the regions drawn over the photo."""

from . import menus, overlay, sidebar

_MODULES = (sidebar, menus, overlay)


def register():
    for module in _MODULES:
        module.register()


def unregister():
    for module in reversed(_MODULES):
        module.unregister()
