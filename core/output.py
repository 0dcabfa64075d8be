"""An output folder that is complete or as it was: made in a staging folder beside it and moved in at the end."""

import contextlib
import errno
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from .errors import PaletteError
from .region import GEOMETRY, PALETTE_FILES, file_name

MAPS = ("basecolor", "normal", "roughness", "height", "metallic")
DESKTOP_FILES = {".DS_Store", "Thumbs.db", "desktop.ini"}  # a file browser leaves them; the folder counts as empty
FULL = (errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC))
UNWRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS)


@contextlib.contextmanager
def staged(folder: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """Yield an empty staging folder whose content becomes that of `folder` when the body ends without an exception.

    On any exception, KeyboardInterrupt and Cancelled included, the staging folder is removed and `folder` is as it was.
    `folder` may be missing or empty. With `overwrite` it may hold a palette: the files that this palette owns are
    replaced, and every other file is kept.
    Raises PaletteError, before the body runs, for a folder that is a file, holds anything else or can't be written; and
    after it for a full disk, or for a file of the user's where one of the palette's would go.
    """
    target = Path(os.path.realpath(folder))
    owned = _owned_files(target, folder, overwrite)
    with contextlib.ExitStack() as undo:
        try:
            staging = _make_staging(target, undo)
        except OSError as error:
            raise _unwritable(folder, error) from None
        try:
            yield staging
            _move_in(staging, target, owned)
        except (OSError, RuntimeError) as error:  # Blender's writers raise RuntimeError with the system's words
            within = str(getattr(error, "filename", "")).startswith((str(staging), str(target)))
            if _is_full(error) or within and getattr(error, "errno", None) in UNWRITABLE:
                raise _unwritable(folder, error) from error
            raise
        undo.pop_all()
        shutil.rmtree(staging, ignore_errors=True)


def _is_full(error: Exception) -> bool:
    return getattr(error, "errno", None) in FULL or os.strerror(errno.ENOSPC) in str(error)


def _unwritable(folder: str | Path, error: Exception) -> PaletteError:
    if _is_full(error):
        return PaletteError(f"The disk of output folder '{folder}' is full; nothing was written. Free some space.")
    return PaletteError(
        f"Output folder '{folder}' can't be written: {error.strerror}. Name a folder where you may write."
    )


def _owned_files(target: Path, folder: str | Path, overwrite: bool) -> list[str]:
    """Paths, relative to the target, of the files that the palette in it owns; they may be missing by now."""
    try:
        entries = {entry.name for entry in os.scandir(target)} - DESKTOP_FILES
    except FileNotFoundError:
        return []
    except NotADirectoryError:
        raise PaletteError(f"Output '{folder}' is a file or lies in one. Name a folder.") from None
    except OSError as error:
        raise PaletteError(f"Output folder '{folder}' can't be read: {error.strerror}. Name another one.") from None
    if not entries:
        return []
    if not overwrite:
        raise PaletteError(
            f"Output folder '{folder}' isn't empty. Use --overwrite to replace a palette in it, or name another folder."
        )
    try:
        palette = json.loads((target / "palette.json").read_text(encoding="utf-8"))
        palette["version"]
        records = [(str(record["name"]), dict(record.get("maps") or {})) for record in palette["materials"]]
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        raise PaletteError(
            f"Output folder '{folder}' holds files but no palette of this extension (palette.json), so nothing "
            f"in it is overwritten. Name another folder."
        ) from None
    owned = [*PALETTE_FILES, f"masks/{GEOMETRY}"]
    for name, maps in records:
        name = file_name(name)
        owned += [f"masks/{name}.png", f"exemplars/{name}.png", f"{name}/{name}.json"]
        owned += [f"{name}/{name}_{kind}.png" for kind in MAPS]
        owned += [f"{name}/{name}_concept{suffix}" for suffix in (".json", ".safetensors")]
        for record in maps.values():
            listed = PurePosixPath(str(record.get("file", ""))) if isinstance(record, dict) else PurePosixPath()
            # palette.json may have been edited: only what lies straight in the material's folder can be its own
            if listed.parts[:1] == (name,) and len(listed.parts) == 2 and listed.name != "..":
                owned.append(str(listed))
    return list(dict.fromkeys(owned))


def _make_staging(target: Path, undo: contextlib.ExitStack) -> Path:
    """An empty folder on the target's filesystem; `undo` removes it and any parent made for it."""
    missing = [parent for parent in target.parents if not parent.exists()]
    for parent in reversed(missing):
        parent.mkdir()
        undo.callback(_remove_if_empty, parent)
    name = f".{target.name[:40]}.{uuid.uuid4().hex[:8]}"
    staging = target.parent / name
    if target.is_dir() and (target.is_mount() or not os.access(target.parent, os.W_OK)):
        staging = target / name  # a rename can't leave a filesystem, and a folder given alone may lie in a closed one
    staging.mkdir()
    undo.callback(shutil.rmtree, staging, ignore_errors=True)
    return staging


def _move_in(staging: Path, target: Path, owned: list[str]) -> None:
    """Replace the target's owned files by the staged ones, or leave it as it was."""
    if not target.exists():
        os.rename(staging, target)
        return
    old = staging.with_name(staging.name + ".old")
    files = sorted(path.relative_to(staging) for path in staging.rglob("*") if not path.is_dir())
    moves, made = [], []
    try:
        old.mkdir()
        made.append(old)
        # A mask of this run's name was most likely painted into masks/ for this run: it's replaced by what was read.
        staged_masks = [str(PurePosixPath(path)) for path in files if path.parts[0] == "masks"]
        for path in dict.fromkeys([*owned, *staged_masks]):
            if os.path.lexists(target / path) and not (target / path).is_dir():
                _move(target / path, old / path, moves, made)
        for path in files:
            if os.path.lexists(target / path) or any((target / parent).is_file() for parent in path.parents):
                raise PaletteError(
                    f"'{target / path}' is in the way and was not made by the palette there. Move it or name another "
                    f"output folder."
                )
            _move(staging / path, target / path, moves, made)
    except BaseException:
        for source, destination in reversed(moves):
            if os.path.lexists(destination) and not os.path.lexists(source):
                os.rename(destination, source)
        for path in reversed(made):
            _remove_if_empty(path)
        raise
    shutil.rmtree(old, ignore_errors=True)
    for path in {Path(path).parent for path in owned} - {Path()}:
        _remove_if_empty(target / path)


def _move(source: Path, destination: Path, moves: list[tuple[Path, Path]], made: list[Path]) -> None:
    """Rename a file, noting it and the folders made for it, each before it is done."""
    for parent in reversed([parent for parent in destination.parents if not parent.exists()]):
        made.append(parent)
        parent.mkdir()
    moves.append((source, destination))
    os.rename(source, destination)


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()
