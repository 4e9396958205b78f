"""How much memory a process had at most, as far as the system tells."""

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

# Linux counts in KiB, macOS in bytes.
_PER_MEGABYTE = 1024**2 if sys.platform == "darwin" else 1024
# M_ARENA_MAX of glibc's malloc.h.
_ARENAS = -8


def peak_megabytes(begin: bool = False) -> float:
    """Peak memory of this process; on Linux since the last call with `begin`, else since its start.

    NaN where the system does not tell.
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
    """Peak memory of the largest program that this process has run to its end, in megabytes."""
    if resource is None:
        return math.nan
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / _PER_MEGABYTE


def one_heap() -> None:
    """Let threads that begin from now on share a heap: what it keeps can be given back."""
    with contextlib.suppress(OSError, TypeError, AttributeError):  # not of glibc
        ctypes.CDLL(None).mallopt(_ARENAS, 1)


def trim_memory() -> None:
    """Give back what was freed: a peak counts from what the process still has."""
    gc.collect()
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
