"""Refusal of pipes and devices, which have no end, where a file is read."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from napari_hmrf.errors import FileFormatError


def refuse_irregular(path: str | os.PathLike[str]) -> None:
    """Refuse a path that leads to a pipe, a socket or a device.

    Raises
    ------
    FileFormatError
        If it does.
    OSError
        If nothing is there.
    """
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FileFormatError(
            f"{Path(path).name}: it is a pipe or a device. Save its content to a file first."
        )


def read_at_most(path: str | os.PathLike[str], largest: int) -> bytes | None:
    """Read a file that may be a pipe; None if it has more bytes than the largest allowed.

    Raises
    ------
    OSError
        If it cannot be opened.
    """
    with open(path, "rb") as file:
        content = file.read(largest + 1)
    return content if len(content) <= largest else None
