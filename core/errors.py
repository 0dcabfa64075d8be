"""The ways a run ends early."""

import traceback


class PaletteError(Exception):
    """Bad input or a limit reached; the message names the file or setting and the way out."""


class Cancelled(Exception):
    """The user asked to stop; raised by the progress callback, never shown as a failure."""


class Abandoned(Cancelled):
    """Whoever would take the result is gone: nothing is kept, not even what is finished."""


def explain(error: Exception) -> str:
    """What the user reads of an error. One that is no PaletteError is a mistake in the program: standard error gets its
    traceback."""
    if isinstance(error, PaletteError):
        return str(error)
    traceback.print_exception(error)
    return f"unexpected {type(error).__name__}: {error}. Please report it with what the terminal shows"
