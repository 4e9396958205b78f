"""Process that prepares a computer, by compiling the loops for all other processes.

At most one compiling process runs per machine. A status file contains its process ID and progress.
A request file contains the names of the jobs that it compiles next. Whatever has been compiled
remains on disk if the process is stopped, and the next one continues there.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from napari_hmrf.compute.compile_cache import disk_cache, loops, sets
from napari_hmrf.compute.compile_cache.stage import Progress, Stage
from napari_hmrf.compute.workspace import in_child_of_fork

#: Module that the compiling process executes.
COMPILER = "napari_hmrf.compiling"
#: Argument with which all of its jobs have the lowest priority.
IDLE = "--idle"
#: Interval between two readings of the progress, in seconds. Cancellation takes at most this long.
_POLL = 0.1


class _State:
    """State of the compilation in this process."""

    #: Compiling process started by this process.

    compiler: subprocess.Popen[bytes] | None = None


Report = Callable[[Progress], None]


# Processes that use loops


def compile_meanwhile() -> None:
    """Start a compiling process unless one is running or all loops are compiled."""
    if _State.compiler is not None or loops.are_compiled(sets.EVERYTHING):
        return
    if not is_compiling():
        with suppress(OSError):
            _request_file().unlink(missing_ok=True)  # of a process that was stopped
        _start(IDLE)


def request(*jobs: str, priority: str = "") -> None:
    """Request that the compiling process compile the loops of some jobs before all others.

    Parameters
    ----------
    *jobs : str
        Names of jobs; `sets.EVERYTHING` keeps the order of the jobs.
    priority : str
        `IDLE` if a process that is started for these jobs must not delay anything else. Jobs that
        are not requested never do.
    """
    wanted = [job for job in jobs if job and not loops.are_compiled(job)]
    before = requested_jobs() if is_compiling() else []
    earlier = [job for job in before if job not in wanted]
    if wanted:
        with suppress(OSError):
            _request_file().parent.mkdir(parents=True, exist_ok=True)
            _request_file().write_text("\n".join([*wanted, *earlier]), encoding="utf-8")
    if not all(map(loops.are_compiled, jobs)):
        _start(priority)


def _start(priority: str) -> None:
    """Start a compiling process unless one is running."""
    if is_compiling():
        return
    folder = disk_cache.folder()  # may set a variable, so call this before starting the process
    optimized = ["-" + "O" * sys.flags.optimize] if sys.flags.optimize else []
    with suppress(OSError):  # without compiled loops, shaders solve
        folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, *optimized, "-m", COMPILER, *filter(None, [priority])]
        _State.compiler = _start_process(command)
        atexit.register(_State.compiler.terminate)


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
        Name of the job in `napari_hmrf.compiling`; "" stands for all loops.
    report : callable
        Function called with a `Progress` several times a second. It may raise an exception to stop
        waiting; the compilation then continues.
    """
    if not loops.are_compiled(job):
        request(job)
        is_repeated = False
        while not disk_cache.compiled(job):
            if not (is_compiling() or disk_cache.compiled(job)):
                if is_repeated:
                    loops.compile_alone()
                    break
                # A compiling process that was about to end may have missed the request.
                request(job)
                is_repeated = True
                continue
            report(progress(job))
            time.sleep(_POLL)
    loops.use()


def is_compiling() -> bool:
    """Return whether a compiling process is running, started by this or another process."""
    ours = _State.compiler
    return (ours is not None and ours.poll() is None) or _another_process_compiles()


def progress(*jobs: str) -> Progress:
    """Return the progress of the compilation of the loops of some jobs; `EVERYTHING` is all."""
    counted = [*sets.COSTS] if sets.EVERYTHING in jobs else jobs
    missing = [job for job in counted if not disk_cache.compiled(job)]
    return _stage().progress(counted, missing)


def _stage() -> Stage:
    """Return the stage of the compiling process."""
    try:
        return Stage(*_status()[2:])
    except TypeError:
        return Stage()


# Compiling process


def begin() -> bool:
    """Make this the compiling process; return False if another one exists."""
    if _another_process_compiles():
        return False
    try:
        disk_cache.folder().mkdir(parents=True, exist_ok=True)
        _write_status(Stage())
    except OSError:
        return False
    return True


def lower_priority() -> None:
    """Lower the priority of this process to idle, so that it does not delay a solve or a drag."""
    with suppress(psutil.Error, OSError):
        idle = getattr(psutil, "IDLE_PRIORITY_CLASS", 19)
        psutil.Process().nice(idle)


def requested_jobs() -> list[str]:
    """Return the names of the requested jobs; the first one is the most urgent."""
    with suppress(OSError):
        return _request_file().read_text(encoding="utf-8").split()
    return []


def publish_stage(reached: Stage) -> None:
    """Publish the progress of this process."""
    with suppress(OSError):
        _write_status(reached)


def end(compiled: bool) -> None:
    """Remove the status file that `begin` wrote, and any request file.

    Parameters
    ----------
    compiled : bool
        True to mark all loops as compiled.
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
