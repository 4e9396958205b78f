"""Atomic writing of files: after a crash, a file is either complete or unchanged."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from napari_hmrf.errors import CANNOT_SAVE

#: Permissions of a temporary file that replaces a file, which may be private.
_PRIVATE = 0o600
#: Size of the largest buffer of bytes that a library keeps until it closes a file.
_BUFFER = 2**20


def write_whole(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file atomically.

    The content is written to a temporary file in the same folder, which then replaces the target
    file; the permissions of an existing target file are preserved.

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
    target = Path(os.path.realpath(path))
    if is_stream(target):
        with naming_target(path):
            target.write_bytes(content)
        return
    with temporary_beside(path, "") as temporary, naming_target(path):
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            # In a writable folder, renaming would replace even a read-only file.
            if not os.access(target, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            shutil.copymode(target, temporary)
        os.replace(temporary, target)


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
    file = target.with_name(f".napari-hmrf-{secrets.token_hex(8)}.tmp{suffix}")
    with naming_target(path):
        file.touch(_PRIVATE if target.exists() else 0o666, exist_ok=False)
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
    with temporary_beside(path, "") as file, naming_target(path), open(file, "wb") as stream:
        piece = bytes(2**20)
        for _ in range(size // len(piece) + 1):
            stream.write(piece)
        stream.flush()
        os.fsync(stream.fileno())


def raise_if_full(path: str | os.PathLike[str], file: Path) -> None:
    """Raise the operating system's error if no more bytes fit on the disk of a temporary file.

    Some libraries do not report that the end of a file was not written.

    Parameters
    ----------
    path : str or path-like
        Path of the target file, which is not modified.
    file : Path
        Temporary file, which a library has written; bytes are appended.

    Raises
    ------
    OSError
        If the bytes cannot be written; the message names the target file.
    """
    with naming_target(path), open(file, "ab") as stream:
        stream.write(bytes(_BUFFER))
        stream.flush()
        os.fsync(stream.fileno())


@contextmanager
def naming_target(target: str | os.PathLike[str]) -> Iterator[None]:
    """Return a context manager that adds the target file to the messages of system errors."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise type(error)(
            error.errno, f"{CANNOT_SAVE}{error.strerror}", os.fspath(target)
        ) from error


def is_stream(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a FIFO, socket or device, which must not be replaced."""
    return os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path))
