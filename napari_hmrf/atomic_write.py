"""Atomic writing of files: after a crash, a file is either complete or unchanged."""

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

#: Prefix of the names of temporary files.
_TEMPORARY = ".napari-hmrf-"
#: Age, in seconds, above which a temporary file is assumed to belong to a killed process.
_ABANDONED_AFTER = 3600.0


def write_whole(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file atomically.

    The content is written to a temporary file in the same folder and read back. The temporary file
    then replaces the target file; the permissions of an existing target file are preserved.

    Parameters
    ----------
    path : str or path-like
        Path of the file. Symbolic links are followed. FIFOs and devices are written to directly.
    content : bytes

    Raises
    ------
    OSError
        If the folder does not exist or the file cannot be written; the message names the file.
    """
    target = Path(path)
    with _naming(target):
        if is_stream(target):
            target.write_bytes(content)
        else:
            _replace(Path(os.path.realpath(target)), content)


@contextmanager
def temporary_beside(path: str | os.PathLike[str], suffix: str) -> Iterator[Path]:
    """Create a temporary file in the same folder as a target file, and yield its path.

    A library can write to the temporary file. The file is in the target's folder because the
    system's folder for temporary files may be on another disk, which may be full. It is removed at
    the end of the context if it still exists.

    Parameters
    ----------
    path : str or path-like
        Path of the target file, which is not modified.
    suffix : str
        Suffix of the temporary file, from which the library derives the file format.

    Raises
    ------
    OSError
        If the folder is not writable; the message names the target file.
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
    """Raise the operating system's error if there is not enough disk space for a target file.

    Libraries often do not report why writing a file has failed.

    Parameters
    ----------
    path : str or path-like
        Path of the target file, which is not modified.
    size : int
        Number of bytes to write to a temporary file as a test.

    Raises
    ------
    OSError
        If the bytes cannot be written; the message names the target file.
    """
    with temporary_beside(path, "") as file, _naming(Path(path)), open(file, "wb") as stream:
        piece = bytes(2**20)
        for _ in range(size // len(piece) + 1):
            stream.write(piece)
        stream.flush()
        os.fsync(stream.fileno())


@contextmanager
def _naming(target: Path) -> Iterator[None]:
    """Return a context manager that adds the target file to the messages of system errors."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise type(error)(error.errno, f"{CANNOT_SAVE}{error.strerror}", str(target)) from error


def is_stream(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a FIFO, socket or device, which must not be replaced."""
    try:
        mode = os.stat(path).st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def _replace(target: Path, content: bytes) -> None:
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, "it is a folder")
    exists = target.exists()
    # In a writable folder, renaming would replace even a read-only file.
    if exists and not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    temporary = target.with_name(f"{_TEMPORARY}{secrets.token_hex(8)}.tmp")
    try:
        _remove_abandoned(target.parent)
        with open(temporary, "xb", opener=_private if exists else None) as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if temporary.read_bytes() != content:
            raise OSError(
                f"cannot save {target.name!r}: the content read back from the disk differs"
            )
        if exists:
            shutil.copymode(target, temporary)
        _rename(temporary, target)
        _sync_folder(target.parent)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _private(path: str, flags: int) -> int:
    """Open a file that only its owner can read, because the replaced file may be private."""
    return os.open(path, flags, 0o600)


def _rename(temporary: Path, target: Path) -> None:
    """Rename a file atomically; retry if, on Windows, another process has the target open."""
    for attempt in range(6):
        try:
            os.replace(temporary, target)
            return
        except PermissionError:
            if attempt == 5:
                raise
            time.sleep(0.1)


def _sync_folder(folder: Path) -> None:
    """Flush the directory entries of a folder to disk, on POSIX systems only."""
    if os.name != "posix":
        return
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _remove_abandoned(folder: Path) -> None:
    """Remove temporary files of processes that were killed while saving."""
    for path in folder.glob(f"{_TEMPORARY}*.tmp*"):
        with suppress(OSError):
            if time.time() - path.stat().st_mtime > _ABANDONED_AFTER:
                path.unlink()
