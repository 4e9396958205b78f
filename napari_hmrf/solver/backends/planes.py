"""Planes: fields on the host as float64 arrays with a border of zeros, two sites wide."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

#: Displacement or force, shape (2, H + 4, W + 4) or (3, D + 4, H + 4, W + 4).
Planes = npt.NDArray[np.float64]
#: Mask with one value for each component of each site, in the shape of `Planes`.
HeldPlanes = npt.NDArray[np.bool_]


def planes(values: npt.NDArray[Any]) -> Planes:
    """Copy values, shape (H, W, 2) or (D, H, W, 3), to new planes."""
    return _padded(values, np.float64)


def held_planes(held: npt.NDArray[np.bool_]) -> HeldPlanes:
    """Copy a mask of components, shape (H, W, 2) or (D, H, W, 3), to new planes."""
    return _padded(held, np.bool_)


def _padded(values: npt.NDArray[Any], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    shape = values.shape[-1], *(size + 4 for size in values.shape[:-1])
    made: npt.NDArray[Any] = np.zeros(shape, dtype)
    for plane, component in zip(inside(made), np.moveaxis(values, -1, 0), strict=True):
        plane[...] = component
    return made


def inside(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a view of planes without the border."""
    return values[(slice(None), *[slice(2, -2)] * (values.ndim - 1))]


def field(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a view of planes as a field without the border, shape (H, W, 2) or (D, H, W, 3)."""
    return np.moveaxis(inside(values), 0, -1)


def work_of(load: Planes | None, d: Planes) -> float:
    """Return the work done by forces over a displacement, in the model's units."""
    # `einsum`, because a large product in BLAS starts threads, which would occupy the cores that
    # the solve needs.
    return 0.0 if load is None else float(np.einsum("i,i->", load.ravel(), d.ravel()))
