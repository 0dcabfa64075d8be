"""The sidebar tab "Palette" of the Image Editor and the 3D View, and the regions drawn over the photo."""

from . import overlay, sidebar


def register():
    sidebar.register()
    overlay.register()


def unregister():
    overlay.unregister()
    sidebar.unregister()
