"""Looking up what labels mean, in images too large to sort."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

#: Label values that span less than this are looked up in a table.
_TABLE = 2**16


def labels_present(labels: npt.ArrayLike) -> npt.NDArray[Any]:
    """List the values in a label image, in order.

    As `numpy.unique`, without sorting every pixel where values lie close together.

    Parameters
    ----------
    labels : array_like of int or bool

    Returns
    -------
    ndarray, shape (N,)
        Of the type of `labels`.
    """
    image = np.asarray(labels)
    if image.dtype.kind not in "iu" or not image.size:
        return np.unique(image)
    lowest, highest = int(image.min()), int(image.max())
    if highest - lowest >= _TABLE:
        return np.unique(image)
    there = np.zeros(highest - lowest + 1, dtype=bool)
    there[_offsets(image, lowest)] = True
    present = [lowest + int(above) for above in np.flatnonzero(there)]
    return np.array(present, dtype=image.dtype)


def values_at(
    image: npt.NDArray[Any], present: npt.NDArray[Any], values: npt.NDArray[np.float32]
) -> npt.NDArray[np.float32]:
    """Give every pixel the value of its label.

    Parameters
    ----------
    image : ndarray of int or bool
    present : ndarray, shape (N,)
        Its labels, in order.
    values : ndarray, shape (N,), float32

    Returns
    -------
    ndarray, float32
        Of the shape of `image`.
    """
    if image.dtype.kind in "iu" and len(present):
        lowest, highest = int(present[0]), int(present[-1])
        if highest - lowest < _TABLE:
            table = np.zeros(highest - lowest + 1, dtype=np.float32)
            table[_offsets(present, lowest)] = values
            return np.asarray(table[_offsets(image, lowest)])
    return np.asarray(values[np.searchsorted(present, image)])


def _offsets(labels: npt.NDArray[Any], lowest: int) -> npt.NDArray[Any]:
    """How far labels are above the lowest, in a type that holds it."""
    if lowest == 0:
        return labels
    # Modulo the type's size, where a difference overflows: a small one comes out right.
    unsigned = np.dtype(f"u{labels.dtype.itemsize}")
    with np.errstate(over="ignore"):
        apart = labels.astype(unsigned) - np.array(lowest, labels.dtype).astype(unsigned)
    return np.asarray(apart.astype(np.int64))
