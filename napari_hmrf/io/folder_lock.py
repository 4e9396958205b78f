"""Exclusive use of a folder by one process, also on a disk that several machines share.

A process marks a folder by a file of its own, whose name has the process, the time it started and
the machine. It then looks for the marks of others: of two processes that begin at the same time at
least one sees the mark of the other. A mark of a process of this machine that has ended is removed;
on another machine that cannot be seen, and its mark counts.
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

#: Clocks of two processes may differ by this much on when a third one started, in seconds.
_SAME_START = 2
_MARK = re.compile(r"\.batch-(\d+)-(\d+)-[0-9a-f]+@(.+)\.lock")


class Mark(NamedTuple):
    """Mark of a process in a folder.

    Attributes
    ----------
    path : Path
    process : int
    started : int
        Time of the start, in seconds.
    machine : str
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
    """Use a folder alone.

    Parameters
    ----------
    folder : Path
        A folder that is there.

    Raises
    ------
    HmrfError
        If another process uses it: naming the process, its machine, and the file to delete if that
        process has ended.
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
            where = "" if mark.machine == _machine() else f" on {mark.machine}"
            raise HmrfError(
                f"{folder}: another batch, process {mark.process}{where}, writes into this folder. "
                "Wait until it ends, or take another folder. If it has ended, delete "
                f"{mark.path.name} in it."
            )
        yield
    finally:
        with suppress(FileNotFoundError):
            own.unlink()


def marks_in(folder: Path) -> tuple[Mark, ...]:
    """Return the marks of all processes in a folder."""
    found = ((path, _MARK.fullmatch(path.name)) for path in sorted(folder.glob(".batch-*.lock")))
    return tuple(
        Mark(path, int(parts[1]), int(parts[2]), parts[3]) for path, parts in found if parts
    )


def _machine() -> str:
    """Return the name of this machine, as it can stand in the name of a file."""
    return re.sub(r"[^\w.-]+", "_", socket.gethostname()) or "machine"
