"""State of the compiled loops in this process.

Compiling all loops takes a minute or more. In the process of a window, compilation would hold the
GIL, so another process compiles the loops (`compile_cache.compiler`) and numba stores them on disk
(`compile_cache.disk_cache`). Until the loops are ready, shaders solve, and `backends.arrays`
performs the host's part in NumPy. A process that has started without compiled loops loads them in
the background (`compile_cache.loader`) and switches to them between two solves.

If the environment contains ``NAPARI_HMRF_COMPILE=here``, no other process is started, and each
solve compiles the loops that it requires. This mode is for batch jobs and tests.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

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


@dataclass
class _Part:
    """State of one group of loops in this process."""

    #: True if this process computes with the compiled loops.
    in_use: bool = False
    #: True if this process has started to compute without the compiled loops.
    begun_without: bool = False


class _State:
    """State of all groups of loops in this process."""

    solver = _Part()
    pictures = _Part()
    #: True if this process compiles the loops because no other process can.
    alone = False


def compile_here() -> bool:
    """Return whether this process compiles the loops that it requires."""
    return _State.alone or os.environ.get(HERE) == "here"


def compile_alone() -> None:
    """Make this process compile the loops that it requires from now on."""
    _State.alone = True


def in_use() -> bool:
    """Return whether this process solves with the compiled loops."""
    return _State.solver.in_use or compile_here()


def use() -> None:
    """Solve with the loops from now on, compiling them if necessary."""
    _State.solver.in_use = True


def ready() -> bool:
    """Return whether the loops can solve now; if so, this process uses them from now on."""
    return _ready(_State.solver)


def ready_for_pictures() -> bool:
    """Return whether loops can warp pictures now; if so, use them in this process from now on."""
    return _ready(_State.pictures, sets.PICTURES)


def are_compiled(job: str) -> bool:
    """Return whether the loops of a job need not be compiled by another process."""
    return compile_here() or disk_cache.compiled(job)


def ready_for_volumes() -> bool:
    """Return whether the loops can solve volumes now."""
    return are_compiled(sets.VOLUMES)


def _ready(part: _Part, job: str = "") -> bool:
    """Return whether a group of loops can be used now, and record the result."""
    # Loading the loops takes as long as computing a few pictures. This delay is acceptable in a
    # process that has not computed yet. Later, the delay would interrupt a drag, so the loops are
    # loaded in the background.
    if part.in_use or compile_here():
        return True
    if part.begun_without:
        part.in_use = disk_cache.mark().exists() and loader.loaded()
    else:
        part.in_use = disk_cache.compiled(job)
        part.begun_without = not part.in_use
    return part.in_use


def only_read(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a read-only, C-contiguous view, or a copy of values in another order.

    Numba compiles a loop again for writable arrays and for each other order of memory. With this
    function, a loop is compiled once, whatever arrays a user passes.
    """
    view = np.ascontiguousarray(values).view()
    view.setflags(write=False)
    return view
