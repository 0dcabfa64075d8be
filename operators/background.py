"""One run at a time on a background thread: what Auto Segment and Extract Palette share, and how a run is stopped."""

import time
from dataclasses import dataclass

import bpy
from bpy.app.handlers import persistent
from bpy.types import Operator

from ..core.errors import PaletteError, explain
from ..core.job import Job
from .setup import NeedsPackages, missing

_TICK = 0.1  # seconds between two looks at the queue
_REDRAW = 0.5  # seconds between two redraws: drawing takes the processor from the work
_LONGEST_STOP = 5.0  # seconds to wait for the thread when Blender can't go on without it


@dataclass
class _Run:
    job: Job
    operator: object
    scene_uid: int
    timer: object = None
    shown: float = 0.0


@dataclass(frozen=True)
class State:
    """What the interface shows. progress in [0, 1]; seconds_left is -1 while unknown."""

    running: bool = False
    progress: float = 0.0
    message: str = ""
    seconds_left: float = -1.0
    error: str = ""


_current = None
_error = ""


def state():
    if _current is None:
        return State(error=_error)
    job = _current.job
    left = job.seconds_left
    message = "Cancelling" if job.cancelling else job.message
    return State(True, job.fraction, message, -1.0 if left is None else left, "")


def time_left(seconds):
    """`seconds` as a person says it; empty while unknown (negative)."""
    return "" if seconds < 0 else f"{duration(seconds)} left"


def duration(seconds, brief=False):
    """`seconds` as a person says it; brief: in whole minutes from two on."""
    if seconds < (120 if brief else 60):
        return f"{max(1, round(seconds))} s"
    return f"{round(seconds / 60)} min" if brief else f"{int(seconds // 60)} min {int(seconds % 60):02d} s"


def cancel():
    """Ask the run to end; its operator cleans up."""
    if _current is not None:
        _current.job.cancel()


def stop():
    """End the run now and wait for it; afterwards no thread, timer, status text or file of it is left."""
    global _current
    if _current is None:
        return
    run, _current = _current, None
    run.job.abandon()
    run.job.join(_LONGEST_STOP)
    for event in run.job.events():
        if event[0] == "done":
            run.discard(event[1])
    _clear_interface(run)


def forget():
    """Drop what outlives a run: its error, and which packages were found."""
    global _error
    _error = ""
    missing.cache_clear()


@persistent
def stop_before_load(*_args):
    """Another file is coming: nothing of this run may end up in it."""
    stop()
    forget_error()


def forget_error():
    global _error
    _error = ""


class _Free:
    needs_photo = True

    @classmethod
    def poll(cls, context):
        sentence = "Material Palette is at work" if _current is not None else ""
        if not sentence and cls.needs_photo and context.scene.material_palette.photo is None:
            sentence = "Open a photo first"
        if sentence:
            cls.poll_message_set(sentence)
        return not sentence


class BackgroundOperator(NeedsPackages, _Free):
    """Mixin of an operator whose work runs on a `Job`.

    A subclass gives `prepare(context) -> work` (reads everything from bpy; `work(progress, send)` never touches it),
    `receive(context, scene, value)` (takes what the work sends on its way; must not raise), `finish(context, scene,
    result)` (writes to bpy, may raise PaletteError) and `discard(result)`, a static method that removes what a result
    that nobody wants has left on disk.
    """

    bl_options = {"REGISTER", "UNDO"}

    def receive(self, context, scene, value):
        pass

    @staticmethod
    def discard(result):
        pass

    def invoke(self, context, event):
        if bpy.app.background or context.window is None:
            return self.execute(context)
        if not self._start(context):
            return {"CANCELLED"}
        wm = context.window_manager
        _current.timer = wm.event_timer_add(_TICK, window=context.window)
        wm.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        if not self._start(context):
            return {"CANCELLED"}
        job = _current.job
        try:
            while not job.join(0.05):
                pass
        except BaseException:  # Ctrl-C in the terminal
            stop()
            raise
        return self._drain(context)

    def modal(self, context, event):
        # stopped by a new file or by disabling the extension
        if _current is None or _current.operator is not self:
            return {"CANCELLED"}
        if event.type == "ESC" and event.value == "PRESS" and not _over_file_browser(context, event):
            cancel()
            _current.shown = 0.0
            _show(context)
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        result = self._drain(context)
        if result is None:
            _show(context)
            return {"PASS_THROUGH"}
        return result

    def cancel(self, context):
        """Called by Blender when it takes the operator away: another file, a closed window, the end."""
        if _current is not None and _current.operator is self:
            stop()

    def _start(self, context):
        global _current, _error
        _error = ""
        try:
            work = self.prepare(context)
        except PaletteError as error:
            return self._fail(str(error))
        job = Job(work)
        _current = _Run(job, self, context.scene.session_uid)
        job.start()
        return True

    def _fail(self, message):
        global _error
        _error = message
        self.report({"ERROR"}, message)
        return False

    def _drain(self, context):
        """Take the events; return the operator's result once the work has ended, else None."""
        global _current
        for event in _current.job.events():
            if event[0] == "progress":
                continue
            if event[0] == "sent":
                scene = _scene(_current)
                if scene is not None:
                    self.receive(context, scene, event[1])
                    _current.shown = 0.0
                continue
            run, _current = _current, None
            run.job.join()
            _clear_interface(run)
            return self._end(context, run, *event)
        return None

    def _end(self, context, run, kind, value=None):
        if kind == "cancelled":
            self.report({"INFO"}, f"{self.bl_label}: cancelled")
            return {"CANCELLED"}
        if kind == "failed":
            self._fail(explain(value))
            return {"CANCELLED"}
        try:
            scene = _scene(run)
            if scene is None:
                raise PaletteError("The scene that this was for is gone; nothing was added")
            self.finish(context, scene, value)
        except PaletteError as error:
            self._fail(str(error))
            return {"CANCELLED"}
        finally:
            self.discard(value)
        return {"FINISHED"}


def _over_file_browser(context, event):
    """Whether the key is meant for a file browser, which Esc closes."""
    return any(
        area.type == "FILE_BROWSER"
        and 0 <= event.mouse_x - area.x < area.width
        and 0 <= event.mouse_y - area.y < area.height
        for area in context.window.screen.areas
    )


def _scene(run):
    """The scene that the run was started for: undo and renaming keep its number, another file never has it."""
    return next((scene for scene in bpy.data.scenes if scene.session_uid == run.scene_uid), None)


def _show(context):
    if time.monotonic() - _current.shown < _REDRAW:
        return
    _current.shown = time.monotonic()
    now = state()
    left = time_left(now.seconds_left)
    text = f"{now.message}   {now.progress:.0%}   {left}   Esc: cancel"
    for window in context.window_manager.windows:
        window.workspace.status_text_set(text)
        for area in window.screen.areas:
            if area.type in {"IMAGE_EDITOR", "VIEW_3D"}:
                for region in area.regions:
                    if region.type == "UI":
                        region.tag_redraw()


def _clear_interface(run):
    if run.timer is None:
        return
    wm = bpy.context.window_manager
    wm.event_timer_remove(run.timer)
    for workspace in bpy.data.workspaces:
        workspace.status_text_set(None)
    for window in wm.windows:
        for area in window.screen.areas:
            area.tag_redraw()


class MATERIAL_PALETTE_OT_cancel(Operator):
    """Stop what Material Palette is doing; the materials that are finished are kept"""

    bl_idname = "material_palette.cancel"
    bl_label = "Cancel"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context):
        return _current is not None

    def execute(self, context):
        cancel()
        return {"FINISHED"}


CLASSES = (MATERIAL_PALETTE_OT_cancel,)
