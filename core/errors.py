"""The ways a run ends early."""


class PaletteError(Exception):
    """Bad input or a limit reached; the message names the file or setting and the way out."""


class Cancelled(Exception):
    """The user asked to stop; raised by the progress callback, never shown as a failure."""


class Abandoned(Cancelled):
    """Whoever would take the result is gone: nothing is kept, not even what is finished."""
