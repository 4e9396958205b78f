"""Whether there is the memory to solve a volume, before any of it is taken."""

from __future__ import annotations

import math

import psutil

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.backends import kept_volumes
from napari_hmrf.solver.problem import Problem, grid_in_words

#: Bytes a voxel that a solve takes beside the problem; and where cycles go on in double precision.
ORDINARY, IN_DOUBLE = 112, 256
#: What loads take beside that: the forces at each voxel, while they are made.
LOADED = 48
# The part of the memory that is free now that a solve may take.
_FREE = 0.9
_GIB = 2.0**30


def check_memory(problem: Problem) -> None:
    """Refuse a volume that there is no memory for.

    Raises
    ------
    ProblemError
        Saying what would fit, and what to do.
    """
    each = ORDINARY if problem.loads is None else ORDINARY + LOADED
    if not problem.is_volume or fits(problem.shape, each):
        return
    kept_volumes.forget()
    if fits(problem.shape, each):
        return
    needed, free = each * math.prod(problem.shape), _FREE * psutil.virtual_memory().available
    side = int((free / each) ** (1 / 3))
    raise ProblemError(
        "stiffness",
        f"is a volume, {grid_in_words(problem.shape)}, which takes {needed / _GIB:.2g} GiB of "
        f"memory to solve, and {free / _GIB:.2g} GiB are free. As many voxels as in {side} x "
        f"{side} x {side} would fit: crop it, or take every second voxel along each axis, which "
        "takes an eighth of that.",
    )


def fits(shape: tuple[int, ...], bytes_a_voxel: float) -> bool:
    """Whether so much is free for each voxel."""
    return bool(bytes_a_voxel * math.prod(shape) <= _FREE * psutil.virtual_memory().available)
