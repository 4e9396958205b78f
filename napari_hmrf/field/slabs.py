"""Slabs of a volume, with a check for cancellation before each slab."""

from __future__ import annotations

import math
from collections.abc import Iterator

from napari_hmrf.compute.thread import compute_thread

#: Number of voxels of a slab per core; the slowest loop processes them in a sixth of a second.
VOXELS = 2**20
#: Smallest number of planes per core. With fewer planes, sharing planes costs too much time.
_PLANES = 4


def slabs(shape: tuple[int, ...], cores: int = 1) -> Iterator[slice]:
    """Yield the slabs of a volume in order, with a check for cancellation before each slab.

    Parameters
    ----------
    shape : (int, int, int)
        Shape of the volume.
    cores : int
        Number of cores that process a slab together.

    Yields
    ------
    slice
        Range of planes.

    Raises
    ------
    Cancelled
        If the job was cancelled; see `ComputeThread.check_cancelled`.
    """
    planes = cores * max(_PLANES, VOXELS // max(1, math.prod(shape[1:])))
    for begin in range(0, shape[0], planes):
        compute_thread.check_cancelled()
        yield slice(begin, min(begin + planes, shape[0]))


def with_neighbours(slab: slice, depth: int) -> tuple[slice, slice]:
    """Return a slab with one more plane on each side, and the range of the slab within it.

    Parameters
    ----------
    slab : slice
        Range of planes.
    depth : int
        Number of planes of the volume, to which the result is clipped.

    Returns
    -------
    wide : slice
        Widened range of planes.
    inner : slice
        Range of the slab's planes within `wide`.
    """
    first, last = max(slab.start - 1, 0), min(slab.stop + 1, depth)
    return slice(first, last), slice(slab.start - first, slab.stop - first)
