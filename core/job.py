"""Job: one long function on a background thread, its events in a queue, its end on demand.

The thread gets two callbacks and touches nothing else of the caller; whoever owns the job drains `events()` from its
own thread. Cancelling is cooperative: the next call of `progress` or `send` raises `Cancelled` inside the work.
"""

import contextlib
import os
import queue
import sys
import threading
import time

from .errors import Abandoned, Cancelled

# A forecast from less than this is noise.
_LEAST_SECONDS = 1.0
_LEAST_FRACTION = 0.02
_NICE = 5  # steps of priority that the work stands behind the window


def _step_back():
    """Let the window go first: on Linux a thread, with those that it starts, has a priority of its own."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + _NICE)


class Job:
    """Run `work(progress, send) -> result` on a thread.

    progress(fraction, message): fraction in [0, 1]. send(value): hands an intermediate value to the owner.
    Events, in order of arrival: ("progress", fraction, message), ("sent", value), and at last exactly one of
    ("done", result), ("failed", exception), ("cancelled",). Work that ends before it notices a cancel is "done".
    """

    def __init__(self, work):
        self._work = work
        self._events = queue.SimpleQueue()
        self._cancel = threading.Event()
        self._abandoned = False
        self._thread = threading.Thread(target=self._run, name="material_palette", daemon=True)
        self._started = None
        self.fraction = 0.0
        self.message = ""

    def start(self):
        self._started = time.monotonic()
        self._thread.start()

    def cancel(self):
        self._cancel.set()

    def abandon(self):
        """Cancel, and tell the work that nobody will take what it has finished."""
        self._abandoned = True
        self._cancel.set()

    @property
    def cancelling(self):
        return self._cancel.is_set()

    @property
    def running(self):
        return self._thread.is_alive()

    def join(self, timeout=None):
        """Wait for the thread; return whether it has ended."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def events(self):
        """Yield the events that have arrived, without waiting."""
        while True:
            try:
                yield self._events.get_nowait()
            except queue.Empty:
                return

    @property
    def seconds_left(self):
        """Seconds until the end at the pace so far, or None while that can't be told."""
        if self._started is None:
            return None
        elapsed = time.monotonic() - self._started
        if elapsed < _LEAST_SECONDS or self.fraction < _LEAST_FRACTION:
            return None
        return elapsed * (1.0 - self.fraction) / self.fraction

    def _run(self):
        _step_back()
        try:
            result = self._work(self._progress, self._send)
        except Cancelled:
            self._events.put(("cancelled",))
        except BaseException as error:  # SystemExit in a thread would be swallowed and the owner wait for ever
            self._events.put(("failed", error))
        else:
            self._events.put(("done", result))

    def _progress(self, fraction, message):
        self._stop_if_cancelled()
        self.fraction, self.message = min(max(float(fraction), 0.0), 1.0), message
        self._events.put(("progress", self.fraction, message))

    def _send(self, value):
        self._stop_if_cancelled()
        self._events.put(("sent", value))

    def _stop_if_cancelled(self):
        if self._cancel.is_set():
            raise Abandoned if self._abandoned else Cancelled
