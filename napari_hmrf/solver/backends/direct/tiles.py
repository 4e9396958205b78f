"""Boxes of elements within a tile; these boxes have few different shapes (see `dissection`)."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

#: Number of elements along a side of the smallest boxes and along a side of a tile.
LEAF, TILE = 4, 16


class Merge(NamedTuple):
    """Merge of two neighbouring boxes of the same shape.

    Attributes
    ----------
    axis : int
        Axis along which the boxes are neighbours.
    own, size : int
        Number of interior components of the merged box and number of all its components. The
        interior components are first.
    first, second : ndarray of int
        Positions of the ring components of the first and the second box among all components.
    """

    axis: int
    own: int
    size: int
    first: Index
    second: Index


def merged(boxes: Float64Array, at: Index, merge: Merge) -> tuple[Float64Array, Index, int]:
    """Merge pairs of neighbouring boxes in a grid (tiles, rows, columns, ...).

    Returns
    -------
    front : ndarray
        Matrices of the merged boxes.
    numbers : ndarray of int
        Numbers of the components of the merged boxes.
    own : int
        Number of interior components.
    """
    one, two = (
        (slice(None), *(slice(None),) * merge.axis, slice(start, None, 2)) for start in (0, 1)
    )
    numbers = np.empty((*at[one].shape[:-1], merge.size), dtype=at.dtype)
    front = np.zeros((*numbers.shape, merge.size))
    for part, place in ((one, merge.first), (two, merge.second)):
        numbers[..., place] = at[part]
        front[..., place[:, None], place] += boxes[part]
    return front, numbers, merge.own


def ring(height: int, width: int, patch: int) -> Index:
    """Return the sites of a box that it may share with other boxes, in row-major order."""
    over = patch - 1
    inner = np.ones((height + over, width + over), dtype=bool)
    inner[over:height, over:width] = False
    return np.flatnonzero(inner)


def own(height: int, width: int, patch: int) -> Index:
    """Return the interior sites of a box, which no other box contains, in row-major order."""
    over = patch - 1
    return np.setdiff1d(np.arange((height + over) * (width + over)), ring(height, width, patch))


def components(sites: Index, fields: int) -> Index:
    """Return the numbers of the components of sites."""
    return np.asarray((sites[:, None] * fields + np.arange(fields)).ravel())


@lru_cache(maxsize=8)
def merges(patch: int, fields: int) -> tuple[Merge, ...]:
    """Return the merges from the smallest boxes to a tile, in the order of their execution."""
    made, size, over = [], [LEAF, LEAF], patch - 1
    while size != [TILE, TILE]:
        axis = int(size[1] == size[0])
        row, col = np.divmod(ring(size[0], size[1], patch), size[1] + over)
        shift = [0, 0]
        shift[axis] = size[axis]
        size[axis] *= 2
        width = size[1] + over
        first, second = row * width + col, (row + shift[0]) * width + col + shift[1]
        outside = ring(size[0], size[1], patch)
        inside = np.setdiff1d(np.union1d(first, second), outside)
        order = np.concatenate([inside, outside])
        place = np.zeros(width * (size[0] + over), dtype=np.intp)
        place[order] = np.arange(len(order))
        both = (components(place[sites], fields) for sites in (first, second))
        made.append(Merge(axis, fields * len(inside), fields * len(order), *both))
    return tuple(made)
