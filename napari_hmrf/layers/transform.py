"""What says where a layer lies, as a value."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Matrix = tuple[tuple[float, ...], ...]

#: The attributes of a layer, and keyword arguments of a new one, that say where it lies.
PLACE = ("scale", "translate", "rotate", "shear", "affine", "units", "axis_labels")


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
