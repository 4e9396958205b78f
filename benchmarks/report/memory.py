"""Peak memory of a process, if the operating system reports it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

# Unit of ru_maxrss: KiB on Linux, bytes on macOS.
_PER_MEGABYTE = 1024**2 if sys.platform == "darwin" else 1024
# Value of M_ARENA_MAX in glibc's malloc.h.
_ARENAS = -8


def peak_megabytes(begin: bool = False) -> float:
    """Return the peak memory of this process in MiB, or NaN if it is unknown.

    On Linux, the peak is measured since the last call with `begin`; elsewhere since the start.
    """
    if resource is None:
        return math.nan
    status = Path("/proc/self/status")
    if status.exists():
        if begin:
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        lines = status.read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / _PER_MEGABYTE


def added_by(work: Callable[[], Any]) -> tuple[Any, int, int]:
    """Run `work` while watching the memory of this process.

    Returns
    -------
    result : Any
        Result of `work`.
    added, peak : int
        Peak of the resident memory above that at the begin, and the peak, in bytes.
    """
    gc.collect()
    process, done = psutil.Process(), threading.Event()
    before = most = process.memory_info().rss

    def watch() -> None:
        nonlocal most
        while not done.wait(0.002):
            most = max(most, process.memory_info().rss)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        result = work()
    finally:
        done.set()
        watcher.join()
    return result, most - before, most


def peak_of_programs() -> float:
    """Return the peak memory of the largest child process that has ended, in MiB."""
    if resource is None:
        return math.nan
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / _PER_MEGABYTE


def one_heap() -> None:
    """Make threads that start from now on share a heap, so that freed memory can be returned."""
    with contextlib.suppress(OSError, TypeError, AttributeError):  # only glibc has this function
        ctypes.CDLL(None).mallopt(_ARENAS, 1)


def trim_memory() -> None:
    """Return freed memory to the system, so that later peaks start from memory in use."""
    gc.collect()
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
