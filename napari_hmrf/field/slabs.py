"""Slabs of a volume, between which a job can be cancelled."""

from __future__ import annotations

import math
from collections.abc import Iterator

from napari_hmrf.solver.backends.thread import compute_thread

#: Number of voxels of a slab per core; the slowest loop takes a sixth of a second for them.
VOXELS = 2**20
#: Smallest number of planes per core; with fewer, the planes shared by two cores cost too much.
_PLANES = 4


def slabs(shape: tuple[int, ...], cores: int = 1) -> Iterator[slice]:
    """Yield the slabs of a volume in their order, and check for cancellation before each.

    Parameters
    ----------
    shape : (int, int, int)
        Shape of the volume.
    cores : int
        Number of cores that share a slab.

    Yields
    ------
    slice
        Range of planes.

    Raises
    ------
    Cancelled
        If the job was cancelled, as by `ComputeThread.check_cancelled`.
    """
    planes = cores * max(_PLANES, VOXELS // max(1, math.prod(shape[1:])))
    for begin in range(0, shape[0], planes):
        compute_thread.check_cancelled()
        yield slice(begin, min(begin + planes, shape[0]))


def with_neighbours(slab: slice, depth: int) -> tuple[slice, slice]:
    """Return a slab widened by a plane on either side, and the place of the slab in that.

    Parameters
    ----------
    slab : slice
        Range of planes.
    depth : int
        Number of planes of the volume, to which the result is limited.

    Returns
    -------
    wide : slice
        Widened range of planes.
    inner : slice
        Range of the slab's planes within `wide`.
    """
    first, last = max(slab.start - 1, 0), min(slab.stop + 1, depth)
    return slice(first, last), slice(slab.start - first, slab.stop - first)
