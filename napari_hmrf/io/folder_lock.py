"""Exclusive use of a folder by one process, also on a disk that several machines share.

A process marks a folder with a file, whose name states the process, its start time and its machine.
It then searches for the marks of other processes: if two processes begin at the same time, at least
one of them finds the mark of the other. The mark of an ended process of this machine is removed. A
process of another machine cannot be checked, so its mark always counts.
"""

from __future__ import annotations

import os
import re
import secrets
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import psutil

from napari_hmrf.errors import HmrfError

#: Largest difference between two readings of the start time of one process, in seconds.
_SAME_START = 2
_MARK = re.compile(r"\.batch-(\d+)-(\d+)-[0-9a-f]+@(.+)\.lock")


class Mark(NamedTuple):
    """Mark of a process in a folder.

    Attributes
    ----------
    path : Path
        File of the mark.
    process : int
        Identifier of the process.
    started : int
        Start time of the process, in seconds since the epoch.
    machine : str
        Name of the machine.
    """

    path: Path
    process: int
    started: int
    machine: str

    @property
    def is_stale(self) -> bool:
        """True if the process is known to have ended."""
        if self.machine != _machine():
            return False
        try:
            process = psutil.Process(self.process)
            started = process.create_time()
            if process.status() == psutil.STATUS_ZOMBIE:
                return True
        except psutil.NoSuchProcess:
            return True
        except psutil.Error:
            return False
        return bool(abs(started - self.started) > _SAME_START)


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Return a context in which only this process uses a folder.

    Parameters
    ----------
    folder : Path
        Existing folder.

    Raises
    ------
    HmrfError
        If another process uses the folder; the message names the process, its machine, and the
        file to delete if the process has ended.
    OSError
        If the folder cannot be written.
    """
    started = int(psutil.Process().create_time())
    name = f".batch-{os.getpid()}-{started}-{secrets.token_hex(4)}@{_machine()}.lock"
    own = folder / name
    own.touch(exist_ok=False)
    try:
        for mark in marks_in(folder):
            if mark.path == own:
                continue
            if mark.is_stale:
                with suppress(FileNotFoundError):
                    mark.path.unlink()
                continue
            machine = "" if mark.machine == _machine() else f" on {mark.machine}"
            raise HmrfError(
                f"{folder}: another batch, process {mark.process}{machine}, writes into this "
                "folder. Wait until it ends, or choose another folder. If it has ended, delete "
                f"{mark.path.name} in the folder."
            )
        yield
    finally:
        with suppress(FileNotFoundError):
            own.unlink()


def marks_in(folder: Path) -> tuple[Mark, ...]:
    """Return the marks of all processes in a folder."""
    matches = ((path, _MARK.fullmatch(path.name)) for path in sorted(folder.glob(".batch-*.lock")))
    return tuple(
        Mark(path, int(match[1]), int(match[2]), match[3]) for path, match in matches if match
    )


def _machine() -> str:
    """Return the name of this machine, with only characters that file names allow."""
    return re.sub(r"[^\w.-]+", "_", socket.gethostname()) or "machine"
