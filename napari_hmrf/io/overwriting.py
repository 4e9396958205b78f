"""Files that are there already are not written over unless the user says so."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from napari_hmrf.atomic_write import is_stream
from napari_hmrf.errors import HmrfError


def refuse_overwriting(paths: Iterable[Path], *, overwrite: bool = False) -> None:
    """Refuse to write over files, unless they may be replaced.

    Parameters
    ----------
    paths : iterable of Path
        Files to be written. A device is written into, and a folder in place of a file is for the
        writer to refuse.
    overwrite : bool
        Whether files may be replaced.

    Raises
    ------
    HmrfError
        Naming the first file that is there.
    """
    if overwrite:
        return
    there = [path for path in paths if path.exists() and not (path.is_dir() or is_stream(path))]
    if there:
        more = f" (and {len(there) - 1} more)" if len(there) > 1 else ""
        raise HmrfError(
            f"{there[0]} is there already{more}. Give another name, or write over it "
            "(`overwrite=True`)."
        )
