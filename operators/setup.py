"""Set up: how to get the Python packages that are missing."""

import functools

from bpy.props import StringProperty
from bpy.types import Operator

from ..core import dependencies


@functools.cache
def missing(entries=dependencies.REQUIRED):
    """Those of `entries` that are missing, as a tuple, looked up once: panels ask on every redraw."""
    return tuple(dependencies.missing(entries))


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

    modules: StringProperty(
        name="Packages", description="Their names; else those that nothing works without", options={"SKIP_SAVE"}
    )

    def execute(self, context):
        named = [entry for entry in dependencies.ALL if entry.module in self.modules.split()]
        lacking = missing(tuple(named)) if named else missing()
        if not lacking:
            self.report({"INFO"}, "Nothing is missing")
            return {"CANCELLED"}
        command = dependencies.install_command(lacking)
        context.window_manager.clipboard = command
        self.report({"INFO"}, f"Copied: {command}")
        return {"FINISHED"}


CLASSES = (MATERIAL_PALETTE_OT_copy_install_command,)
