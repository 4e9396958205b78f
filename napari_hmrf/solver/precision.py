"""Validation of the precision of a problem: a symmetric tensor at each site."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.real_arrays import as_numbers, check_finite, first_index

Float64Array = npt.NDArray[np.float64]

#: Largest precision, in the unit of stiffness times length^(n - 2) of a pixel, relative to the
#: stiffest tissue. An observation that is more certain should be prescribed.
MAX_PRECISION = 1e6
# Weak reference to the last tensors. Later problems with equal tensors use the same array, so that
# comparisons by identity usually suffice.
_last: list[weakref.ref[Any]] = []
# Largest asymmetry, and largest negative minor, relative to the largest component of the tensor.
_ROUNDING = 1e-5


def checked_precision(
    precision: npt.ArrayLike, tissue: npt.NDArray[np.bool_]
) -> Float64Array | None:
    """Return the tensor at each site, shape (H, W, 2, 2) or (D, H, W, 3, 3), 0 in void.

    The tensors have double precision: a tensor ``k n n^T`` rounded to single precision would also
    observe the other components, with a precision of about 1e-7 k.

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
    last = _last[0]() if _last else None
    if last is not None and are_equal(last, numbers) and not last[~tissue].any():
        known: Float64Array = last  # checked already
        return known
    given = np.array(numbers, dtype=np.float64)
    check_finite("precision", given)
    grid, axes = tissue.shape, tissue.ndim
    shapes = ((), grid, (*grid, axes), (*grid, axes, axes))
    if given.shape not in shapes:
        raise ProblemError(
            "precision",
            f"has shape {given.shape}, but stiffness has shape {grid}. Pass one number, or an "
            f"array of shape {grid}, {(*grid, axes)} (diagonal) or {(*grid, axes, axes)} (tensor).",
        )
    if given.ndim == axes + 2:
        tensor = given
        size = np.abs(tensor).max(axis=(-2, -1))
        askew = np.abs(tensor - tensor.swapaxes(-1, -2)).max(axis=(-2, -1)) > _ROUNDING * size
        if askew.any():
            raise ProblemError(
                "precision",
                f"is not symmetric at {first_index(askew)}. Pass a symmetric tensor at each site.",
            )
        tensor = (tensor + tensor.swapaxes(-1, -2)) / 2
    else:
        tensor = np.zeros((*grid, axes, axes))
        for axis in range(axes):
            tensor[..., axis, axis] = given[..., axis] if given.ndim == axes + 1 else given
    tensor[~tissue] = 0
    negative = _is_indefinite(tensor)
    if negative.any():
        raise ProblemError(
            "precision",
            f"is not positive semidefinite at {first_index(negative)}: it would push tissue away "
            "from the observation. Pass tensors whose eigenvalues are all 0 or above.",
        )
    if not tensor.any():
        return None
    if last is not None and are_equal(last, tensor):
        return np.asarray(last)
    tensor.setflags(write=False)
    _last[:] = [weakref.ref(tensor)]
    return tensor


def are_equal(one: npt.NDArray[Any] | None, other: npt.NDArray[Any] | None) -> bool:
    """Return whether two arrays are equal; most unequal arrays already differ in the middle."""
    if one is None or other is None or one is other:
        return one is other
    if one.shape != other.shape:
        return False
    middle = len(one) // 2
    return np.array_equal(one[middle], other[middle]) and np.array_equal(one, other)


def _is_indefinite(tensor: Float64Array) -> npt.NDArray[np.bool_]:
    """Return a mask of tensors with a negative principal minor beyond rounding."""
    axes = tensor.shape[-1]
    size = np.abs(tensor).max(axis=(-2, -1))
    indefinite = np.zeros(tensor.shape[:-2], np.bool_)
    for i in range(axes):
        own = tensor[..., i, i]
        indefinite |= own < -_ROUNDING * size
        for j in range(i):
            across = tensor[..., i, j]
            minor = own * tensor[..., j, j] - across**2
            indefinite |= minor < -_ROUNDING * size**2
    if axes == 3:
        whole = np.linalg.det(tensor)
        indefinite |= whole < -_ROUNDING * size**3
    return indefinite
