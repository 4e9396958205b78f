"""The place of a slice as a file says it, checked before anything is made of it."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.layers.slice_view import is_unit, unit_factor
from napari_hmrf.layers.transform import Matrix, flat, floats, floats_or_rows, rows

#: Slices beyond this are nobody's.
_FARTHEST = 2**31


def stored_place(values: Mapping[str, Any]) -> dict[str, Any]:
    """The attributes of a `Frame` from what its `as_dict` made, on which a layer can lie.

    Raises
    ------
    KeyError
        If one lacks.
    ValueError, TypeError, AttributeError, OverflowError
        If one is not what it should be.
    """
    index = _indices("index", values["index"])
    plane = _indices("plane", values["plane"])
    ndim = len(index)
    if len(plane) != 2 or plane[0] == plane[1] or not all(0 <= axis < ndim for axis in plane):
        raise ValueError(f"its plane is {plane} of {ndim} axes")
    scale = floats(_numbers("scale", values["scale"], (ndim,)))
    if 0 in scale:
        raise ValueError(f"its scale is {scale}")
    shear = values["shear"]
    sheared = (ndim, ndim) if np.ndim(shear) == 2 else (ndim * (ndim - 1) // 2,)
    units = _words("units", values["units"], ndim)
    unknown = [unit for unit in units if not is_unit(unit)]
    if unknown or np.isnan(unit_factor(units[plane[1]], units[plane[0]])):
        raise ValueError(f"its units are {units}")
    return {
        "plane": (plane[0], plane[1]),
        "index": index,
        "scale": scale,
        "translate": floats(_numbers("translate", values["translate"], (ndim,))),
        "rotate": _matrix("rotate", values["rotate"], ndim, homogeneous=False),
        "shear": floats_or_rows(_numbers("shear", shear, sheared)),
        "affine": _matrix("affine", values["affine"], ndim + 1, homogeneous=True),
        "units": units,
        "axis_labels": _words("axis labels", values["axis_labels"], ndim),
        "matrix": _matrix("matrix", values["matrix"], ndim + 1, homogeneous=True),
    }


def _indices(what: str, values: Any) -> tuple[int, ...]:
    """Whole numbers from a file; ValueError if they are not."""
    found = tuple(operator.index(value) for value in values)
    if not all(abs(value) < _FARTHEST for value in found):
        raise ValueError(f"its {what} is {found}")
    return found


def _numbers(what: str, values: Any, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Finite numbers of a shape from a file; ValueError if they are not."""
    found = np.array(values, dtype=float)
    if found.shape != shape:
        raise ValueError(f"its {what} is of shape {found.shape} where {shape} belongs")
    if not np.isfinite(found).all():
        raise ValueError(f"its {what} holds what is not a number")
    return found


def _matrix(what: str, values: Any, size: int, homogeneous: bool) -> Matrix:
    """A matrix that can be inverted, from a file; ValueError if it is not one."""
    found = _numbers(what, values, (size, size))
    linear = found[:-1, :-1] if homogeneous else found
    if homogeneous and found[-1].tolist() != [0.0] * (size - 1) + [1.0]:
        raise ValueError(f"the last row of its {what} is {found[-1].tolist()}")
    if flat(linear):
        raise ValueError(f"its {what} flattens space")
    return rows(found)


def _words(what: str, values: Any, length: int) -> tuple[str, ...]:
    """So many strings from a file; ValueError if they are not."""
    if not isinstance(values, Sequence) or isinstance(values, str):
        raise ValueError(f"its {what} are {values!r}")
    if len(values) != length or not all(isinstance(value, str) for value in values):
        raise ValueError(f"its {what} are {values!r} where {length} words belong")
    return tuple(values)
