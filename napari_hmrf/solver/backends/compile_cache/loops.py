"""State of the processor's loops: whether this process computes with them.

Compiling all loops takes a minute or more, and in the process of a window it would hold the
interpreter's lock. Another process therefore compiles them (`compile_cache.compiler`), and numba
stores them on disk (`compile_cache.disk_cache`). Until then shaders solve, and `backends.arrays`
does the host's part in NumPy. A process that has started without loops loads them in the background
(`compile_cache.loader`) and switches to them between two solves.

With ``NAPARI_HMRF_COMPILE=here`` in the environment no other process is started, and each solve
compiles the loops that it needs. This mode is for batches and tests.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

from napari_hmrf.solver.backends.compile_cache import disk_cache, loader, sets

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

#: Environment variable; with the value "here", each process compiles the loops that it needs.
HERE = "NAPARI_HMRF_COMPILE"


@dataclass
class _Part:
    """Use of a group of loops by this process."""

    #: True if this process computes with the loops.
    in_use: bool = False
    #: True if this process has begun to compute without the loops.
    begun_without: bool = False


class _State:
    """State of this process."""

    solver = _Part()
    pictures = _Part()
    #: True if this process compiles the loops, because no other process can.
    alone = False


def compile_here() -> bool:
    """Return whether this process compiles the loops that it needs."""
    return _State.alone or os.environ.get(HERE) == "here"


def compile_alone() -> None:
    """Let this process compile the loops that it needs from now on."""
    _State.alone = True


def in_use() -> bool:
    """Return whether this process solves with loops."""
    return _State.solver.in_use or compile_here()


def use() -> None:
    """Solve with loops from now on, compiled or not."""
    _State.solver.in_use = True


def ready() -> bool:
    """Return whether loops can solve now; if so, this process uses them from now on."""
    return _ready(_State.solver)


def ready_for_pictures() -> bool:
    """Return whether loops can warp pictures now; if so, this process uses them from now on."""
    return _ready(_State.pictures, sets.PICTURES)


def are_compiled(job: str) -> bool:
    """Return whether the loops of a job need no compilation by another process."""
    return compile_here() or disk_cache.compiled(job)


def ready_for_volumes() -> bool:
    """Return whether loops can solve volumes now."""
    return are_compiled(sets.VOLUMES)


def _ready(part: _Part, job: str = "") -> bool:
    """Return whether a group of loops can be used now, and record its use."""
    # Loading the loops takes as long as a few pictures. A process that has not computed yet can
    # afford this delay; later it would interrupt a drag, so they are loaded in the background.
    if part.in_use or compile_here():
        return True
    if part.begun_without:
        part.in_use = disk_cache.mark().exists() and loader.loaded()
    else:
        part.in_use = disk_cache.compiled(job)
        part.begun_without = not part.in_use
    return part.in_use


def only_read(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a read-only view, so that the loops see one type of array."""
    view = values.view()
    view.setflags(write=False)
    return view
