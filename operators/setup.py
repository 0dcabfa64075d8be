"""Set up: how to get the Python packages that are missing."""

import functools

from bpy.types import Operator

from ..core import dependencies


@functools.cache
def missing():
    """The missing packages as a tuple, looked up once: panels ask on every redraw."""
    return tuple(dependencies.missing())


def missing_sentence():
    """Say what is missing and where to find out how to get it; empty when nothing is."""
    if not missing():
        return ""
    names = ", ".join(entry.module for entry in missing())
    return f"Missing in this Blender: {names}. The Palette tab says how to get it"


class NeedsPackages:
    """Mixin, before others with a `poll`: the packages have to be there."""

    @classmethod
    def poll(cls, context):
        if missing_sentence():
            cls.poll_message_set(missing_sentence())
            return False
        return super().poll(context) if hasattr(super(), "poll") else True


class MATERIAL_PALETTE_OT_copy_install_command(Operator):
    """Copy the command that installs the missing packages into Blender's Python, to be run in a terminal"""

    bl_idname = "material_palette.copy_install_command"
    bl_label = "Copy Install Command"
    bl_options = {"REGISTER"}

    @classmethod
    def poll(cls, context):
        if missing():
            return True
        cls.poll_message_set("Nothing is missing")
        return False

    def execute(self, context):
        command = dependencies.install_command(missing())
        context.window_manager.clipboard = command
        self.report({"INFO"}, f"Copied: {command}")
        return {"FINISHED"}


CLASSES = (MATERIAL_PALETTE_OT_copy_install_command,)
