"""State of the compiled loops in this process.

Compiling all loops takes minutes. In the process of a window, compilation would hold the GIL, so
another process compiles the loops (`compile_cache.compiler`), in the order in which they are needed
(`compile_cache.sets`), and numba stores them on disk (`compile_cache.disk_cache`). Until the loops
of a solve are ready, shaders solve, and `backends.arrays` performs the host's part in NumPy. A
process that has started without compiled loops loads them in the background
(`compile_cache.loader`) and switches to them between two solves.

If the environment contains ``NAPARI_HMRF_COMPILE=here``, no other process is started, and each
solve compiles the loops that it requires. This mode is for batch jobs and tests.
"""

from __future__ import annotations

import os
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import disk_cache, loader, sets

__all__ = [
    "HERE",
    "are_compiled",
    "compile_here",
    "in_use",
    "only_read",
    "ready",
    "ready_for_pictures",
    "ready_for_volumes",
    "use",
]

#: Environment variable; if its value is "here", each process compiles the loops that it requires.
HERE = "NAPARI_HMRF_COMPILE"


class _State:
    """State of the loops in this process."""

    #: True if the current solve uses the compiled loops.
    in_use = False
    #: Jobs whose loops this process uses.
    used: ClassVar[set[str]] = set()
    #: True if this process has started to compute without loops that were not compiled yet.
    begun_without = False
    #: True if this process compiles the loops because no other process can.
    alone = False


def compile_here() -> bool:
    """Return whether this process compiles the loops that it requires."""
    return _State.alone or os.environ.get(HERE) == "here"


def compile_alone() -> None:
    """Make this process compile the loops that it requires from now on."""
    _State.alone = True


def in_use() -> bool:
    """Return whether the current solve uses the compiled loops."""
    return _State.in_use or compile_here()


def use(are_used: bool = True) -> None:
    """Set whether the solve that begins uses the loops; missing loops are compiled when called."""
    _State.in_use = are_used


def ready(job: str) -> bool:
    """Return whether the loops of a job can be used without a delay.

    Loading the loops takes as long as computing a few pictures. This delay is acceptable in a
    process that has not computed yet. Later, the delay would interrupt a drag, so the loops are
    loaded in the background.
    """
    if compile_here() or job in _State.used:
        return True
    if not disk_cache.compiled(job):
        _State.begun_without = True
        return False
    if _State.begun_without and not loader.loaded(job):
        return False
    _State.used.add(job)
    return True


def ready_for_pictures() -> bool:
    """Return whether the loops can warp pictures now."""
    return ready(sets.PICTURES)


def are_compiled(job: str) -> bool:
    """Return whether the loops of a job need not be compiled by another process."""
    return compile_here() or disk_cache.compiled(job)


def ready_for_volumes() -> bool:
    """Return whether the loops can solve volumes now."""
    return are_compiled(sets.VOLUMES)


def only_read(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a read-only, C-contiguous view, or a copy of values in another order.

    Numba compiles a loop again for writable arrays and for each other order of memory. With this
    function, a loop is compiled once, whatever arrays a user passes.
    """
    view = np.ascontiguousarray(values).view()
    view.setflags(write=False)
    return view
