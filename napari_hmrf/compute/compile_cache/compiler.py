"""Process that compiles the loops for all other processes: start, progress and waiting.

At most one compiling process runs per machine. A status file contains its process ID and progress.
A request file contains the name of the job that it compiles next.
"""

from __future__ import annotations

import atexit
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from napari_hmrf.compute.compile_cache import disk_cache, loops, sets
from napari_hmrf.compute.workspace import in_child_of_fork

#: Module that the compiling process executes.
COMPILER = "napari_hmrf.compiling"
#: Interval between two readings of the progress, in seconds. Cancellation takes at most this long.
_POLL = 0.1


class _State:
    """State of the compilation in this process."""

    #: Compiling process started by this process.

    compiler: subprocess.Popen[bytes] | None = None


class Stage(NamedTuple):
    """Progress of the compiling process.

    Attributes
    ----------
    job : str
        Current job, as named by `napari_hmrf.compiling`.
    done, of : int
        Number of loops compiled so far, and the total expected at the end of the job.
    pace : float
        Seconds per loop; 0 if unknown.
    """

    job: str
    done: int
    of: int
    pace: float

    @property
    def fraction(self) -> float:
        """Completed fraction of the job, from 0 to 1."""
        return min(self.done / max(self.of, 1), 1.0)

    @property
    def words(self) -> str:
        """Progress and remaining time as text."""
        if self.of == 0:
            return "starting to compile loops"
        text = f"compiling loops ({self.done} of {max(self.of, self.done)})"
        left = self.pace * max(self.of - self.done, 1)
        return f"{text}, about {math.ceil(left)} s left" if left else text


Report = Callable[[Stage], None]
_NO_STAGE = Stage("", 0, 0, 0.0)


# Processes that use loops


def compile_meanwhile(job: str = "") -> None:
    """Start a compiling process unless one is running or the loops are already compiled.

    Parameters
    ----------
    job : str
        Job that compiles the required loops; by default, the job of all usual loops.
    """
    ours = _State.compiler
    started = ours is not None and (job not in sets.ON_REQUEST or ours.poll() is None)
    if started or loops.are_compiled(job) or _another_process_compiles():
        return
    folder = disk_cache.folder()  # may set a variable, so call this before starting the process
    optimized = ["-" + "O" * sys.flags.optimize] if sys.flags.optimize else []
    with suppress(OSError):  # without compiled loops, shaders solve
        folder.mkdir(parents=True, exist_ok=True)
        _State.compiler = _start_process([sys.executable, *optimized, "-m", COMPILER])
        atexit.register(_State.compiler.terminate)


def request(job: str) -> None:
    """Request that the compiling process compile the loops of a job next."""
    with suppress(OSError):
        _request_file().write_text(job, encoding="utf-8")
    compile_meanwhile(job)


def _start_process(command: list[str]) -> subprocess.Popen[bytes]:
    """Start a process without input or output."""
    silent = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent)


def provide(job: str, report: Report) -> None:
    """Wait until the compiling process has compiled the loops of a job, then use the loops.

    If no compiling process can run, this process compiles each loop at its first call.

    Parameters
    ----------
    job : str
        Name of the job in `napari_hmrf.compiling`; "" stands for all usual loops.
    report : callable
        Function called with a `Stage` several times a second. It may raise an exception to stop
        waiting; the compilation then continues.
    """
    if not loops.are_compiled(job):
        request(job)
        is_repeated = False
        while not disk_cache.compiled(job):
            if not (_is_compiling() or disk_cache.compiled(job)):
                if is_repeated:
                    loops.compile_alone()
                    break
                # A compiling process that was about to end may have missed the request.
                request(job)
                is_repeated = True
                continue
            report(stage())
            time.sleep(_POLL)
    loops.use()


def _is_compiling() -> bool:
    """Return whether a compiling process is running, started by this or another process."""
    ours = _State.compiler
    return (ours is not None and ours.poll() is None) or _another_process_compiles()


def stage() -> Stage:
    """Return the progress of the compiling process."""
    try:
        return Stage(*_status()[2:])
    except TypeError:
        return _NO_STAGE


# Compiling process


def begin() -> bool:
    """Make this the compiling process; return False if another one exists."""
    if _another_process_compiles():
        return False
    try:
        disk_cache.folder().mkdir(parents=True, exist_ok=True)
        _write_status(_NO_STAGE)
    except OSError:
        return False
    return True


def lower_priority() -> None:
    """Lower the priority of this process to idle, because no process depends on the loops yet."""
    with suppress(psutil.Error, OSError):
        idle = getattr(psutil, "IDLE_PRIORITY_CLASS", 19)
        psutil.Process().nice(idle)


def requested_job() -> str:
    """Return the most recently requested job, or "" if there is no request."""
    with suppress(OSError):
        return _request_file().read_text(encoding="utf-8")
    return ""


def publish_stage(reached: Stage) -> None:
    """Publish the progress of this process."""
    with suppress(OSError):
        _write_status(reached)


def end(compiled: bool) -> None:
    """Remove the status file that `begin` wrote, and any request file.

    Parameters
    ----------
    compiled : bool
        True to mark all usual loops as compiled.
    """
    with suppress(OSError):
        if compiled:
            disk_cache.mark().touch()
        for each in (_status_file(), _request_file()):
            each.unlink(missing_ok=True)


def _another_process_compiles() -> bool:
    """Return whether the recorded compiling process is running and is not this process."""
    try:
        number, begun, *_ = _status()
        return bool(number != os.getpid() and _start_time(number) == begun)
    except (ValueError, psutil.Error):
        return False


def _start_time(number: int) -> str:
    """Return the start time of a process."""
    return f"{psutil.Process(number).create_time():.0f}"


def _status() -> list[Any]:
    """Return the ID, start time and stage of the recorded compiling process, or []."""
    with suppress(OSError, ValueError):
        found: list[Any] = json.loads(_status_file().read_text(encoding="utf-8"))
        return found
    return []


def _write_status(reached: Stage) -> None:
    """Write the status file of this process, replacing the old file atomically."""
    number, new = os.getpid(), _status_file().with_suffix(".new")
    new.write_text(json.dumps([number, _start_time(number), *reached]), encoding="utf-8")
    new.replace(_status_file())


def _status_file() -> Path:
    return disk_cache.mark().with_suffix(".compiler")


def _request_file() -> Path:
    return disk_cache.mark().with_suffix(".wanted")


def _forget_compiler() -> None:
    """Reset the state in a forked child, because the compiling process belongs to the parent."""
    _State.compiler = None


in_child_of_fork(_forget_compiler)
