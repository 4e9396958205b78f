"""Sites and the elements between them: blocks of two sites along each axis.

An element has the index of its first site, so that there is one less along each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[Any]


def pairs(ndim: int) -> Iterator[tuple[Any, Any]]:
    """Along each axis, the index of all sites but the last, and of all but the first."""
    for axis in range(ndim):
        before = (slice(None),) * axis
        yield (*before, slice(None, -1)), (*before, slice(1, None))


def of_corners(values: Values, combine: Callable[[Values, Values], Values]) -> Values:
    """What is made of each element's corners, two and two of them."""
    return reduce(
        lambda made, ends: combine(made[ends[0]], made[ends[1]]), pairs(values.ndim), values
    )


def around_sites(values: Values, combine: Callable[[Values, Values], Values]) -> Values:
    """What is made of the elements around each site; beyond the grid they are 0."""
    return of_corners(np.pad(values, 1), combine)


def in_elements(m: Values) -> npt.NDArray[np.bool_]:
    """Which elements there are: those whose sites all are tissue."""
    return of_corners(m > 0, np.logical_and)
