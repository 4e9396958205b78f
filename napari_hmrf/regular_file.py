"""Guards against reading from pipes and devices, which may block forever."""

from __future__ import annotations

import os
from pathlib import Path

from napari_hmrf.atomic_write import is_stream
from napari_hmrf.errors import FileFormatError


def refuse_irregular(path: str | os.PathLike[str]) -> None:
    """Raise a FileFormatError if a path is a pipe, a socket or a device."""
    if is_stream(path):
        raise FileFormatError(
            f"{Path(path).name}: it is a pipe or a device. Save its content to a file first."
        )


def read_at_most(path: str | os.PathLike[str], largest: int) -> bytes | None:
    """Read a file of limited size, which may be a pipe.

    Parameters
    ----------
    path : str or path-like
    largest : int
        Largest allowed size, in bytes.

    Returns
    -------
    bytes or None
        Content of the file; None if it is larger than `largest` bytes.

    Raises
    ------
    OSError
        If the file cannot be opened.
    """
    with open(path, "rb") as file:
        content = file.read(largest + 1)
    return content if len(content) <= largest else None
