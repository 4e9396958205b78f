"""Writing a file so that it is complete or not there, whatever happens meanwhile."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from napari_hmrf.errors import CANNOT_SAVE

_TEMPORARY = ".napari-hmrf-"
_ABANDONED_AFTER = 3600.0


def write_whole(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file beside its destination, read it back, and only then give it its name.

    A file that was there before survives until that moment, and its permissions are the new one's.

    Parameters
    ----------
    path : str or path-like
        Of a link, the file it points to is replaced. A FIFO or device is written into.
    content : bytes

    Raises
    ------
    OSError
        If the folder is missing or the file cannot be written; the message names the file.
    """
    target = Path(path)
    with _naming(target):
        if is_stream(target):
            target.write_bytes(content)
        else:
            _replace(Path(os.path.realpath(target)), content)


@contextmanager
def temporary_beside(path: str | os.PathLike[str], suffix: str) -> Iterator[Path]:
    """Give the name of a temporary file in the folder of a target, for libraries to write to.

    The folder for temporary files may be on another disk, which may be full. What is left of the
    file at the end is removed.

    Parameters
    ----------
    path : str or path-like
        Target, which is not touched.
    suffix : str
        By which the library chooses a format.

    Raises
    ------
    OSError
        If no file can be written there; the message names the target.
    """
    target = Path(os.path.realpath(path))
    file = target.with_name(f"{_TEMPORARY}{secrets.token_hex(8)}.tmp{suffix}")
    with _naming(Path(path)):
        _remove_abandoned(target.parent)
        with open(file, "xb", opener=_private):
            pass
    try:
        yield file
    finally:
        with suppress(OSError):
            file.unlink(missing_ok=True)


def raise_for_space(path: str | os.PathLike[str], size: int) -> None:
    """Raise the system's error if so many bytes cannot be written beside a target.

    Libraries that write files do not tell why they failed.

    Raises
    ------
    OSError
        Naming the target.
    """
    with temporary_beside(path, "") as file, _naming(Path(path)), open(file, "wb") as stream:
        piece = bytes(2**20)
        for _ in range(size // len(piece) + 1):
            stream.write(piece)
        stream.flush()
        os.fsync(stream.fileno())


@contextmanager
def _naming(target: Path) -> Iterator[None]:
    """Let errors of the system name the file that was to be written."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise type(error)(error.errno, f"{CANNOT_SAVE}{error.strerror}", str(target)) from error


def is_stream(path: str | os.PathLike[str]) -> bool:
    """Whether a path leads to a FIFO, a device or the like, which nothing may take the place of."""
    try:
        mode = os.stat(path).st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def _replace(target: Path, content: bytes) -> None:
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, "it is a folder")
    there = target.exists()
    if there and not os.access(target, os.W_OK):  # its folder would let it be replaced all the same
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    temporary = target.with_name(f"{_TEMPORARY}{secrets.token_hex(8)}.tmp")
    try:
        _remove_abandoned(target.parent)
        with open(temporary, "xb", opener=_private if there else None) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if temporary.read_bytes() != content:
            raise OSError(f"cannot save {target.name!r}: the disk did not keep what was written")
        if there:
            shutil.copymode(target, temporary)
        _rename(temporary, target)
        _sync_folder(target.parent)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _private(path: str, flags: int) -> int:
    """Open a file that only its owner can read, as the one that it will replace may be."""
    return os.open(path, flags, 0o600)


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
    for path in folder.glob(f"{_TEMPORARY}*.tmp*"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _ABANDONED_AFTER:
                path.unlink()
