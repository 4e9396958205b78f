"""Displacements in double precision, kept on the host whatever the backend: see `linear`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends import loops
from napari_hmrf.solver.backends.base import FloatArray
from napari_hmrf.solver.backends.found import Beginning
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes
from napari_hmrf.solver.backends.thread import in_child_of_fork

if TYPE_CHECKING:
    from napari_hmrf.solver.problem import Problem

_TINY = 1e-300
_spare: list[tuple[Planes, HeldPlanes]] = []
in_child_of_fork(_spare.clear)


def _exact() -> Any:
    """Return the loops, or before they are compiled their twins in NumPy."""
    if loops.in_use():
        from napari_hmrf.solver.backends.cpu import exact

        return exact
    from napari_hmrf.solver.backends.arrays import exact as plain

    return plain


def prescribed(problem: Problem, start: Beginning | None = None) -> tuple[Planes, HeldPlanes]:
    """Return the displacement that is observed on tissue, in pixels, and where that is.

    Elsewhere it is that of `start`, or zero.
    """
    exact = _exact()

    shape = (2, *(size + 4 for size in problem.shape))
    if _spare and _spare[0][0].shape == shape:
        d, held = _spare.pop()
    else:
        _spare.clear()
        d, held = np.zeros(shape), np.zeros(shape, dtype=np.bool_)
    given = [] if start is None else start.weighted
    terms = [(loops.only_read(values), weight) for values, weight in given]
    # Where there is no more to begin with, something that counts 0 times.
    about = problem.observed, problem.known, 1 / problem.unit
    first, second = [*terms, (problem.observed, 0.0), (problem.observed, 0.0)][:2]
    exact.prescribe(*about, *first, *second, d, held)
    for values, weight in terms[2:]:
        exact.blend(values, weight, held, d)
    return d, held


def reuse(d: Planes, held: HeldPlanes) -> None:
    """Take what `prescribed` made for the next time: fresh memory takes longer to get than to fill.

    For the compute thread only, on which solves take turns.
    """
    _spare[:] = [(d, held)]


def noise(shape: tuple[int, ...]) -> Planes:
    """Return the same random displacement each time: of all lengths at once, from -1 to 1."""
    made: Planes = np.zeros(shape)
    random = np.random.default_rng(0)
    field = np.zeros((shape[0], 1, 1), dtype=np.float32)
    while field.shape[1] < shape[1] - 4 or field.shape[2] < shape[2] - 4:
        field = field.repeat(2, axis=1).repeat(2, axis=2)
        field += random.random(field.shape, dtype=np.float32) - np.float32(0.5)
        field = field[:, : shape[1] - 4, : shape[2] - 4]
    made[:, 2:-2, 2:-2] = field
    return made / max(float(np.abs(made).max()), _TINY)


def settle(displacement: FloatArray, tissue: npt.NDArray[np.bool_], unit: float) -> bool:
    """Bring pixels (H, W, 2) to lengths, and void to rest, in place; whether all were numbers."""
    if displacement.dtype == np.float64:
        displacement *= unit * tissue[..., None]
        return bool(np.isfinite(displacement).all())
    exact = _exact()

    finite = np.zeros(len(displacement), dtype=np.bool_)
    exact.settle(displacement, tissue, np.float32(unit), finite)
    return bool(finite.all())


def combined(start: Beginning) -> Planes:
    """Return the sum that a solve begins with, as planes, in pixels."""
    return planes(np.sum([weight * each for each, weight in start.weighted], axis=0))


def planes(values: npt.NDArray[Any]) -> Planes:
    """Return values (H, W, 2) as planes."""
    made = np.zeros((2, *(size + 4 for size in values.shape[:2])))
    made[:, 2:-2, 2:-2] = np.moveaxis(values, -1, 0)
    return made


def add(d: Planes, correction: npt.NDArray[np.float32], scale: float) -> None:
    """Add scale * correction to a displacement, in place."""
    exact = _exact()

    exact.add(d, correction, scale)


def gathered(d: Planes, tolerance: float) -> tuple[npt.NDArray[np.floating], float]:
    """Return a displacement as an array (H, W, 2), and how far that rounds it, in pixels.

    In single precision, but where that does not carry the tolerance.
    """
    most = max(float(d.max()), -float(d.min()))
    rounding = most * float(np.finfo(np.float32).eps) / 2
    if 2 * rounding > tolerance:
        exactly = np.moveaxis(d[:, 2:-2, 2:-2], 0, -1).copy()
        return exactly, most * float(np.finfo(np.float64).eps) / 2
    made = np.empty((d.shape[1] - 4, d.shape[2] - 4, 2), dtype=np.float32)
    _exact().gather(d, made)
    return made, rounding
