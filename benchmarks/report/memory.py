"""Peak memory of a process, if the operating system reports it."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import sys
from pathlib import Path

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
