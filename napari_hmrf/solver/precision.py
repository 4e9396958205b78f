"""Validation of the precision of a problem: a symmetric tensor at each site."""

from __future__ import annotations

import math
import weakref
from itertools import combinations, product
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import are_equal, as_numbers, check_finite, first_index

Tensors = npt.NDArray[np.floating]

#: Largest precision, in the unit of stiffness times length^(n - 2) of a pixel, relative to the
#: stiffest tissue. An observation that is more certain should be prescribed.
MAX_PRECISION = 1e6
# Last tensors, on any thread. Later problems with equal tensors use the same array, so that
# comparisons by identity usually suffice.
_tensors: Kept[weakref.ref[Any]] = Kept()
# Number of sites that are checked at once, so that temporary arrays stay in the cache.
_BLOCK_SIZE = 16384
# Largest asymmetry, and largest negative minor, relative to the largest component of the tensor.
_ROUNDING = 1e-5


def checked_precision(precision: npt.ArrayLike, tissue: npt.NDArray[np.bool_]) -> Tensors | None:
    """Return the tensor at each site, shape (H, W, 2, 2) or (D, H, W, 3, 3), 0 in void.

    The tensors have double precision, unless they were given in single precision: a tensor
    ``k n n^T`` that is rounded would also observe the other components, with a precision of about
    1e-7 k. An array in single or double precision that is read-only and owns its data is not
    copied.

    Parameters
    ----------
    precision : array_like
        One number for all sites or for each site, the diagonal for each site, or the whole tensor.
    tissue : ndarray of bool, shape (H, W) or (D, H, W)

    Returns
    -------
    ndarray or None
        None if the precision is 0 everywhere in tissue.

    Raises
    ------
    ProblemError
        If the shape is wrong, a value is not finite, or a tensor is not symmetric and positive
        semidefinite.
    """
    numbers = as_numbers("precision", precision)
    kept = _tensors.value
    last = None if kept is None else kept()
    if last is not None and are_equal(last, numbers) and not last[~tissue].any():
        known: Tensors = last  # checked already
        return known
    kind = np.float32 if numbers.dtype == np.float32 else np.float64
    is_frozen = numbers.dtype == kind and numbers.flags.owndata and not numbers.flags.writeable
    given: Tensors = numbers if is_frozen else np.array(numbers, dtype=kind)
    check_finite("precision", given)
    grid, axes = tissue.shape, tissue.ndim
    shapes = ((), grid, (*grid, axes), (*grid, axes, axes))
    if given.shape not in shapes:
        raise ProblemError(
            "precision",
            f"has shape {given.shape}, but stiffness has shape {grid}. Pass one number, or an "
            f"array of shape {grid}, {(*grid, axes)} (diagonal) or {(*grid, axes, axes)} (tensor).",
        )
    tensor: Tensors = given if given.ndim == axes + 2 else np.zeros((*grid, axes, axes), kind)
    if tensor is not given:
        for axis in range(axes):
            tensor[..., axis, axis] = given[..., axis] if given.ndim == axes + 1 else given
    step = max(1, _BLOCK_SIZE // math.prod(grid[1:]))
    for begin in range(0, grid[0], step):
        block = slice(begin, begin + step)
        part = tensor[block].astype(np.float64)
        part[~tissue[block]] = 0
        _check_tensors(part, begin)
        if (part != tensor[block]).any():
            if not tensor.flags.writeable:
                tensor = tensor.copy()
            tensor[block] = part
    if not tensor.any():
        return None
    if last is not None and are_equal(last, tensor):
        return np.asarray(last)
    tensor.setflags(write=False)
    _tensors.value = weakref.ref(tensor)
    return tensor


def _check_tensors(tensors: Tensors, begin: int) -> None:
    """Make tensors symmetric in place, and raise an error if they are asymmetric or indefinite.

    Differences up to rounding are accepted.

    Parameters
    ----------
    tensors : ndarray, shape (h, W, 2, 2) or (d, H, W, 3, 3)
    begin : int
        Index of the first row or plane, for the message.
    """
    axes = tensors.shape[-1]
    size = np.abs(tensors[..., 0, 0])
    for i, j in product(range(axes), repeat=2):
        np.maximum(size, np.abs(tensors[..., i, j]), out=size)
    askew = np.zeros(size.shape, np.bool_)
    for i, j in combinations(range(axes), 2):
        one, other = tensors[..., i, j], tensors[..., j, i]
        askew |= np.abs(one - other) > _ROUNDING * size
        tensors[..., i, j] = tensors[..., j, i] = (one + other) / 2
    if askew.any():
        raise ProblemError(
            "precision",
            f"is not symmetric at {_index_of(askew, begin)}. Pass a symmetric tensor at each site.",
        )
    negative = _is_indefinite(tensors, size)
    if negative.any():
        raise ProblemError(
            "precision",
            f"is not positive semidefinite at {_index_of(negative, begin)}: it would push tissue "
            "away from the observation. Pass tensors whose eigenvalues are all 0 or above.",
        )


def _index_of(mask: npt.NDArray[np.bool_], begin: int) -> tuple[int, ...]:
    first, *others = first_index(mask)
    return first + begin, *others


def _is_indefinite(tensors: Tensors, size: Tensors) -> npt.NDArray[np.bool_]:
    """Return a mask of tensors with a negative principal minor beyond rounding.

    Parameters
    ----------
    tensors : ndarray, shape (..., n, n)
    size : ndarray
        Largest component of each tensor.
    """
    axes = tensors.shape[-1]
    least = -_ROUNDING * size
    a = [[np.ascontiguousarray(tensors[..., i, j]) for j in range(axes)] for i in range(axes)]
    indefinite = np.zeros(size.shape, np.bool_)
    for i in range(axes):
        indefinite |= a[i][i] < least
        for j in range(i):
            indefinite |= a[i][i] * a[j][j] - a[i][j] ** 2 < least * size
    if axes == 3:
        whole = a[0][0] * (a[1][1] * a[2][2] - a[1][2] ** 2)
        whole -= a[0][1] * (a[0][1] * a[2][2] - a[1][2] * a[0][2])
        whole += a[0][2] * (a[0][1] * a[1][2] - a[1][1] * a[0][2])
        indefinite |= whole < least * size**2
    return indefinite
