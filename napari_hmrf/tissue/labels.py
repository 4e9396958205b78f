"""Looking up what labels mean, in images too large to sort."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

#: Labels below this are looked up in a table.
_TABLE = 2**16


def labels_present(labels: npt.ArrayLike) -> npt.NDArray[Any]:
    """List the values in a label image, in order.

    As `numpy.unique`, without sorting every pixel where the values are small.

    Parameters
    ----------
    labels : array_like of int or bool

    Returns
    -------
    ndarray, shape (N,)
        Of the type of `labels`.
    """
    image = np.asarray(labels)
    if image.dtype.kind not in "iu" or not image.size or image.min() < 0 or image.max() >= _TABLE:
        return np.unique(image)
    there = np.zeros(int(image.max()) + 1, dtype=bool)
    there[image] = True
    return np.flatnonzero(there).astype(image.dtype)


def unlisted(labels: npt.ArrayLike, rows: Iterable[Any]) -> list[int]:
    """List the labels that are somewhere, and in no row of a table."""
    return sorted({int(label) for label in labels_present(labels)} - {row.label for row in rows})


def values_at(
    image: npt.NDArray[Any], present: npt.NDArray[Any], values: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Give every pixel the value of its label, one of those `present`, which are in order."""
    if image.dtype.kind in "iu" and len(present) and present[0] >= 0 and present[-1] < _TABLE:
        table = np.zeros(int(present[-1]) + 1, dtype=np.float32)
        table[present] = values
        return np.asarray(table[image])
    return np.asarray(values[np.searchsorted(present, image)])
