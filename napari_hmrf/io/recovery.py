"""Recovery files: autosaved work, which can be recovered after a crash.

Several machines may share the folder, so the name of a file contains the machine and the id of the
process that owns the file.
"""

from __future__ import annotations

import os
import platform
import re
import secrets
from pathlib import Path

import psutil

from napari_hmrf.io.study_file import SUFFIX


def new_file(folder: Path) -> Path:
    """Return the path of a new recovery file of this process.

    If the folder does not exist, it is created with access for the owner only.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder / f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}{SUFFIX}"


def abandoned_files(folder: Path) -> tuple[Path, ...]:
    """Return the recovery files of terminated processes on this machine, newest first.

    Files of other machines are omitted, because their processes cannot be checked.
    """
    files = [file for file in folder.glob(f"{_machine()}-*{SUFFIX}") if not _is_alive(file)]
    return tuple(sorted(files, key=_modified, reverse=True))


def claim(file: Path) -> Path:
    """Take over the recovery file of a terminated process: rename it, and return the new path."""
    new_path = new_file(file.parent)
    os.utime(file)
    return file.replace(new_path)


def _machine() -> str:
    """Return the name of this machine, with only letters, digits and underscores."""
    return re.sub(r"\W", "_", platform.node()) or "here"


def _modified(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # another process has taken over the file
        return 0.0


def _is_alive(file: Path) -> bool:
    """Return whether the process that wrote a recovery file is still running.

    A process that started after the file was modified is a different process with the same id.
    """
    try:
        process = psutil.Process(int(file.stem.split("-")[-2]))
        is_zombie = process.status() == psutil.STATUS_ZOMBIE
        return not is_zombie and bool(process.create_time() <= _modified(file))
    except psutil.AccessDenied:
        return True
    except (psutil.Error, ValueError, IndexError):
        return False
