"""Calls of functions in a child process, which a damaged file may crash or hang."""

from __future__ import annotations

import faulthandler
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.spawn import get_executable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from napari_hmrf.errors import HmrfError
from napari_hmrf.io.decoded import MOST_PACKED

if sys.platform == "linux":
    import resource

P = ParamSpec("P")
T = TypeVar("T")

#: Time allowed for starting the process with its imports, in seconds; long enough for slow disks.
_SECONDS_TO_START = 120.0
#: Time allowed for any call, and additional time per MB, in seconds.
_LEAST_SECONDS, _SECONDS_PER_MB = 10.0, 2.0
#: Memory allowed for any call, in bytes, and largest memory divided by the size of the file.
_LEAST_MEMORY, _LARGEST_RATIO = 2 * 2**30, 4 * MOST_PACKED
#: Program of the child process.
_PROGRAM = """
import faulthandler, sys
faulthandler.dump_traceback_later(float(sys.argv[2]), exit=True)
sys.path.insert(0, sys.argv[1])
from napari_hmrf.io.child_process import main
main()
"""
#: Bytes that the child process sends when it has received its request and is ready for it.
_READY = b"ready"


class ChildDied(Exception):
    """Error for a child process that crashed or did not finish in time."""


def call_in_child(
    size: int, function: Callable[P, T], *arguments: P.args, **options: P.kwargs
) -> T:
    """Call a function in a new process.

    Unlike in a process of `multiprocessing`, the main module is not imported again.

    Parameters
    ----------
    size : int
        Size of the file that the function reads or writes, in bytes; it limits the time, without
        that of starting the process, and, on Linux, the memory.
    function : callable
        Function of a module. Its arguments, its result and its errors are pickled.
    *arguments, **options
        Arguments of the function.

    Raises
    ------
    ChildDied
        If the process crashed or did not finish in time.
    HmrfError
        If no process can be started, or if it is not ready in time.
    Exception
        If the function raises it; `MemoryError` if it requires too much memory.
    """
    limits = _LEAST_SECONDS + _SECONDS_PER_MB * size / 1e6, _LEAST_MEMORY + _LARGEST_RATIO * size
    # An application that is frozen into one program has no interpreter.
    python = "" if getattr(sys, "frozen", False) else get_executable() or ""
    package = str(Path(__file__).parents[2])
    command = [python, "-P", "-c", _PROGRAM, package, str(_SECONDS_TO_START)]
    paths = os.pathsep.join(os.path.abspath(each) for each in sys.path)
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": paths},
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError:
        raise HmrfError(
            "this file is read in a separate process, but no Python interpreter was found for it. "
            "Read the file in an environment with a Python interpreter."
        ) from None
    with process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with suppress(BrokenPipeError), process.stdin:
                pickle.dump((limits, function, arguments, options), process.stdin)
            if process.stdout.read(len(_READY)) != _READY:
                raise HmrfError(
                    "this file is read in a separate process, which ended while starting, or did "
                    f"not start in {_SECONDS_TO_START:g} s. Try again while the computer and its "
                    "disk are less busy."
                )
            succeeded, result = pickle.load(process.stdout)
        except (EOFError, OSError, pickle.UnpicklingError):
            raise ChildDied from None
        finally:
            process.kill()
    if not succeeded:
        raise result
    return result  # type: ignore[no-any-return]


def main() -> None:
    """Call the function that standard input names, and write its result to standard output."""
    results = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # libraries print warnings about damaged files
    (seconds, memory), function, arguments, options = pickle.load(sys.stdin.buffer)
    with suppress(ImportError):  # the function reports a missing package
        import SimpleITK  # noqa: F401 - optional: SimpleITK, imported before the time counts
    results.write(_READY)
    results.flush()
    if sys.platform == "linux":
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        _, most = resource.getrlimit(resource.RLIMIT_AS)
        with suppress(ValueError, OSError):  # above a limit of this system
            resource.setrlimit(resource.RLIMIT_AS, (used + memory, most))
    # Replaces the limit of the start. It ends this process even while a library hangs, and if the
    # calling process has ended.
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        answer: tuple[bool, Any] = True, function(*arguments, **options)
    except Exception as error:  # noqa: BLE001 - raised again in the calling process
        answer = False, error
    pickle.dump(answer, results)
    results.flush()
    os._exit(0)  # after an error, HDF5 would crash while it closes its file
