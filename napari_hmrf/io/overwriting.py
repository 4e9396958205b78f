"""Protection of existing files, which are overwritten only on request."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from napari_hmrf.errors import HmrfError


def refuse_overwriting(paths: Iterable[Path], *, overwrite: bool = False) -> None:
    """Raise an error if files would be overwritten without permission.

    Parameters
    ----------
    paths : iterable of Path
        Files to be written. Devices and folders are ignored: devices are not overwritten, and
        writing to a folder raises an error anyway.
    overwrite : bool
        True if files may be overwritten.

    Raises
    ------
    HmrfError
        If `overwrite` is False and a file exists; the message names the first existing file.
    """
    if overwrite:
        return
    existing = [path for path in paths if path.is_file()]
    if existing:
        more = f" (and {len(existing) - 1} more)" if len(existing) > 1 else ""
        raise HmrfError(
            f"{existing[0]} already exists{more}. Give another name, or overwrite it "
            "(`overwrite=True`)."
        )
