"""Lock for exclusive use of a folder by one process, even on disks shared between machines.

A process creates a lock file with a name that contains the process id, the start time of the
process and the machine. It then searches for lock files of other processes. If two processes do
this at the same time, at least one of them finds the lock file of the other. A stale lock file,
left by a terminated process on this machine, is removed. The processes of other machines cannot be
checked, so their lock files are always respected.
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

#: Largest difference between two queries of the start time of the same process, in seconds.
_SAME_START = 2
_MARK = re.compile(r"\.batch-(\d+)-(\d+)-[0-9a-f]+@(.+)\.lock")


class Mark(NamedTuple):
    """Lock file of a process in a folder.

    Attributes
    ----------
    path : Path
        Path of the lock file.
    process : int
        Process id.
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
    """Lock a folder for this process within a context.

    Parameters
    ----------
    folder : Path
        Existing folder.

    Raises
    ------
    HmrfError
        If another process has locked the folder. The message states the process, its machine, and
        the lock file to delete if the process has already ended.
    OSError
        If the folder cannot be written to.
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
                f"{folder}: another batch (process {mark.process}{machine}) is using this folder. "
                "Wait until that batch ends, or choose another folder. If the batch has already "
                f"ended, delete {mark.path.name} in the folder."
            )
        yield
    finally:
        with suppress(FileNotFoundError):
            own.unlink()


def marks_in(folder: Path) -> tuple[Mark, ...]:
    """Return the lock files of all processes in a folder."""
    matches = ((path, _MARK.fullmatch(path.name)) for path in sorted(folder.glob(".batch-*.lock")))
    return tuple(
        Mark(path, int(match[1]), int(match[2]), match[3]) for path, match in matches if match
    )


def _machine() -> str:
    """Return the name of this machine, restricted to characters that are valid in file names."""
    return re.sub(r"[^\w.-]+", "_", socket.gethostname()) or "machine"
