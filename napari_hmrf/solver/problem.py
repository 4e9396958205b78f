"""The inputs of the method: what is observed, how sure that is, and how stiff the tissue is."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError

FloatArray = npt.NDArray[np.float32]

#: The largest ratio between two stiffnesses that single precision is trusted with.
MAX_STIFFNESS_RATIO = 1e7
_SMALLEST_PIXEL = 1e-15
_SMALLEST_STIFFNESS = 1e-30
#: The longest displacement that can be meant, in diagonals of the image.
MAX_REACH = 2.0
_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True, eq=False, init=False)
class Problem:
    """Boundary displacement, confidence and stiffness on one pixel grid; frozen and validated.

    The arrays are copied, converted to float32 and made read-only.

    Parameters
    ----------
    y : array_like, shape (H, W, 2)
        Observed (boundary) displacement, components in (row, col) order, in the unit of
        `spacing`. Material displacement: the tissue at X was seen to move to X + y(X). Ignored,
        and stored as zero, where `c` is zero.
    c : array_like, shape (H, W, 2)
        Confidence in each component of `y`, from 0 (none) to 1 (complete).
    m : array_like, shape (H, W)
        Stiffness (Young's modulus) in any unit: only ratios matter. ``0`` means no tissue (void):
        no clique touches such a site and it has no displacement. ``inf`` means rigid tissue, for
        `ElasticPrior`: what touches of it moves as one body.
    spacing : sequence of float, shape (2,)
        Size of a pixel in (row, col) direction, in any unit of length.

    Raises
    ------
    ProblemError
        Naming the input at fault and what to do about it.
    """

    y: FloatArray
    c: FloatArray
    m: FloatArray
    spacing: tuple[float, ...]

    def __init__(
        self,
        y: npt.ArrayLike,
        c: npt.ArrayLike,
        m: npt.ArrayLike,
        spacing: Sequence[float] = (1.0, 1.0),
    ) -> None:
        given, m = m, _as_image(m)
        pixel = _checked_spacing(spacing, m.ndim)
        _check_grid(m)
        c = _as_float32("c", c)
        y = _as_float32("y", y)
        for field, array in (("c", c), ("y", y)):
            expected = (*m.shape, m.ndim)
            if array.shape != expected:
                raise ProblemError(
                    field,
                    f"has shape {array.shape}, but m has shape {m.shape}, so {expected} is needed "
                    "(one value per axis at each pixel). Give both on the same pixel grid.",
                )
        _check_stiffness_unit(given, m)
        _check_stiffness(m)
        _check_confidence(c)
        np.copyto(y, np.float32(0), where=c <= 0)  # a copy already
        _check_finite("y", y, "where c > 0")
        _check_reach(y, pixel)
        for field, array in (("y", y), ("c", c), ("m", m)):
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        object.__setattr__(self, "spacing", pixel)
        _check_observed(self.observed)

    @property
    def shape(self) -> tuple[int, ...]:
        """The grid: (H, W)."""
        return tuple(self.m.shape)

    @cached_property
    def tissue(self) -> npt.NDArray[np.bool_]:
        """Where there is tissue: ``m > 0``, shape (H, W)."""
        mask: npt.NDArray[np.bool_] = self.m > 0
        mask.setflags(write=False)
        return mask

    @cached_property
    def rigid(self) -> npt.NDArray[np.bool_]:
        """Where tissue is rigid: ``m = inf``, shape (H, W)."""
        mask = np.isinf(self.m)
        mask.setflags(write=False)
        return mask

    @cached_property
    def observed(self) -> npt.NDArray[np.bool_]:
        """Which components of tissue are observed: ``c > 0`` where ``m > 0``, shape (H, W, 2)."""
        mask: npt.NDArray[np.bool_] = (self.c > 0) & self.tissue[..., None]
        mask.setflags(write=False)
        return mask

    @cached_property
    def digests(self) -> Mapping[str, str]:
        """SHA-256 of the bytes of y, c and m: equal for equal inputs. Made when first looked at."""
        return _Digests({"y": self.y, "c": self.c, "m": self.m})

    @property
    def unit(self) -> float:
        """The length the solver calls one pixel: the geometric mean of `spacing`."""
        return math.prod(self.spacing) ** (1.0 / len(self.spacing))


class _Digests(Mapping[str, str]):
    """The SHA-256 of arrays that do not change: made when asked for, as it takes milliseconds."""

    def __init__(self, arrays: dict[str, FloatArray]) -> None:
        self._arrays = arrays
        self._made: dict[str, str] = {}

    def __getitem__(self, name: str) -> str:
        if name not in self._made:
            self._made[name] = hashlib.sha256(self._arrays[name].tobytes()).hexdigest()
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def __deepcopy__(self, memo: object) -> dict[str, str]:
        return dict(self)

    def __repr__(self) -> str:
        return repr(dict(self))


def as_numbers(field: str, value: Any) -> npt.NDArray[Any]:
    """Take an array of real numbers as it is, or raise `ProblemError` naming it."""
    try:
        array = np.asarray(value)
    except ValueError as error:  # rows of different length
        raise ProblemError(field, f"is not an array of numbers ({error}).") from None
    if array.dtype.kind not in "biuf":
        raise ProblemError(
            field, f"has values of type {array.dtype}. Give real numbers (integer or float)."
        )
    return array


def as_stiffness(m: npt.ArrayLike) -> FloatArray:
    """Copy a stiffness image to float32, as a `Problem` has it.

    Raises
    ------
    ProblemError
        As of a `Problem`, but for an image in which there is no tissue.
    """
    given, m = m, _as_image(m)
    _check_grid(m)
    _check_stiffness_unit(given, m)
    if m.any():
        _check_stiffness(m)
    return m


def _as_image(m: npt.ArrayLike) -> FloatArray:
    image = _as_float32("m", m)
    if image.ndim != 2:
        hint = "3-D grids are not supported yet: solve slice by slice" if image.ndim == 3 else ""
        raise ProblemError(
            "m", f"has shape {image.shape}, but a 2-D image (H, W) is needed. {hint}".rstrip()
        )
    return image


def _as_float32(field: str, value: npt.ArrayLike) -> FloatArray:
    """Copy `value` to a C-contiguous native float32 array, or say why that would lose something."""
    if isinstance(value, np.ma.MaskedArray):
        raise ProblemError(
            field, "is a masked array, whose mask would be lost. Fill it first (m = 0 is void)."
        )
    array = as_numbers(field, value)
    if array.dtype.kind == "f" and array.dtype.itemsize > 4 and array.size:
        with np.errstate(invalid="ignore"):
            largest = float(np.max(np.abs(array), initial=0, where=np.isfinite(array)))
        if largest > _LARGEST:
            raise ProblemError(
                field,
                f"reaches {largest:.3g}, beyond single precision ({_LARGEST:.3g}). Rescale it.",
            )
    return np.array(array, dtype=np.float32, order="C", copy=True)


def _checked_spacing(spacing: object, ndim: int) -> tuple[float, ...]:
    try:
        if isinstance(spacing, str):
            raise TypeError
        values = tuple(float(size) for size in spacing)  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        raise ProblemError("spacing", f"is {spacing!r}. Give {ndim} positive numbers.") from None
    if len(values) != ndim or not all(math.isfinite(size) and size > 0 for size in values):
        raise ProblemError("spacing", f"is {values}. Give {ndim} positive, finite pixel sizes.")
    if not all(_SMALLEST_PIXEL <= size <= 1 / _SMALLEST_PIXEL for size in values):
        raise ProblemError(
            "spacing", f"is {values}. Choose a unit of length in which pixels are not so extreme."
        )
    return values


def _check_grid(m: FloatArray) -> None:
    if m.size == 0:
        raise ProblemError("m", f"is empty: its shape is {m.shape}. Give an image with pixels.")
    if m.size == 1:
        raise ProblemError("m", "is a single pixel, which cannot deform. Give a larger image.")


def _first_index(bad: npt.NDArray[np.bool_]) -> tuple[int, ...]:
    return tuple(int(i) for i in np.unravel_index(int(np.argmax(bad)), bad.shape))


def _check_finite(
    field: str, array: FloatArray, where: str = "", but: npt.NDArray[np.bool_] | bool = False
) -> None:
    bad = ~(np.isfinite(array) | but)
    if bad.any():
        raise ProblemError(
            field,
            f"has {int(bad.sum())} values that are NaN or infinite {where}".rstrip()
            + f", the first at {_first_index(bad)}. Replace them by numbers.",
        )


def _check_reach(y: FloatArray, spacing: tuple[float, ...]) -> None:
    """Refuse displacements far beyond the image, mostly of a wrong unit."""
    grid = y.shape[:-1]
    diagonal = math.hypot(*(size * step for size, step in zip(grid, spacing, strict=True)))
    # Mostly the largest component tells already; the length of each takes ten times as long.
    largest = max(float(y.max()), -float(y.min()))
    if math.sqrt(len(grid)) * largest <= MAX_REACH * diagonal:
        return
    length = np.linalg.norm(y.astype(np.float64), axis=-1)
    far = length > MAX_REACH * diagonal
    if far.any():
        size = " x ".join(_shown(size * step) for size, step in zip(grid, spacing, strict=True))
        pixel = " x ".join(f"{step:.3g}" for step in spacing)
        raise ProblemError(
            "y",
            f"moves tissue by up to {_shown(float(length.max()))} (first at {_first_index(far)}), "
            f"but the image is only {size}. Give lengths in the unit in which a pixel is {pixel}.",
        )


def _shown(length: float) -> str:
    """Three digits, and no exponent as long as it can be read without."""
    return f"{float(f'{length:.3g}'):g}"


def _check_stiffness(m: FloatArray) -> None:
    _check_finite("m", m, but=m == np.inf)
    negative = m < 0
    if negative.any():
        raise ProblemError(
            "m",
            f"has {int(negative.sum())} negative values, the first at {_first_index(negative)}. "
            "Give stiffnesses above 0, or 0 where there is no tissue.",
        )
    tissue = m > 0
    if not tissue.any():
        raise ProblemError("m", "is 0 everywhere: there is no tissue. Give some a stiffness.")
    soft = tissue & np.isfinite(m)
    low = float(m.min(where=soft, initial=np.inf))
    high = float(m.max(where=soft, initial=0.0))
    if high > low * MAX_STIFFNESS_RATIO:
        raise ProblemError(
            "m",
            f"is from {low:.3g} to {high:.3g}: the stiffest part may be at most ten million times "
            "as stiff as the softest. Give the softest part 0 (no tissue), or hold the stiffest "
            "part fixed instead.",
        )


def _check_stiffness_unit(given: npt.ArrayLike, m: FloatArray) -> None:
    """Refuse stiffnesses of which single precision keeps few digits, or not even the inverse."""
    array = np.asarray(given)
    extreme = (m > 1 / _SMALLEST_STIFFNESS) | ((m < _SMALLEST_STIFFNESS) & (array > 0))
    extreme &= array != np.inf
    if extreme.any():
        _check_finite("m", m, but=array == np.inf)
        first = _first_index(extreme)
        raise ProblemError(
            "m",
            f"is {array[first]:.3g} at {first}. Only ratios matter: choose a unit in which "
            f"stiffness is from {_SMALLEST_STIFFNESS:g} to {1 / _SMALLEST_STIFFNESS:g}, and give 0 "
            "where there is no tissue.",
        )


def _check_confidence(c: FloatArray) -> None:
    _check_finite("c", c)
    if c.min() < 0 or c.max() > 1:
        outside = (c < 0) | (c > 1)
        raise ProblemError(
            "c",
            f"has {int(outside.sum())} values outside 0 to 1, the first at "
            f"{_first_index(outside)}. Scale the confidence to 0 (none) .. 1 (complete).",
        )
    if not c.any():
        raise ProblemError(
            "c",
            "is 0 everywhere: nothing says how any tissue moves. Mark at least one place as fixed "
            "or moving.",
        )


def _check_observed(observed: npt.NDArray[np.bool_]) -> None:
    if not observed.any():
        raise ProblemError(
            "c",
            "is above 0 only where there is no tissue (m = 0). Mark a boundary on tissue, or give "
            "those pixels a stiffness.",
        )
