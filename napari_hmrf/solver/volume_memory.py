"""Check for sufficient memory to solve a volume, before any memory is allocated."""

from __future__ import annotations

import math

import psutil

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.backends import volume_caches
from napari_hmrf.solver.problem import Problem, grid_in_words

#: Bytes per voxel that a solve needs in addition to the problem.
ORDINARY = 112
#: Bytes per voxel that a solve needs if its cycles continue in double precision.
IN_DOUBLE = 256
#: Additional bytes per voxel while the forces of loads are computed.
LOADED = 48
#: Additional bytes per voxel for the responses to a drift, and while they are computed.
DRIFTING = 224
# Fraction of the free memory that a solve may use.
_FREE = 0.9
_GIB = 2.0**30


def check_memory(problem: Problem) -> None:
    """Raise an error if the solve of a volume does not fit into memory.

    Raises
    ------
    ProblemError
        If the memory is not sufficient; the message gives the largest possible size and a remedy.
    """
    bytes_per_voxel = ORDINARY if problem.loads is None else ORDINARY + LOADED
    if problem.landmarks is not None and problem.landmarks.drift:
        bytes_per_voxel = ORDINARY + LOADED + DRIFTING
    if not problem.is_volume or fits(problem.shape, bytes_per_voxel):
        return
    volume_caches.clear_all()
    if fits(problem.shape, bytes_per_voxel):
        return
    needed, free = (
        bytes_per_voxel * math.prod(problem.shape),
        _FREE * psutil.virtual_memory().available,
    )
    side = int((free / bytes_per_voxel) ** (1 / 3))
    raise ProblemError(
        "stiffness",
        f"is a volume, {grid_in_words(problem.shape)}, which needs {needed / _GIB:.2g} GiB of "
        f"memory to solve, but only {free / _GIB:.2g} GiB are free. A volume of {side} x "
        f"{side} x {side} voxels would fit: crop the volume, or use every second voxel along each "
        "axis, which needs an eighth of the memory.",
    )


def fits(shape: tuple[int, ...], bytes_a_voxel: float) -> bool:
    """Return whether enough memory is free for a given number of bytes per voxel of a grid."""
    return bool(bytes_a_voxel * math.prod(shape) <= _FREE * psutil.virtual_memory().available)
