"""Displacements on the host in double precision, for all backends.

The docstrings give the shapes for images, such as (H, W, 2); for volumes the shapes are
(D, H, W, 3). The module `planes` defines the layout of planes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.arrays import exact as plain
from napari_hmrf.solver.backends.base import FloatArray
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes
from napari_hmrf.solver.backends.planes import field as field
from napari_hmrf.solver.backends.planes import inside as inside
from napari_hmrf.solver.backends.planes import planes as planes
from napari_hmrf.solver.backends.planes import work_of as work_of

if TYPE_CHECKING:
    from napari_hmrf.solver.problem import Problem

_TINY = 1e-300
_spare: Kept[tuple[Planes, HeldPlanes]] = Kept()


def _exact(axes: int = 2) -> Any:
    """Return the module of compiled loops, or the same functions in NumPy.

    The NumPy module is used until the loops are compiled, and for volumes.
    """
    if loops.in_use() and axes == 2:
        from napari_hmrf.solver.backends.cpu import exact  # heavy: numba

        return exact
    return plain


def prescribed(problem: Problem, start: WarmStart | None = None) -> tuple[Planes, HeldPlanes]:
    """Return the initial displacement of a solve and the mask of constrained components, as planes.

    Observed components have the observed displacement, in pixels, and are constrained. Other
    components of tissue have the displacement of `start`, or zero. Void has zero, because a start
    has a displacement where its tissue has become void.

    Parameters
    ----------
    problem : Problem
    start : WarmStart, optional
        Warm start.
    """
    exact, axes = _exact(len(problem.shape)), len(problem.shape)

    shape = (axes, *(size + 4 for size in problem.shape))
    d, held = _spare.get(
        lambda arrays: arrays[0].shape == shape,
        lambda: (np.zeros(shape), np.zeros(shape, dtype=np.bool_)),
    )
    _spare.clear()  # until `reuse`
    given = [] if start is None else start.weighted
    terms = [(loops.only_read(values), weight) for values, weight in given]
    # The loops add exactly two terms, so a missing term gets the weight 0.
    observed, known = loops.only_read(problem.observed), loops.only_read(problem.known)
    nothing = observed, 0.0
    (first, one), (second, two) = [*terms, nothing, nothing][:2]
    for at in slices(problem.shape):
        parts = d[at.planes], held[at.planes]
        about = observed[at.sites], known[at.sites], 1 / problem.unit
        exact.prescribe(*about, first[at.sites], one, second[at.sites], two, *parts)
        for values, weight in terms[2:]:
            exact.blend(values[at.sites], weight, parts[1], parts[0])
        if terms:
            np.copyto(inside(parts[0]), 0.0, where=~problem.tissue[at.sites])
    return d, held


class Slice(NamedTuple):
    """Index of a slice of a volume, for arrays (D, H, W, ...) and for planes."""

    sites: Any
    planes: Any


def slices(grid: tuple[int, ...]) -> Iterator[Slice]:
    """Yield the index of the whole image, or of each slice of a volume.

    Slices limit the memory of temporary arrays. Cancellation is checked before each slice.
    """
    if len(grid) == 2:
        yield Slice(..., ...)
        return
    for number in range(grid[0]):
        compute_thread.check_cancelled()
        yield Slice(number, np.s_[:, number + 2])


def reuse(d: Planes, held: HeldPlanes) -> None:
    """Store the arrays of `prescribed` for its next call, because allocation is slow.

    Arrays of volumes are not stored, because memory limits the size of volumes. Must be called on
    the compute thread.
    """
    _spare.value = (d, held) if d.ndim == 3 else None


def noise(shape: tuple[int, ...]) -> Planes:
    """Return a reproducible random displacement that contains all wavelengths.

    Parameters
    ----------
    shape : tuple of int
        Shape of planes, with their border.

    Returns
    -------
    ndarray, planes
        Displacement with a largest absolute value of 1.
    """
    made: Planes = np.zeros(shape)
    random = np.random.default_rng(0)
    axes = range(1, len(shape))
    rough = np.zeros((shape[0], *(1 for _ in axes)), dtype=np.float32)
    while any(rough.shape[axis] < shape[axis] - 4 for axis in axes):
        for axis in axes:
            compute_thread.check_cancelled()
            rough = rough.repeat(2, axis=axis)
        compute_thread.check_cancelled()
        rough += random.random(rough.shape, dtype=np.float32) - np.float32(0.5)
        rough = rough[(slice(None), *(slice(shape[axis] - 4) for axis in axes))]
    compute_thread.check_cancelled()
    inside(made)[...] = rough
    compute_thread.check_cancelled()
    made /= max(float(made.max()), -float(made.min()), _TINY)
    return made


def settle(displacement: FloatArray, tissue: npt.NDArray[np.bool_], unit: float) -> bool:
    """Convert a displacement from pixels to units of length, in place, and set void to 0.

    Parameters
    ----------
    displacement : ndarray, shape (H, W, 2)
    tissue : ndarray of bool, shape (H, W)
    unit : float
        Length of a pixel.

    Returns
    -------
    bool
        True if all values are finite.
    """
    if displacement.dtype == np.float64:
        displacement *= unit * tissue[..., None]
        return bool(np.isfinite(displacement).all())
    exact, finite = _exact(tissue.ndim), np.zeros(tissue.shape[:-1], dtype=np.bool_)
    tissue = loops.only_read(tissue)
    for at in slices(tissue.shape):
        parts = displacement[at.sites], tissue[at.sites], np.float32(unit), finite[at.sites]
        exact.settle(*parts)
    return bool(finite.all())


def combined(start: WarmStart) -> Planes:
    """Return the weighted sum of a warm start as planes, in pixels."""
    return planes(np.sum([weight * each for each, weight in start.weighted], axis=0))


def add(d: Planes, correction: npt.NDArray[np.float32], scale: float) -> None:
    """Add ``scale * correction`` to a displacement, in place."""
    exact = _exact(d.ndim - 1)
    for at in slices(tuple(size - 4 for size in d.shape[1:])):
        exact.add(d[at.planes], correction[at.planes], scale)


def rounding_error(farthest: float, axes: int) -> float:
    """Return a bound on the rounding error of a displacement vector in single precision, in pixels.

    The bound includes the rounding in `settle`.

    Parameters
    ----------
    farthest : float
        Largest absolute value of a component, in pixels.
    axes : int
        Number of components.
    """
    single = np.finfo(np.float32)
    return math.sqrt(axes) * farthest * float(single.eps) + float(single.smallest_subnormal)


def gathered(d: Planes, tolerance: float) -> tuple[npt.NDArray[np.floating], float]:
    """Return a displacement as an array, and a bound on its rounding error.

    The array has single precision, unless its rounding error would exceed the tolerance.

    Parameters
    ----------
    d : ndarray, planes
        Displacement, in pixels.
    tolerance : float
        Largest accepted rounding error, in pixels.

    Returns
    -------
    ndarray, shape (H, W, 2)
        Displacement, in pixels.
    float
        Bound on the rounding error of a displacement vector, in pixels, including the rounding in
        `settle`.
    """
    farthest = max(float(d.max()), -float(d.min()))
    rounding = rounding_error(farthest, len(d))
    if rounding > tolerance:
        exactly = field(d).copy()
        return exactly, math.sqrt(len(d)) * farthest * float(np.finfo(np.float64).eps)
    grid = tuple(size - 4 for size in d.shape[1:])
    made = np.empty((*grid, len(d)), dtype=np.float32)
    exact = _exact(len(grid))
    for at in slices(grid):
        exact.gather(d[at.planes], made[at.sites])
    return made, rounding
