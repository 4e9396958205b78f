"""Grid operations on sites and on the elements between them.

An element is a block of two sites along each axis. It has the index of its first site, so an array
of elements is one shorter along each axis than an array of sites.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[Any]


def pairs(ndim: int) -> Iterator[tuple[Any, Any]]:
    """Yield, for each axis, the index of all sites except the last, and of all except the first."""
    for axis in range(ndim):
        before = (slice(None),) * axis
        yield (*before, slice(None, -1)), (*before, slice(1, None))


def of_corners(values: Values, combine: Callable[[Values, Values], Values]) -> Values:
    """Combine the values at the corners of each element, in pairs along each axis in turn."""
    return reduce(
        lambda combined, ends: combine(combined[ends[0]], combined[ends[1]]),
        pairs(values.ndim),
        values,
    )


def corner_slices(elements: tuple[int, ...]) -> Iterator[tuple[slice, ...]]:
    """Yield, for each corner of the elements, the index of the sites at this corner.

    Parameters
    ----------
    elements : tuple of int
        Number of elements along each axis.
    """
    for corner in np.ndindex(*(2,) * len(elements)):
        yield tuple(slice(end, end + size) for end, size in zip(corner, elements, strict=True))


def around_sites(values: Values, combine: Callable[[Values, Values], Values]) -> Values:
    """Combine the values of the elements around each site; elements beyond the grid count as 0."""
    return of_corners(np.pad(values, 1), combine)


def in_elements(m: Values) -> npt.NDArray[np.bool_]:
    """Return a mask of the tissue elements, which have tissue at all corners.

    Parameters
    ----------
    m : ndarray, shape (H, W) or (D, H, W)
        Stiffness, or a mask; above 0 in tissue.

    Returns
    -------
    ndarray of bool, shape (H - 1, W - 1) or (D - 1, H - 1, W - 1)
    """
    return of_corners(m > 0, np.logical_and)


def sites_of_elements(m: Values) -> npt.NDArray[np.bool_]:
    """Return a mask of the sites at a corner of a tissue element, of the shape of `m`.

    Other tissue has no energy. It follows the tissue near it; see `followers`.
    """
    return around_sites(in_elements(m), np.logical_or)
