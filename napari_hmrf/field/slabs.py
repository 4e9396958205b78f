"""Volumes a few planes at a time, so that whoever cancels does not wait for the rest."""

from __future__ import annotations

import math
from collections.abc import Iterator

from napari_hmrf.solver.backends.thread import compute_thread

#: Voxels that a core goes through in a sixth of a second by the slowest of the loops here, or less;
#: and planes below which a core makes too much of what it shares with its neighbours.
VOXELS, _PLANES = 2**20, 4


def slabs(shape: tuple[int, ...], cores: int = 1) -> Iterator[slice]:
    """Cut a volume into slabs of planes; before each, look whether the work is still wanted.

    Parameters
    ----------
    shape : (int, int, int)
    cores : int
        How many share a slab.

    Yields
    ------
    slice
        Of planes, in their order.

    Raises
    ------
    Cancelled
        As of `ComputeThread.look`.
    """
    planes = cores * max(_PLANES, VOXELS // max(1, math.prod(shape[1:])))
    for begin in range(0, shape[0], planes):
        compute_thread.look()
        yield slice(begin, min(begin + planes, shape[0]))


def with_neighbours(slab: slice, depth: int) -> tuple[slice, slice]:
    """A slab and a plane on either side, of a volume so deep; and where in that the slab is."""
    first, last = max(slab.start - 1, 0), min(slab.stop + 1, depth)
    return slice(first, last), slice(slab.start - first, slab.stop - first)
