"""What says where a layer lies: as a value, and checked where it comes from a file."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Matrix = tuple[tuple[float, ...], ...]

#: The attributes of a layer, and keyword arguments of a new one, that say where it lies.
PLACE = ("scale", "translate", "rotate", "shear", "affine", "units", "axis_labels")

#: Slices beyond this are nobody's.
_FARTHEST = 2**31


def place_of(layer: Any) -> dict[str, Any]:
    """Keyword arguments that make a layer of the same axes lie where this one does."""
    return {name: getattr(layer, name) for name in PLACE}


def floats(values: Any) -> tuple[float, ...]:
    """A sequence of numbers."""
    return tuple(float(value) for value in values)


def rows(matrix: Any) -> Matrix:
    """The rows of a matrix."""
    return tuple(floats(row) for row in np.asarray(matrix))


def floats_or_rows(values: Any) -> tuple[float, ...] | Matrix:
    """A sequence of numbers or a matrix: napari keeps some shears as the one, some as the other."""
    return rows(values) if np.ndim(values) == 2 else floats(values)


def flat(linear: npt.NDArray[np.float64]) -> bool:
    """Whether a square matrix flattens space, whatever the lengths of its columns."""
    lengths = np.linalg.norm(linear, axis=0)
    if not ((lengths > 0) & np.isfinite(lengths)).all():
        return True
    return bool(np.linalg.matrix_rank(linear / lengths) < len(linear))


def stored_indices(what: str, values: Any) -> tuple[int, ...]:
    """Whole numbers from a file; ValueError if they are not."""
    found = tuple(operator.index(value) for value in values)
    if not all(abs(value) < _FARTHEST for value in found):
        raise ValueError(f"its {what} is {found}")
    return found


def stored_numbers(what: str, values: Any, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Finite numbers of a shape from a file; ValueError if they are not."""
    found = np.array(values, dtype=float)
    if found.shape != shape:
        raise ValueError(f"its {what} is of shape {found.shape} where {shape} belongs")
    if not np.isfinite(found).all():
        raise ValueError(f"its {what} holds what is not a number")
    return found


def stored_matrix(what: str, values: Any, size: int, homogeneous: bool) -> Matrix:
    """A matrix that can be inverted, from a file; ValueError if it is not one."""
    found = stored_numbers(what, values, (size, size))
    linear = found[:-1, :-1] if homogeneous else found
    if homogeneous and found[-1].tolist() != [0.0] * (size - 1) + [1.0]:
        raise ValueError(f"the last row of its {what} is {found[-1].tolist()}")
    if flat(linear):
        raise ValueError(f"its {what} flattens space")
    return rows(found)


def stored_words(what: str, values: Any, length: int) -> tuple[str, ...]:
    """So many strings from a file; ValueError if they are not."""
    if not isinstance(values, Sequence) or isinstance(values, str):
        raise ValueError(f"its {what} are {values!r}")
    if len(values) != length or not all(isinstance(value, str) for value in values):
        raise ValueError(f"its {what} are {values!r} where {length} words belong")
    return tuple(values)
