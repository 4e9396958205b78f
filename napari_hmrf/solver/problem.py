"""Inputs of the method: observations, confidence, and stiffness of the tissue."""

from __future__ import annotations

import copy
import hashlib
import math
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import require_kind, shown
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import FloatArray as FloatArray
from napari_hmrf.real_arrays import (
    are_equal,
    as_float32,
    as_numbers,
    check_finite,
    checked_spacing,
    first_index,
    grid_in_words,
    how_many,
)
from napari_hmrf.solver.coupling import Coupling
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.precision import MAX_PRECISION, checked_precision
from napari_hmrf.solver.sliding_parts import SlidingParts
from napari_hmrf.solver.uncertain_landmarks import Landmarks, corner_shares

#: Largest ratio between two stiffnesses for which single precision is sufficient.
MAX_STIFFNESS_RATIO = 1e7
_SMALLEST_STIFFNESS = 1e-30
# Default spacing, recognized by identity.
_EVEN = (1.0, 1.0)
#: Largest plausible displacement, as a multiple of the image diagonal.
MAX_REACH = 2.0
T = TypeVar("T", bound=npt.NDArray[Any])
Mask = npt.NDArray[np.bool_]
# Largest share of observed components for which only their values are read.
_FEW = 0.25
# Number of shapes of which the latest array is known. Small problems that try a device have others.
_SHAPES = 4


class _Latest(Generic[T]):
    """Latest read-only array of one kind, such as the stiffness, for each of a few shapes.

    Only the observations change during a drag. As long as the latest array is in use, it replaces
    an equal array of a later problem, so that all comparisons of the array are free. Any thread may
    replace the array.
    """

    def __init__(self) -> None:
        self._kept: Kept[dict[tuple[int, ...], weakref.ref[T]]] = Kept()

    def like(self, value: object) -> T | None:
        """Return the latest array of the shape of a value, or None if there is none in use."""
        of_shapes = self._kept.value
        if of_shapes is None or not isinstance(value, np.ndarray):
            return None
        found = of_shapes.get(value.shape)
        return None if found is None else found()

    def put(self, array: T) -> T:
        """Return an array, read-only, or the latest one if both are equal."""
        latest = self.like(array)
        if latest is not None and are_equal(array, latest):
            return latest
        array.setflags(write=False)
        others = [each for each in (self._kept.value or {}).items() if each[0] != array.shape]
        self._kept.value = dict([*others[1 - _SHAPES :], (array.shape, weakref.ref(array))])
        return array


class _Derived(Generic[T]):
    """Latest array of one kind that is derived from read-only arrays."""

    def __init__(self, derive: Callable[..., T]) -> None:
        self._derive, self._latest = derive, _Latest[T]()
        self._kept: Kept[tuple[tuple[weakref.ref[Any], ...], T]] = Kept(is_large=True)

    def of(self, *given: npt.NDArray[Any]) -> T:
        """Return the array that is derived from other arrays."""
        kept = self._kept.value
        if kept is not None and all(
            ref() is each for ref, each in zip(kept[0], given, strict=True)
        ):
            return kept[1]
        array = self._latest.put(self._derive(*given))
        self._kept.value = tuple(map(weakref.ref, given)), array
        return array


_stiffness, _confidence = _Latest[FloatArray](), _Latest[FloatArray]()
_tissue = _Derived[Mask](lambda stiffness: stiffness > 0)
_observed = _Derived[Mask](lambda confidence: confidence > 0)
_known = _Derived[Mask](lambda observed, tissue: observed & tissue[..., None])
_observed_at = _Derived[npt.NDArray[np.intp]](np.flatnonzero)
_known_at = _Derived[npt.NDArray[np.intp]](np.flatnonzero)
_known_confidence = _Derived[FloatArray](lambda confidence, at: confidence.ravel().take(at))
# Cached properties of the observations and their confidence.
_OF_OBSERVATIONS = "digests", "known", "known_at", "known_confidence", "known_values"


@dataclass(frozen=True, eq=False, init=False)
class Problem:
    """Boundary displacement, confidence and stiffness on one pixel grid; validated and immutable.

    The arrays are copied, converted to float32 (`precision` to float64) and made read-only.

    Parameters
    ----------
    observed : array_like, shape (H, W, 2) or (D, H, W, 3)
        Observed (boundary) displacement, y in the equations, in the unit of `spacing`, with
        components in (row, col) order, or (plane, row, col) in a volume. Material displacement:
        tissue at X was observed to move to X + y(X). Where `confidence` and `precision` are zero,
        values are ignored and stored as zero.
    confidence : array_like, shape (H, W, 2) or (D, H, W, 3)
        Confidence in each component of `observed`, c in the equations. At 1 the observation is
        certain and exactly prescribed; at 0 it is unknown. In between, the force of the observation
        is at most c, where a force of 1 strains a pixel of the stiffest tissue by 1. If a larger
        force is required, the site slips.
    stiffness : array_like, shape (H, W) or (D, H, W)
        Young's modulus, m in the equations, in any unit: only ratios matter, unless there are
        forces (see `loads`). ``0`` means no tissue (void): such a site belongs to no clique and has
        no displacement. ``inf`` means rigid tissue, for `ElasticPrior` and `NeoHookeanPrior`:
        connected rigid sites move as one body.
    spacing : sequence of float, shape (2,) or (3,)
        Size of a pixel along each axis, in (row, col) order, or of a voxel, in (plane, row, col)
        order, in any unit of length; by default 1 along each axis.
    loads : Loads, optional
        Growth and forces, for `ElasticPrior` and `NeoHookeanPrior`. In an image, forces per
        thickness are in the unit of stiffness times length; in a volume, forces are in the unit of
        stiffness times length squared. The unit of length is that of `spacing`.
    precision : array_like, optional
        Precision of `observed`, W in the equations, for `ElasticPrior` and `NeoHookeanPrior`: adds
        the energy ``1/2 (d - y)^T W (d - y)`` of each site, in addition to `confidence`. A
        symmetric positive semidefinite tensor at each site, shape (H, W, 2, 2) or (D, H, W, 3, 3);
        its diagonal, shape (H, W, 2) or (D, H, W, 3); or one number for each site or for all sites.
        In an image, the unit is that of stiffness; in a volume, stiffness times length. Values in
        void are ignored. ``k n n^T`` observes the component along n only.
    landmarks : Landmarks, optional
        Observed displacements of points between pixels, with standard deviations, for
        `ElasticPrior` and `NeoHookeanPrior`.
    sliding : SlidingParts, optional
        Labels of parts of the tissue that slide along each other, for `ElasticPrior` and
        `NeoHookeanPrior`. By default, all tissue is connected.

    Raises
    ------
    ProblemError
        If an input is invalid; the message names the input and a remedy.
    """

    observed: FloatArray
    confidence: FloatArray
    stiffness: FloatArray
    spacing: tuple[float, ...]
    loads: Loads | None
    precision: npt.NDArray[np.floating] | None
    landmarks: Landmarks | None
    sliding: SlidingParts | None

    def __init__(
        self,
        *,
        observed: npt.ArrayLike,
        confidence: npt.ArrayLike,
        stiffness: npt.ArrayLike,
        spacing: Sequence[float] = _EVEN,
        loads: Loads | None = None,
        precision: npt.ArrayLike | None = None,
        landmarks: Landmarks | None = None,
        sliding: SlidingParts | None = None,
    ) -> None:
        # If `observed` has one value per pixel, do not interpret the stiffness as a volume.
        image = isinstance(observed, np.ndarray) and observed.ndim == 2
        latest_m = _stiffness.like(stiffness)
        latest_c = _confidence.like(confidence)
        m = _as_image(stiffness, (2,) if image else (2, 3), latest_m)
        pixel = checked_spacing((1.0,) * m.ndim if spacing is _EVEN else spacing, m.ndim)
        _check_grid(m)
        c = as_float32("confidence", confidence, latest_c)
        given_y = as_numbers("observed", observed)
        for field, array in (("confidence", c), ("observed", given_y)):
            expected = (*m.shape, m.ndim)
            if array.shape != expected:
                raise ProblemError(
                    field,
                    f"has shape {array.shape}, but stiffness has shape {m.shape}, so {expected} is "
                    "needed (one value per axis at each pixel). Use the same pixel grid for both.",
                )
        if m is not latest_m:
            _check_stiffness_unit(stiffness, m)
            _check_stiffness(m)
            m = _stiffness.put(m)
        weight = None if precision is None else checked_precision(precision, m > 0)
        has_data = weight is not None or landmarks is not None
        if c is not latest_c:
            _check_confidence(c)
            c = _confidence.put(c)
        if not has_data:
            _check_any(c)
        used = _observed.of(c)
        if weight is not None:
            used = used | weight.any(axis=-1)
            _check_precision(weight, m, pixel)
        y, values = _used_values(given_y, used, pixel, of_precision=weight is not None)
        for field, array in (("observed", y), ("confidence", c), ("stiffness", m)):
            object.__setattr__(self, field, array)
        object.__setattr__(self, "spacing", pixel)
        object.__setattr__(self, "precision", weight)
        object.__setattr__(self, "landmarks", landmarks)
        if not has_data:
            _check_known(self.known)
        if values is not None and values.size == self.known_at.size:
            vars(self)["known_values"] = values
        _check_landmarks(landmarks, m, pixel)
        object.__setattr__(self, "loads", loads)
        _check_loads(loads, m, pixel)
        object.__setattr__(self, "sliding", sliding)
        _check_sliding(sliding, m)

    def __repr__(self) -> str:
        size, pixel = grid_in_words(self.shape), grid_in_words(self.spacing)
        tissue = int(np.count_nonzero(self.tissue))
        void = "" if tissue == self.tissue.size else f", {tissue:,} of tissue"
        observed = int(np.count_nonzero(self.known.any(axis=-1)))
        loads = "" if self.loads is None else f", {self.loads}"
        if self.landmarks is not None:
            loads = f", {self.landmarks}{loads}"
        if self.precision is not None:
            data = int(np.count_nonzero(self.precision.any(axis=(-2, -1))))
            loads = f", precision at {data:,}{loads}"
        if self.sliding is not None:
            loads = f", {self.sliding}{loads}"
        return (
            f"Problem({size} sites of {pixel}{void}, {observed:,} observed, "
            f"stiffness {_range_in_words(self.stiffness)}{loads})"
        )

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid: (H, W) or (D, H, W)."""
        return tuple(self.stiffness.shape)

    @property
    def is_volume(self) -> bool:
        """True if the grid has three axes."""
        return self.stiffness.ndim == 3

    @cached_property
    def tissue(self) -> npt.NDArray[np.bool_]:
        """Mask of tissue: stiffness above 0, shape (H, W)."""
        return _tissue.of(self.stiffness)

    @cached_property
    def rigid(self) -> npt.NDArray[np.bool_]:
        """Mask of rigid tissue: infinite stiffness, shape (H, W)."""
        mask = np.isinf(self.stiffness)
        mask.setflags(write=False)
        return mask

    @cached_property
    def has_rigid(self) -> bool:
        """True if some tissue is rigid."""
        return math.isinf(float(self.stiffness.max()))

    @cached_property
    def known(self) -> npt.NDArray[np.bool_]:
        """Mask of observed components of tissue: confidence above 0, shape (H, W, 2)."""
        return _known.of(_observed.of(self.confidence), self.tissue)

    @cached_property
    def known_at(self) -> npt.NDArray[np.intp]:
        """Indices of the observed components of tissue in the flattened observations."""
        return _known_at.of(self.known)

    @cached_property
    def known_confidence(self) -> FloatArray:
        """Confidence at `known_at`."""
        return _known_confidence.of(self.confidence, self.known_at)

    @cached_property
    def known_values(self) -> FloatArray:
        """Observed displacements at `known_at`, in the unit of the spacing."""
        return self.observed.ravel().take(self.known_at)

    @cached_property
    def digests(self) -> Mapping[str, str]:
        """SHA-256 digests of the bytes of each array, computed on first access."""
        names = ("observed", "confidence", "stiffness")
        arrays: dict[str, npt.NDArray[Any]] = {name: getattr(self, name) for name in names}
        if self.loads is not None:
            loads = {"growth": self.loads.growth, "force": self.loads.force}
            arrays |= {name: array for name, array in loads.items() if array is not None}
        if self.precision is not None:
            arrays["precision"] = self.precision
        if self.landmarks is not None:
            own = self.landmarks
            values = own.points, own.targets, own.precision(self.stiffness, self.spacing)
            arrays["landmarks"] = np.stack(values)
            if own.drift:
                arrays["drift"] = np.ones(1)
        if self.sliding is not None:
            arrays["sliding"] = self.sliding.labels
        return _Digests(arrays)

    def with_rest(self, at_rest: npt.NDArray[np.bool_]) -> Problem:
        """Return the problem without some tissue, which then stays at rest.

        Parameters
        ----------
        at_rest : ndarray of bool, shape (H, W) or (D, H, W)
        """
        return Problem(
            observed=self.observed,
            confidence=self.confidence,
            stiffness=np.where(at_rest, np.float32(0), self.stiffness),
            spacing=self.spacing,
            loads=self.loads,
            precision=self.precision,
            landmarks=self.landmarks,
            sliding=self.sliding,
        )

    @property
    def coupling(self) -> Coupling | None:
        """Coupling of the fields of sliding parts; None except in an unfolded problem."""
        return None

    @property
    def observed_components(self) -> npt.NDArray[np.bool_]:
        """Mask of components with a confidence, a precision or a landmark, shape (H, W, 2)."""
        if not self.has_data:
            return self.known
        mask: npt.NDArray[np.bool_] = self.known.copy()
        if self.precision is not None:
            mask |= self.precision.any(axis=-1)
        if self.landmarks is not None:
            for sites, _ in corner_shares(self.landmarks.points, self.shape):
                mask[sites] = True
        return mask

    @property
    def has_data(self) -> bool:
        """True if there is a quadratic data term: a precision or landmarks."""
        return self.precision is not None or self.landmarks is not None

    @property
    def unit(self) -> float:
        """Length of one pixel in the solver: the geometric mean of `spacing`."""
        return math.prod(self.spacing) ** (1.0 / len(self.spacing))


def in_pixels(problem: Problem, displacement: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return a displacement of the sites of a problem in pixels.

    Parameters
    ----------
    problem : Problem
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Displacement, in the unit of ``problem.spacing``.

    Raises
    ------
    ArgumentError
        If `problem` is not a `Problem`.
    ProblemError
        If the displacement has another shape, is not numeric, or is not finite in tissue.
    """
    require_kind(Problem, "problem", problem, "Problem(observed, confidence, stiffness)")
    d = as_numbers("displacement", displacement)
    if d.shape != problem.observed.shape:
        raise ProblemError(
            "displacement",
            f"has shape {d.shape}, but the problem needs {problem.observed.shape}: a displacement "
            "along each axis for each site.",
        )
    check_finite("displacement", d[problem.tissue])
    return np.where(np.isfinite(d), d, 0.0).astype(np.float64) / problem.unit


def variant_of(problem: Problem, **changes: object) -> Problem:
    """Return a copy of a validated problem with other fields, which are not validated.

    Void and rigid tissue must stay the same, because their masks are copied.
    """
    other = copy.copy(problem)
    for name in _OF_OBSERVATIONS:
        vars(other).pop(name, None)
    for name, value in changes.items():
        object.__setattr__(other, name, value)
    return other


def part_of(problem: Problem, sites: tuple[slice, ...]) -> Problem:
    """Return a validated problem on a box of its sites that contains all tissue.

    The unit of energy of landmarks stays that of the whole grid. Sliding parts are not supported.

    Parameters
    ----------
    problem : Problem
    sites : tuple of slice
        Range of sites along each axis, with a start.
    """

    def within(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        part = np.ascontiguousarray(values[sites])
        part.setflags(write=False)
        return part

    part = variant_of(problem)
    for name in ("tissue", "rigid"):
        vars(part).pop(name, None)
    for name in ("observed", "confidence", "stiffness", "precision"):
        values = getattr(problem, name)
        object.__setattr__(part, name, None if values is None else within(values))
    loads, marks = problem.loads, problem.landmarks
    if loads is not None:
        growth, force = (
            None if values is None else within(values) for values in (loads.growth, loads.force)
        )
        loads = Loads(growth=growth, force=force, spacing=loads.spacing)
    if marks is not None:
        first = np.array([along.start for along in sites])
        scale = marks.scale.resolved(problem.stiffness, problem.spacing)
        marks = marks.placed(marks.points - first, scale)
    object.__setattr__(part, "loads", loads)
    object.__setattr__(part, "landmarks", marks)
    return part


class _Digests(Mapping[str, str]):
    """SHA-256 digests of read-only arrays, computed on first access.

    A digest takes milliseconds, so no digest is computed before it is needed.
    """

    def __init__(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        self._arrays = arrays
        self._digests: dict[str, str] = {}

    def __getitem__(self, name: str) -> str:
        if name not in self._digests:
            self._digests[name] = hashlib.sha256(self._arrays[name].tobytes()).hexdigest()
        return self._digests[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    def __deepcopy__(self, memo: object) -> dict[str, str]:
        return dict(self)

    def __repr__(self) -> str:
        return repr(dict(self))


def as_stiffness(stiffness: npt.ArrayLike) -> FloatArray:
    """Copy a stiffness image to float32, validated as in a `Problem`.

    Raises
    ------
    ProblemError
        As for `Problem`, but an image without tissue is accepted.
    """
    m = _as_image(stiffness)
    _check_grid(m)
    _check_stiffness_unit(stiffness, m)
    if m.any():
        _check_stiffness(m)
    return m


def _as_image(
    stiffness: npt.ArrayLike, axes: tuple[int, ...] = (2, 3), latest: FloatArray | None = None
) -> FloatArray:
    image = as_float32("stiffness", stiffness, latest)
    if image.ndim not in axes:
        swapped = image.ndim == 3 and image.shape[-1] == 2  # one value for each component
        hint = "Pass one value for each pixel." if swapped else ""
        volume = " or a volume (D, H, W)" if 3 in axes else ""
        raise ProblemError(
            "stiffness",
            f"has shape {image.shape}, but a 2-D image (H, W){volume} is needed. {hint}".rstrip(),
        )
    return image


def _check_grid(m: FloatArray) -> None:
    if m.size == 0:
        raise ProblemError(
            "stiffness", f"is empty: its shape is {m.shape}. Use an image with pixels."
        )
    if m.size == 1:
        raise ProblemError(
            "stiffness", "is a single pixel, which cannot deform. Use a larger image."
        )


def _check_finite(
    field: str, array: FloatArray, where: str = "", but: npt.NDArray[np.bool_] | bool = False
) -> None:
    bad = ~(np.isfinite(array) | but)
    if bad.any():
        if field != "stiffness":
            bad = np.asarray(bad.any(axis=-1))
        raise ProblemError(
            field,
            f"has {how_many(bad)} that are NaN or infinite {where}".rstrip()
            + f", the first at {first_index(bad)}. Replace them with finite numbers.",
        )


def check_reach(
    y: FloatArray, spacing: tuple[float, ...], values: FloatArray | None = None
) -> None:
    """Raise an error for displacements far beyond the image, usually due to a wrong unit.

    If only a few displacements are not 0, `values` may be their components.
    """
    grid = y.shape[:-1]
    diagonal = math.hypot(*(size * step for size, step in zip(grid, spacing, strict=True)))
    # Usually the largest component is sufficient; computing all lengths takes ten times as long.
    values = y if values is None else values
    largest = max(float(values.max(initial=0)), -float(values.min(initial=0)))
    if math.sqrt(len(grid)) * largest <= MAX_REACH * diagonal:
        return
    length = np.linalg.norm(y.astype(np.float64), axis=-1)
    far = length > MAX_REACH * diagonal
    if far.any():
        size = " x ".join(_shown(size * step) for size, step in zip(grid, spacing, strict=True))
        pixel = " x ".join(f"{step:.3g}" for step in spacing)
        raise ProblemError(
            "observed",
            f"moves tissue by up to {_shown(float(length.max()))} (first at {first_index(far)}), "
            f"but the image is only {size}. Use the unit of length in which a pixel is {pixel}. "
            f"The largest distance is {MAX_REACH:g} times the diagonal of the image.",
        )


def _shown(length: float) -> str:
    """Format a length with three significant digits, without an exponent if possible."""
    return f"{float(f'{length:.3g}'):g}"


def check_each_stiffness(m: FloatArray) -> None:
    """Raise an error if a stiffness is NaN or negative."""
    _check_finite("stiffness", m, but=m == np.inf)
    negative = m < 0
    if negative.any():
        raise ProblemError(
            "stiffness",
            f"has {int(negative.sum())} negative values, the first at {first_index(negative)}. "
            "Use stiffnesses above 0, or 0 where there is no tissue.",
        )


def _check_stiffness(m: FloatArray) -> None:
    check_each_stiffness(m)
    tissue = m > 0
    if not tissue.any():
        raise ProblemError(
            "stiffness", "is 0 everywhere: there is no tissue. Give tissue a stiffness above 0."
        )
    soft = tissue & np.isfinite(m)
    low = float(m.min(where=soft, initial=np.inf))
    high = float(m.max(where=soft, initial=0.0))
    if high > low * MAX_STIFFNESS_RATIO:
        raise ProblemError(
            "stiffness",
            f"ranges from {low:.3g} to {high:.3g}: the stiffest part may be at most ten million "
            "times as stiff as the softest. Set the softest part to 0 (no tissue), or hold the "
            "stiffest part fixed instead.",
        )


def _check_stiffness_unit(given: npt.ArrayLike, m: FloatArray) -> None:
    """Raise an error for stiffnesses that would lose digits or have an inverse that overflows."""
    array = np.asarray(given)
    extreme = (m > 1 / _SMALLEST_STIFFNESS) | ((m < _SMALLEST_STIFFNESS) & (array > 0))
    extreme &= array != np.inf
    if extreme.any():
        _check_finite("stiffness", m, but=array == np.inf)
        first = first_index(extreme)
        raise ProblemError(
            "stiffness",
            f"is {array[first]:.3g} at {first}. Only ratios matter: choose a unit in which "
            f"stiffness is from {_SMALLEST_STIFFNESS:g} to {1 / _SMALLEST_STIFFNESS:g}, and use 0 "
            "where there is no tissue.",
        )


def _check_precision(
    weight: npt.NDArray[np.floating], m: FloatArray, pixel: tuple[float, ...]
) -> None:
    """Raise an error for a precision so large that the observation should be prescribed."""
    stiffest = float(m.max(where=np.isfinite(m), initial=0.0)) or 1.0
    unit = stiffest * math.prod(pixel) ** ((m.ndim - 2) / m.ndim)
    largest = max(float(weight.max()), -float(weight.min()))
    if largest > MAX_PRECISION * unit:
        raise ProblemError(
            "precision",
            f"reaches {largest:.3g}, which is more than {MAX_PRECISION * unit:.3g}, a million "
            "times the stiffness of the stiffest tissue. Prescribe such observations with a "
            "confidence of 1 instead.",
        )


def _used_values(
    given: npt.NDArray[Any], used: Mask, pixel: tuple[float, ...], *, of_precision: bool
) -> tuple[FloatArray, FloatArray | None]:
    """Return a checked copy of the observations, which is 0 where they are not used.

    The second array contains the used values only, if they are few and already in single precision.
    Otherwise, it is None, and values that single precision cannot represent are refused, even where
    they are not used.
    """
    values = None
    few = np.count_nonzero(used) < _FEW * used.size
    if few and not of_precision and given.dtype == np.float32:
        at = _observed_at.of(used)
        y, values = np.zeros(used.shape, np.float32), given.reshape(-1)[at]
        y.reshape(-1)[at] = values
    if values is None:
        y = as_float32("observed", given)
        np.copyto(y, np.float32(0), where=~used)
    if not np.isfinite(y if values is None else values).all():
        where = f"where confidence{' or precision' * of_precision} is above 0"
        _check_finite("observed", y, where)
    check_reach(y, pixel, values)
    y.setflags(write=False)
    return y, values


def _check_confidence(c: FloatArray) -> None:
    _check_finite("confidence", c)
    if c.min() < 0 or c.max() > 1:
        outside = np.asarray(((c < 0) | (c > 1)).any(axis=-1))
        raise ProblemError(
            "confidence",
            f"has {how_many(outside)} outside 0 to 1, the first at {first_index(outside)}. Scale "
            "the confidence to the range from 0 (none) to 1 (complete).",
        )


def _check_any(c: FloatArray) -> None:
    if not c.any():
        raise ProblemError(
            "confidence",
            "is 0 everywhere: nothing determines how tissue moves. Mark at least one place as "
            "fixed or moving.",
        )


def _range_in_words(m: FloatArray) -> str:
    soft = m[(m > 0) & (m < np.inf)]
    rigid = "rigid" if (m == np.inf).any() else ""
    if not soft.size:
        return rigid
    low, high = f"{soft.min():.3g}", f"{soft.max():.3g}"
    return (low if low == high else f"{low} to {high}") + (rigid and f" and {rigid}")


def _check_loads(loads: object, m: FloatArray, pixel: tuple[float, ...]) -> None:
    if loads is None:
        return
    if not isinstance(loads, Loads):
        kind = type(loads).__name__
        raise ProblemError(
            "loads", f"is {shown(loads)}, of type {kind}. Pass Loads, such as growth(strain)."
        )
    loads.check(m, pixel)


def _check_landmarks(landmarks: object, m: FloatArray, pixel: tuple[float, ...]) -> None:
    if landmarks is None:
        return
    if not isinstance(landmarks, Landmarks):
        kind = type(landmarks).__name__
        raise ProblemError(
            "landmarks",
            f"is {shown(landmarks)}, of type {kind}. Pass Landmarks(points, targets, sd=1.0).",
        )
    landmarks.check(m, pixel)
    lengths = np.linalg.norm(landmarks.displacement(pixel), axis=1)
    diagonal = math.hypot(*(size * step for size, step in zip(m.shape, pixel, strict=True)))
    if lengths.max() > MAX_REACH * diagonal:
        raise ProblemError(
            "landmarks",
            f"move tissue by up to {_shown(float(lengths.max()))} (landmark number "
            f"{int(lengths.argmax())}), but the diagonal of the image is only {_shown(diagonal)}. "
            "Correct the targets.",
        )


def _check_sliding(sliding: object, m: FloatArray) -> None:
    if sliding is None:
        return
    if not isinstance(sliding, SlidingParts):
        kind = type(sliding).__name__
        raise ProblemError(
            "sliding", f"is {shown(sliding)}, of type {kind}. Pass SlidingParts(labels)."
        )
    sliding.check(m)


def _check_known(known: npt.NDArray[np.bool_]) -> None:
    if not known.any():
        raise ProblemError(
            "confidence",
            "is above 0 only where there is no tissue (stiffness 0). Mark a boundary on tissue, or "
            "give those pixels a stiffness.",
        )
