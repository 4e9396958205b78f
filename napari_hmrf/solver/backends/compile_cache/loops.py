"""The loops for the processor: whether this process computes with them.

To compile them all takes a minute or more, and beside a window it competes for the interpreter's
lock. So another process does it (`backends.compiler`), numba keeps on disk what it has made
(`backends.kept`), and until then shaders solve, and `backends.arrays` does the host's
part. A process that has begun so has the loops loaded beside its work (`backends.loader`), and goes
over to them between two solves.

With ``NAPARI_HMRF_COMPILE=here`` in the environment no other process is started: a solve compiles
the loops that it needs. This mode is for batches and for tests.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy.typing as npt

from napari_hmrf.solver.backends.compile_cache import kept, loader, sets

__all__ = [
    "HERE",
    "compile_here",
    "in_use",
    "only_read",
    "ready",
    "ready_for_pictures",
    "ready_for_volumes",
    "use",
]

#: Environment variable that makes each process compile for itself, if it is "here".
HERE = "NAPARI_HMRF_COMPILE"


@dataclass
class _Part:
    """Some loops, and what this process has done where they are needed."""

    #: True if this process computes with them.
    in_use: bool = False
    #: True if this process has computed anything without them.
    begun_without: bool = False


class _State:
    """State of this process."""

    solver = _Part()
    pictures = _Part()
    #: True if this process compiles for itself, as no other process can.
    alone = False


def compile_here() -> bool:
    """Return whether this process compiles for itself."""
    return _State.alone or os.environ.get(HERE) == "here"


def compile_alone() -> None:
    """Let this process compile for itself from now on."""
    _State.alone = True


def in_use() -> bool:
    """Return whether this process solves with loops, or would compile them itself."""
    return _State.solver.in_use or compile_here()


def use() -> None:
    """Solve with loops from now on, compiled or not."""
    _State.solver.in_use = True


def ready() -> bool:
    """Return whether loops can solve at once; if so, they do from now on."""
    return _ready(_State.solver)


def ready_for_pictures() -> bool:
    """Return whether loops can move pictures at once; if so, they do from now on."""
    return _ready(_State.pictures, sets.PICTURES)


def ready_for_volumes() -> bool:
    """Return whether loops can solve volumes at once."""
    return compile_here() or kept.compiled(sets.VOLUMES)


def _ready(part: _Part, job: str = "") -> bool:
    """Return whether a part of the loops can be used."""
    # To load them takes as long as a few pictures. A process that has not computed yet does it when
    # it needs them; any other shall not stop for it in the middle of a drag.
    if part.in_use or compile_here():
        return True
    if part.begun_without:
        part.in_use = kept.mark().exists() and loader.loaded()
    else:
        part.in_use = kept.compiled(job)
        part.begun_without = not part.in_use
    return part.in_use


def only_read(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a read-only view, so that the loops see one type of array."""
    view = values.view()
    view.setflags(write=False)
    return view
