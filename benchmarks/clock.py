"""Clock of the benchmarks: wall time, processor time and peak memory of a call.

This module imports no other benchmark, so that programs in other folders can use it too.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import psutil

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

_Result = TypeVar("_Result")
# Megabytes in the unit of ru_maxrss: bytes on macOS, KiB elsewhere.
_MEGABYTES = 1e-6 if sys.platform == "darwin" else 1024e-6
# Value of M_ARENA_MAX in glibc's malloc.h.
_ARENAS = -8


class Times(NamedTuple):
    """Times of a call, in seconds.

    Attributes
    ----------
    wall : float
        Elapsed time, which other programs on the machine increase.
    processor : float
        Processor time of all threads of this process, and of child processes that ended meanwhile.
    thread : float
        Processor time of the calling thread.
    """

    wall: float
    processor: float
    thread: float


def now() -> Times:
    """Return the present times, to subtract from later times."""
    return Times(time.perf_counter(), _processor_seconds(), time.thread_time())


def since(begun: Times) -> Times:
    """Return the times since a result of `now`."""
    ended = now()
    return Times(*(after - before for after, before in zip(ended, begun, strict=True)))


def timed(work: Callable[[], _Result]) -> tuple[_Result, Times]:
    """Return the result of a call and its times."""
    begun = now()
    result = work()
    return result, since(begun)


def fastest(work: Callable[[], _Result], count: int) -> tuple[_Result, Times]:
    """Return the last result of several calls, and the least of each time."""
    results, times = zip(*(timed(work) for _ in range(count)), strict=True)
    return results[-1], Times(*map(min, zip(*times, strict=True)))


def median_times(times: Sequence[Times]) -> Times:
    """Return the median of each time."""
    return Times(*(statistics.median(values) for values in zip(*times, strict=True)))


def repeated(
    work: Callable[[Any], object],
    prepare: Callable[[], Any] = lambda: None,
    *,
    seconds: float = 0.0,
    least: int = 1,
) -> Times:
    """Return the median times of several calls.

    Parameters
    ----------
    work : callable
        Called with the result of `prepare`.
    prepare : callable
        Called before each call of `work`, and not timed.
    seconds : float
        Wall time of all calls together, after which no further call starts.
    least : int
        Least number of calls.
    """
    times: list[Times] = []
    while len(times) < least or sum(each.wall for each in times) < seconds:
        given = prepare()
        times.append(timed(lambda given=given: work(given))[1])
    return median_times(times)


def _processor_seconds() -> float:
    children = 0.0
    if resource is not None:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        children = used.ru_utime + used.ru_stime
    return time.process_time() + children


def with_memory(work: Callable[[], _Result]) -> tuple[_Result, float]:
    """Return the result of a call, and the peak memory of this process above that before, in MB.

    Except on Linux, the result is too small if the memory was larger at an earlier time.
    """
    trim_memory()
    before = peak_megabytes(begin=True)
    result = work()
    return result, peak_megabytes() - before


def peak_megabytes(begin: bool = False) -> float:
    """Return the peak memory of this process in MB, or NaN if it is unknown.

    On Linux, the peak is measured since the last call with `begin`; elsewhere since the start.
    """
    if resource is None:
        return math.nan
    status = Path("/proc/self/status")
    if status.exists():
        if begin:
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        lines = status.read_text(encoding="ascii").splitlines()
        kibibytes = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))
        return 1024e-6 * kibibytes
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _MEGABYTES


class MemoryGrowth:
    """Memory of this process after each of many steps.

    Parameters
    ----------
    warm_up : int
        Number of first steps whose growth does not count.
    """

    def __init__(self, warm_up: int) -> None:
        self._left, self._start, self._most = warm_up, 0, 0

    def measure(self) -> None:
        """Note the memory after a step."""
        size = int(psutil.Process().memory_info().rss)
        if self._left > 0:
            self._left, self._start, self._most = self._left - 1, size, size
        self._most = max(self._most, size)

    @property
    def megabytes(self) -> float:
        """Largest memory since the end of the warm-up, above the memory at its end, in MB."""
        return (self._most - self._start) / 1e6


def peak_of_programs() -> float:
    """Return the peak memory of the largest child process that has ended, in MB."""
    if resource is None:
        return math.nan
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * _MEGABYTES


def one_heap() -> None:
    """Make threads that start from now on share a heap, so that freed memory can be returned."""
    with contextlib.suppress(OSError, TypeError, AttributeError):  # only glibc has this function
        ctypes.CDLL(None).mallopt(_ARENAS, 1)


def trim_memory() -> None:
    """Return freed memory to the system, so that later peaks start from memory in use."""
    gc.collect()
    with contextlib.suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def machine() -> str:
    """Return a line about the processor, the system and the versions."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.split(": ")[1] for line in lines if line.startswith("model name"))
    except (OSError, StopIteration, IndexError):
        pass
    return (
        f"{name}, {os.cpu_count()} cores, {platform.system()}, Python "
        f"{platform.python_version()}, NumPy {np.__version__}"
    )


def load() -> float | None:
    """Return the load average over the last minute, or None if it is unknown."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def conditions() -> str:
    """Return a line about the machine and its load, for the head of a table."""
    busy = load()
    return machine() + ("" if busy is None else f"; load {busy:.1f}")
