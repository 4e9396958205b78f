"""Files of work that nobody has saved yet, and those that a process left behind as it ended."""

from __future__ import annotations

import os
import platform
import re
import secrets
from pathlib import Path

import psutil

from napari_hmrf.io.study_file import SUFFIX


def new_file(folder: Path) -> Path:
    """A name for a file of this process; the folder is made, for its owner alone."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return folder / f"{_machine()}-{os.getpid()}-{secrets.token_hex(4)}{SUFFIX}"


def left_behind(folder: Path) -> tuple[Path, ...]:
    """The files of processes of this machine that live no more, the newest first."""
    # Folders are shared by machines, whose processes nobody here can see.
    found = [file for file in folder.glob(f"{_machine()}-*{SUFFIX}") if not _is_alive(file)]
    return tuple(sorted(found, key=_written, reverse=True))


def take_over(file: Path) -> Path:
    """Have a file that was left behind be one of this process; its new name."""
    own = new_file(file.parent)
    os.utime(file)
    return file.replace(own)


def _machine() -> str:
    return re.sub(r"\W", "_", platform.node()) or "here"


def _written(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # somebody has just taken it
        return 0.0


def _is_alive(file: Path) -> bool:
    """Whether the process that wrote a file lives; another that was given its number is younger."""
    try:
        process = psutil.Process(int(file.stem.split("-")[-2]))
        over = process.status() == psutil.STATUS_ZOMBIE
        return not over and bool(process.create_time() <= _written(file))
    except psutil.AccessDenied:
        return True
    except (psutil.Error, ValueError, IndexError):
        return False
