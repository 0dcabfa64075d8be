"""Material Palette: tileable PBR materials from the regions of one photo.

Nothing of Blender, torch or OpenCV is imported with this module, so that the pipeline in `core` runs without Blender
and Blender can enable the extension before torch is there.
"""

_cli_command = None


def _run_command(argv):
    from .core.command import main

    return main(argv)


def register():
    global _cli_command
    import bpy

    from . import operators, panels, properties

    properties.register()
    operators.register()
    panels.register()
    _cli_command = bpy.utils.register_cli_command("material_palette", _run_command)


def unregister():
    global _cli_command
    import bpy

    from . import operators, panels, properties

    bpy.utils.unregister_cli_command(_cli_command)
    _cli_command = None
    panels.unregister()
    operators.unregister()
    properties.unregister()
