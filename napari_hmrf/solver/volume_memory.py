"""Check for sufficient memory to solve a volume, before any memory is allocated."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import psutil

from napari_hmrf.compute.workspace import clear_large
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import grid_in_words
from napari_hmrf.solver.priors import NeoHookeanPrior, Prior
from napari_hmrf.solver.problem import Problem

if sys.platform != "win32":
    import resource

#: Bytes per voxel that a solve needs in addition to the problem.
ORDINARY = 112
#: Bytes per voxel that a solve needs if its cycles continue in double precision.
IN_DOUBLE = 256
#: Additional bytes per voxel while the forces of loads are computed.
LOADED = 48
#: Additional bytes per voxel for the responses to a drift, and while they are computed.
DRIFTING = 224
#: Additional bytes per voxel of the unfolded grid for parts that slide in large motion; measured as
#: 1,200 to 2,500 for balls of a third of the volume.
SLIDING_FAR = 2500
#: Bytes per voxel of a study from its image to its result: the interpretation of its tissue and
#: boundary conditions, the problem and the solve, for a volume full of tissue; measured as 183.
STUDY = 190
#: Bytes per voxel of a moved image, while it is computed.
WARP = 60
#: Bytes per voxel of a registration of two volumes, from the images to the result.
REGISTRATION = 430
# Fraction of the free memory that a solve may use.
_FREE = 0.9
_GIB = 2.0**30
#: Words for every n-th voxel.
_EVERY = {2: "second", 3: "third"}


def check_memory(problem: Problem, prior: Prior | None = None) -> None:
    """Raise an error if the solve of a volume does not fit into memory.

    Parameters
    ----------
    problem : Problem
    prior : Prior, optional

    Raises
    ------
    ProblemError
        If the memory is not sufficient; the message gives the largest possible size and a remedy.
    """
    bytes_per_voxel: float = ORDINARY if problem.loads is None else ORDINARY + LOADED
    if problem.landmarks is not None and problem.landmarks.drift:
        bytes_per_voxel = ORDINARY + LOADED + DRIFTING
    shape = problem.shape
    if problem.coupling is not None:
        if isinstance(prior, NeoHookeanPrior):
            bytes_per_voxel += SLIDING_FAR
        shape = problem.coupling.stiffness.shape
    bytes_per_voxel *= math.prod(problem.shape) / math.prod(shape)
    _require("stiffness", shape, bytes_per_voxel, _available)


def require_memory(shape: tuple[int, ...], bytes_per_voxel: float, name: str = "image") -> None:
    """Raise an error if the work on a volume will not fit into memory, before any of its arrays.

    The memory that this process uses already counts as free, because a new study replaces the last.

    Parameters
    ----------
    shape : tuple of int
        Number of pixels along each axis; images are always accepted.
    bytes_per_voxel : float
        `STUDY` or `REGISTRATION`.
    name : str
        Name of the image or its file, for the error message.

    Raises
    ------
    ProblemError
        As for `check_memory`.
    """
    _require(name, shape, bytes_per_voxel, lambda: _available() + _used())


def _require(
    name: str, shape: tuple[int, ...], bytes_per_voxel: float, free: Callable[[], float]
) -> None:
    needed = bytes_per_voxel * math.prod(shape)
    if len(shape) != 3 or needed <= _FREE * free():
        return
    clear_large()
    allowed = _FREE * free()
    if needed <= allowed:
        return
    side = int((allowed / bytes_per_voxel) ** (1 / 3))
    step = math.ceil((needed / allowed) ** (1 / 3))
    every = _EVERY.get(step, f"{step}th")
    raise ProblemError(
        name,
        f"is a volume, {grid_in_words(shape)}, which needs {needed / _GIB:.2g} GiB of memory, but "
        f"only {allowed / _GIB:.2g} GiB are free. A volume of {side} x {side} x {side} voxels "
        f"would fit: crop the volume, or use every {every} voxel along each axis.",
    )


def make_room(shape: tuple[int, ...], bytes_per_voxel: float) -> None:
    """Delete the caches of earlier solves if the next work on a volume would not fit beside them.

    Parameters
    ----------
    shape : tuple of int
        Number of pixels along each axis.
    bytes_per_voxel : float
        Bytes that the work needs.
    """
    if len(shape) == 3 and not fits(shape, bytes_per_voxel):
        clear_large()


def fits(shape: tuple[int, ...], bytes_a_voxel: float) -> bool:
    """Return whether enough memory is free for a given number of bytes per voxel of a grid."""
    return bool(bytes_a_voxel * math.prod(shape) <= _FREE * _available())


def _available() -> float:
    """Return the number of bytes that this process can allocate, within its limit."""
    free = float(psutil.virtual_memory().available)
    if sys.platform != "win32":
        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            free = min(free, max(limit - psutil.Process().memory_info().vms, 0))
    return free


def _used() -> float:
    return float(psutil.Process().memory_info().rss)
