"""Validated conversion of input to arrays of real numbers."""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Real
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator

from napari_hmrf.arguments import reals, shown
from napari_hmrf.errors import ProblemError

FloatArray = npt.NDArray[np.float32]

_LARGEST = float(np.finfo(np.float32).max)
#: Largest number up to which a double stores every whole number.
_EXACT = 2**53
_SMALLEST_PIXEL = 1e-15
# Number of words of 8 bytes that are compared at once.
_COMPARED = 1 << 15


def _finite(array: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    if not np.isfinite(array).all():
        raise ValueError("contains values that are NaN or infinite")
    return array


#: Array of numbers that are checked when a file is read or written.
FiniteArray = Annotated[npt.NDArray[np.floating], AfterValidator(_finite)]


def as_numbers(field: str, value: Any) -> npt.NDArray[Any]:
    """Convert a value to an array of real numbers without copying; raise an error if impossible."""
    if isinstance(value, np.ma.MaskedArray):
        raise ProblemError(field, "is a masked array, whose mask would be lost. Fill it first.")
    try:
        array = np.asarray(value)
    except ValueError:
        raise ProblemError(
            field, "has rows of different lengths. Pass an array with a number for each pixel."
        ) from None
    if array.dtype.kind not in "biuf" and not array.ndim:
        kind = type(value).__name__
        raise ProblemError(field, f"is {shown(value)}, of type {kind}. Pass real numbers.")
    if array.dtype.kind not in "biuf":
        raise ProblemError(
            field, f"has values of type {array.dtype}. Pass real numbers (integer or float)."
        )
    return array


def as_float32(field: str, value: npt.ArrayLike, latest: FloatArray | None = None) -> FloatArray:
    """Copy `value` to a C-contiguous float32 array; raise an error for masked or huge values.

    If the value has the same shape, type and bytes as the array `latest`, this array is returned.
    """
    array = as_numbers(field, value)
    if latest is not None and are_equal(array, latest):
        return latest
    if array.dtype.kind == "f" and array.dtype.itemsize > 4 and array.size:
        with np.errstate(invalid="ignore"):
            largest = float(np.max(np.abs(array), initial=0, where=np.isfinite(array)))
        if largest > _LARGEST:
            raise ProblemError(
                field,
                f"reaches {largest:.3g}, beyond single precision ({_LARGEST:.3g}). Rescale it.",
            )
    return np.array(array, dtype=np.float32, order="C", copy=True)


def are_equal(one: npt.NDArray[Any] | None, other: npt.NDArray[Any] | None) -> bool:
    """Return whether two arrays have the same shape, type and bytes, or both are None.

    The comparison ends at the first difference, and allocates little memory: large temporary arrays
    take longer than the comparison.
    """
    if one is None or other is None or one is other:
        return one is other
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    mine, theirs = _bytes(one), _bytes(other)
    whole = mine.size // 8 * 8
    if not np.array_equal(mine[whole:], theirs[whole:]):
        return False
    mine, theirs = mine[:whole].view(np.uint64), theirs[:whole].view(np.uint64)
    parts = (slice(begin, begin + _COMPARED) for begin in range(0, mine.size, _COMPARED))
    return all(np.array_equal(mine[part], theirs[part]) for part in parts)


def _bytes(values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    return np.ascontiguousarray(values).reshape(-1).view(np.uint8)


def whole_numbers(field: str, labels: Any) -> npt.NDArray[Any]:
    """Return labels as an array of integers; whole numbers stored as floats are converted.

    Raises
    ------
    ProblemError
        If a label is not a whole number; the message names `field`.
    """
    array = as_numbers(field, labels)
    if array.dtype.kind != "f":
        return array
    wrong = ~((array == np.rint(array)) & (np.abs(array) <= _EXACT))
    if wrong.any():
        first = first_index(wrong)
        raise ProblemError(
            field,
            f"have the value {array[first]:g} at {first}. Pass whole numbers, one for each tissue.",
        )
    is_small = np.abs(array).max(initial=0) <= np.iinfo(np.int32).max
    return array.astype(np.int32 if is_small else np.int64)


def as_int32(field: str, labels: Any) -> npt.NDArray[np.int32]:
    """Return labels as integers of 32 bits.

    Raises
    ------
    ProblemError
        If a label is not a whole number, or needs more than 32 bits; the message names `field`.
    """
    array = whole_numbers(field, labels)
    check_int32(field, array)
    return array.astype(np.int32)


def check_int32(field: str, labels: npt.NDArray[Any]) -> None:
    """Raise an error for a label that needs more than 32 bits."""
    limits = np.iinfo(np.int32)
    for label in (labels.max(initial=0), labels.min(initial=0)):
        if label > limits.max or label < limits.min:
            raise ProblemError(
                field,
                f"contains the label {label:.0f}, beyond 32 bits. Use labels below "
                f"{limits.max + 1}.",
            )


def as_mask(field: str, value: Any) -> npt.NDArray[np.bool_]:
    """Convert a mask to booleans: a label other than 0 is True, and no number between is accepted.

    Raises
    ------
    ProblemError
        If a value is not a whole number, as in a map of probabilities; the message names `field`.
    """
    array = as_numbers(field, value)
    if array.dtype.kind == "f":
        wrong = array != np.rint(array)  # also where it is NaN
        if wrong.any():
            first = first_index(wrong)
            raise ProblemError(
                field,
                f"has the value {array[first]:g} at {first}. Pass a mask of 0 and 1, such as "
                "`probability > 0.5`.",
            )
    return array.astype(bool)


def check_finite(field: str, array: npt.NDArray[np.floating]) -> None:
    """Raise an error if an array has NaN or infinite values."""
    if not np.isfinite(array).all():
        raise ProblemError(
            field, "has values that are NaN or infinite. Replace them with finite numbers."
        )


def how_many(bad: npt.NDArray[np.bool_]) -> str:
    """Describe the number of marked pixels for an error message: "values at 3 pixels"."""
    count = int(bad.sum())
    return f"values at {count} pixel{'s' if count > 1 else ''}"


def first_index(bad: npt.NDArray[np.bool_]) -> tuple[int, ...]:
    """Return the index of the first marked pixel, in row-major order."""
    return tuple(int(i) for i in np.unravel_index(int(np.argmax(bad)), bad.shape))


def grid_in_words(sizes: Iterable[float]) -> str:
    """Format sizes along the axes for display: "300 x 200"."""
    return " x ".join(f"{size:g}" for size in sizes)


def sites_in_words(count: int, ndim: int) -> str:
    """Format a number of pixels or, with three axes, of voxels for display: "1 pixel"."""
    site = "voxel" if ndim == 3 else "pixel"
    return f"{count} {site}" if count == 1 else f"{count} {site}s"


def checked_spacing(spacing: object, ndim: int) -> tuple[float, ...]:
    """Return the validated pixel size along `ndim` axes; a number applies to all axes."""
    values = reals((spacing,) * ndim if isinstance(spacing, Real) else spacing, ndim)
    if not all(0 < size < math.inf for size in values):
        raise ProblemError(
            "spacing",
            f"is {shown(spacing)}. Pass {ndim} positive, finite pixel sizes, in the order of the "
            "axes.",
        )
    if not all(_SMALLEST_PIXEL <= size <= 1 / _SMALLEST_PIXEL for size in values):
        raise ProblemError(
            "spacing",
            f"is {values}. Choose a unit of length with less extreme pixel sizes.",
        )
    return values
