"""The process that compiles the loops for all others: starting it, and waiting for it.

Only one does it at a time, on the whole machine. It says in a file how far it is, and takes next
what somebody waits for.
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
from typing import NamedTuple

import psutil

from napari_hmrf.solver.backends import kept, loops
from napari_hmrf.solver.backends.thread import in_child_of_fork

#: What the other process runs.
COMPILER = "napari_hmrf.compiling"
#: How often it is asked how far it is, in seconds: so long Cancel may take.
_POLL = 0.1


class _State:
    """What this process has started."""

    compiler: subprocess.Popen[bytes] | None = None


class Stage(NamedTuple):
    """How far the compiler is.

    Attributes
    ----------
    job : str
        What it does, as `napari_hmrf.compiling` names it.
    done, of : int
        Loops: those that are compiled, and those there will be then.
    pace : float
        Seconds for each; 0 if that is not known yet.
    """

    job: str
    done: int
    of: int
    pace: float

    @property
    def fraction(self) -> float:
        """How much of it is done."""
        return min(self.done / max(self.of, 1), 1.0)

    @property
    def words(self) -> str:
        """That, and how long the rest will take at this pace, in words."""
        if self.of == 0:
            return "starting to compile loops"
        said = f"compiling loops ({self.done} of {max(self.of, self.done)})"
        left = self.pace * max(self.of - self.done, 1)
        return f"{said}, about {math.ceil(left)} s left" if left else said


Report = Callable[[Stage], None]


# Whoever needs loops


def compile_meanwhile(job: str = "") -> None:
    """Have another process compile the loops, unless one does or has.

    Parameters
    ----------
    job : str
        The loops that are needed; by default all that anybody may need.
    """
    ours = _State.compiler
    started = ours is not None and (job not in kept.APART or ours.poll() is None)
    if started or loops.compile_here() or kept.compiled(job) or _someone_compiles():
        return
    folder = kept.folder()  # before the environment is copied
    optimized = ["-" + "O" * sys.flags.optimize] if sys.flags.optimize else []
    with suppress(OSError):  # then there will be no loops
        folder.mkdir(parents=True, exist_ok=True)
        _State.compiler = _started([sys.executable, *optimized, "-m", COMPILER])
        atexit.register(_State.compiler.terminate)


def request(job: str) -> None:
    """Have another process compile the loops of a job next, for somebody who waits for them."""
    with suppress(OSError):
        _wanted_file().write_text(job, encoding="utf-8")
    compile_meanwhile(job)


def _started(command: list[str]) -> subprocess.Popen[bytes]:
    """Start a process that says nothing."""
    silent = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=silent, stdout=silent, stderr=silent)


def provide(job: str, report: Report) -> None:
    """Have the loops of a job compiled, wait for them, and solve with loops from then on.

    Where no other process can compile them, this one will as it goes.

    Parameters
    ----------
    job : str
        As `napari_hmrf.compiling` names it; "" is all of them.
    report : callable
        Called several times a second; raises to wait no more. What is being compiled goes on.
    """
    if not (loops.compile_here() or kept.compiled(job)):
        request(job)
        while not kept.compiled(job):
            if not (_at_work() or kept.compiled(job)):
                loops.compile_alone()
                break
            report(stage())
            time.sleep(_POLL)
    loops.use()


def _at_work() -> bool:
    """Whether our compiler, or another process's, is not done."""
    ours = _State.compiler
    return (ours is not None and ours.poll() is None) or _someone_compiles()


def stage() -> Stage:
    """How far the compiler is."""
    try:
        return Stage(*json.loads(_stage_file().read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return Stage("", 0, 0, 0.0)


# The compiler itself


def begin() -> bool:
    """Say that this process is the one that compiles; False if another is."""
    if _someone_compiles():
        return False
    try:
        kept.folder().mkdir(parents=True, exist_ok=True)
        number = os.getpid()
        _compiler_file().write_text(f"{number} {_begun(number)}", encoding="utf-8")
        _stage_file().unlink(missing_ok=True)
    except OSError:
        return False
    return True


def give_way() -> None:
    """Compile only while nobody needs the processor: from now on no one waits for it."""
    with suppress(psutil.Error, OSError):
        idle = getattr(psutil, "IDLE_PRIORITY_CLASS", 19)
        psutil.Process().nice(idle)


def wanted() -> str:
    """The job that somebody waits for, or has waited for."""
    with suppress(OSError):
        return _wanted_file().read_text(encoding="utf-8")
    return ""


def tell(reached: Stage) -> None:
    """Say how far this process is, to all others."""
    new = _stage_file().with_suffix(".new")
    with suppress(OSError):
        new.write_text(json.dumps(reached), encoding="utf-8")
        new.replace(_stage_file())


def end(compiled: bool) -> None:
    """Say that this process has done with compiling."""
    with suppress(OSError):
        if compiled:
            kept.mark().touch()
        for each in (_compiler_file(), _stage_file(), _wanted_file()):
            each.unlink(missing_ok=True)


def _someone_compiles() -> bool:
    """Whether the process that last began to compile is still there, and no other by its number."""
    try:
        number, begun = _compiler_file().read_text(encoding="utf-8").split()
        return number != str(os.getpid()) and _begun(int(number)) == begun
    except (OSError, ValueError, psutil.Error):
        return False


def _begun(number: int) -> str:
    """When a process began."""
    return f"{psutil.Process(number).create_time():.0f}"


def _compiler_file() -> Path:
    return kept.mark().with_suffix(".compiler")


def _stage_file() -> Path:
    return kept.mark().with_suffix(".stage")


def _wanted_file() -> Path:
    return kept.mark().with_suffix(".wanted")


def _forget_compiler() -> None:
    """In the child of a fork: the compiler is the parent's."""
    _State.compiler = None


in_child_of_fork(_forget_compiler)
