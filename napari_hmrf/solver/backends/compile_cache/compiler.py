"""Process that compiles the loops for all other processes: its start, and the wait for it.

At most one such process runs on a machine. One file holds its number and progress, another the
requested loops, which it compiles next.
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

from napari_hmrf.solver.backends.compile_cache import kept, loops, sets
from napari_hmrf.solver.backends.thread import in_child_of_fork

#: Module that the compiling process runs.
COMPILER = "napari_hmrf.compiling"
#: Seconds between two readings of the progress; the longest time until a cancellation.
_POLL = 0.1


class _State:
    """Compiling process that this process has started."""

    compiler: subprocess.Popen[bytes] | None = None


class Stage(NamedTuple):
    """Progress of the compiler.

    Attributes
    ----------
    job : str
        Its current job, as named by `napari_hmrf.compiling`.
    done, of : int
        Number of compiled loops now, and at the end of the job.
    pace : float
        Seconds per loop; 0 if not known yet.
    """

    job: str
    done: int
    of: int
    pace: float

    @property
    def fraction(self) -> float:
        """Fraction done, from 0 to 1."""
        return min(self.done / max(self.of, 1), 1.0)

    @property
    def words(self) -> str:
        """Progress and remaining time, in words."""
        if self.of == 0:
            return "starting to compile loops"
        said = f"compiling loops ({self.done} of {max(self.of, self.done)})"
        left = self.pace * max(self.of - self.done, 1)
        return f"{said}, about {math.ceil(left)} s left" if left else said


Report = Callable[[Stage], None]
_NO_STAGE = Stage("", 0, 0, 0.0)


# Processes that need loops


def compile_meanwhile(job: str = "") -> None:
    """Start another process that compiles the loops, unless one is running or has finished.

    Parameters
    ----------
    job : str
        Job that compiles the needed loops; by default all usual ones.
    """
    ours = _State.compiler
    started = ours is not None and (job not in sets.ON_REQUEST or ours.poll() is None)
    if started or loops.compile_here() or kept.compiled(job) or _someone_compiles():
        return
    folder = kept.folder()  # before the environment is copied
    optimized = ["-" + "O" * sys.flags.optimize] if sys.flags.optimize else []
    with suppress(OSError):  # shaders solve without loops
        folder.mkdir(parents=True, exist_ok=True)
        _State.compiler = _started([sys.executable, *optimized, "-m", COMPILER])
        atexit.register(_State.compiler.terminate)


def request(job: str) -> None:
    """Let another process compile the loops of a job next, as this process waits for them."""
    with suppress(OSError):
        _wanted_file().write_text(job, encoding="utf-8")
    compile_meanwhile(job)


def _started(command: list[str]) -> subprocess.Popen[bytes]:
    """Start a process without input or output."""
    silent = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent)


def provide(job: str, report: Report) -> None:
    """Wait until another process has compiled the loops of a job, and use loops from then on.

    Where no other process can compile them, this one does when it calls them.

    Parameters
    ----------
    job : str
        As named by `napari_hmrf.compiling`; "" is all usual ones.
    report : callable
        Called several times a second; raises to stop waiting. The compilation continues.
    """
    if not (loops.compile_here() or kept.compiled(job)):
        request(job)
        is_repeated = False
        while not kept.compiled(job):
            if not (_at_work() or kept.compiled(job)):
                if is_repeated:
                    loops.compile_alone()
                    break
                # A process that was about to end may have missed the request.
                request(job)
                is_repeated = True
                continue
            report(stage())
            time.sleep(_POLL)
    loops.use()


def _at_work() -> bool:
    """Return whether a compiling process, of this or of another process, is running."""
    ours = _State.compiler
    return (ours is not None and ours.poll() is None) or _someone_compiles()


def stage() -> Stage:
    """Return the progress of the compiler."""
    try:
        return Stage(*_status()[2:])
    except TypeError:
        return _NO_STAGE


# The compiler itself


def begin() -> bool:
    """Return whether this process is now the compiling one; False if another one is."""
    if _someone_compiles():
        return False
    try:
        kept.folder().mkdir(parents=True, exist_ok=True)
        _publish(_NO_STAGE)
    except OSError:
        return False
    return True


def give_way() -> None:
    """Compile at idle priority from now on, as no process waits for the loops."""
    with suppress(psutil.Error, OSError):
        idle = getattr(psutil, "IDLE_PRIORITY_CLASS", 19)
        psutil.Process().nice(idle)


def wanted() -> str:
    """Return the job that a process waits for, or has waited for, or ""."""
    with suppress(OSError):
        return _wanted_file().read_text(encoding="utf-8")
    return ""


def tell(reached: Stage) -> None:
    """Publish the progress of this process."""
    with suppress(OSError):
        _publish(reached)


def end(compiled: bool) -> None:
    """End the claim of `begin`, and mark all usual loops as compiled if they are."""
    with suppress(OSError):
        if compiled:
            kept.mark().touch()
        for each in (_status_file(), _wanted_file()):
            each.unlink(missing_ok=True)


def _someone_compiles() -> bool:
    """Return whether the last compiling process still runs, under its number and start time."""
    try:
        number, begun, *_ = _status()
        return bool(number != os.getpid() and _begun(number) == begun)
    except (ValueError, psutil.Error):
        return False


def _begun(number: int) -> str:
    """Return the start time of a process."""
    return f"{psutil.Process(number).create_time():.0f}"


def _status() -> list[Any]:
    """Return the number and start time of the last compiling process, and its stage; or []."""
    with suppress(OSError, ValueError):
        found: list[Any] = json.loads(_status_file().read_text(encoding="utf-8"))
        return found
    return []


def _publish(reached: Stage) -> None:
    """Write the status of this process, in one step."""
    number, new = os.getpid(), _status_file().with_suffix(".new")
    new.write_text(json.dumps([number, _begun(number), *reached]), encoding="utf-8")
    new.replace(_status_file())


def _status_file() -> Path:
    return kept.mark().with_suffix(".compiler")


def _wanted_file() -> Path:
    return kept.mark().with_suffix(".wanted")


def _forget_compiler() -> None:
    """In the child of a fork: the compiler is the parent's."""
    _State.compiler = None


in_child_of_fork(_forget_compiler)
