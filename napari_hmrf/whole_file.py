"""Writing a file so that it is complete or not there, whatever happens meanwhile."""

from __future__ import annotations

import os
import secrets
import time
from contextlib import suppress
from pathlib import Path

_TEMPORARY = ".napari-hmrf-"
_ABANDONED_AFTER = 3600.0


def write_whole(target: Path, content: bytes) -> None:
    """Write a file beside its destination, read it back, and only then give it its name.

    A file that was there before survives until that moment.

    Parameters
    ----------
    target : Path
        The file itself, not a link or a folder.
    content : bytes

    Raises
    ------
    OSError
        If the folder is missing or the file cannot be written; the message names the file.
    """
    temporary = target.with_name(f"{_TEMPORARY}{secrets.token_hex(8)}.tmp")
    try:
        _remove_abandoned(target.parent)
        with open(temporary, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if temporary.read_bytes() != content:
            raise OSError(f"cannot save {target.name!r}: the disk did not keep what was written")
        _rename(temporary, target)
        _sync_folder(target.parent)
    except OSError as error:
        if error.errno is None:
            raise
        raise type(error)(
            error.errno, f"cannot save the result: {error.strerror}", str(target)
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _rename(temporary: Path, target: Path) -> None:
    """Replace in one step; on Windows whoever has the old file open makes that fail for a while."""
    for attempt in range(6):
        try:
            os.replace(temporary, target)
            return
        except PermissionError:
            if attempt == 5:
                raise
            time.sleep(0.1)


def _sync_folder(folder: Path) -> None:
    """Have the new name itself on disk, where the system knows how."""
    if os.name != "posix":
        return
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _remove_abandoned(folder: Path) -> None:
    """Remove what a process that was killed while saving left behind."""
    for path in folder.glob(f"{_TEMPORARY}*.tmp"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _ABANDONED_AFTER:
                path.unlink()
