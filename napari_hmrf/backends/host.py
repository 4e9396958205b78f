"""Displacements in double precision, kept on the host whatever the backend: see `linear`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.backends.linear import HeldPlanes, Planes

if TYPE_CHECKING:
    from napari_hmrf.problem import Problem


def prescribed(problem: Problem) -> tuple[Planes, HeldPlanes]:
    """Return the displacement that is observed on tissue, in pixels, and where that is."""
    from napari_hmrf.backends.cpu import exact

    shape = (2, *(size + 4 for size in problem.shape))
    d, held = np.zeros(shape), np.zeros(shape, dtype=np.bool_)
    exact.prescribe(problem.y, problem.c, problem.m, problem.unit, d, held)
    return d, held


def planes(values: npt.NDArray[Any]) -> Planes:
    """Return values (H, W, 2) as planes."""
    made = np.zeros((2, *(size + 4 for size in values.shape[:2])))
    made[:, 2:-2, 2:-2] = np.moveaxis(values, -1, 0)
    return made


def measure(rest: Planes) -> tuple[float, float]:
    """Return the largest absolute value, and the norm."""
    from napari_hmrf.backends.cpu import exact

    most, squares = np.zeros((2, rest.shape[1] - 4))
    exact.measure(rest, most, squares)
    return float(most.max()), math.sqrt(squares.sum())


def shrunk(rest: Planes, scale: float) -> npt.NDArray[np.float32]:
    """Return rest / scale in single precision."""
    from napari_hmrf.backends.cpu import exact

    made = np.empty(rest.shape, dtype=np.float32)
    exact.shrink(rest, scale, made)
    return made


def add(d: Planes, correction: npt.NDArray[np.float32], scale: float) -> None:
    """Add scale * correction to a displacement, in place."""
    from napari_hmrf.backends.cpu import exact

    exact.add(d, correction, scale)


def gathered(d: Planes) -> npt.NDArray[np.float32]:
    """Return a displacement as an array (H, W, 2) in single precision."""
    from napari_hmrf.backends.cpu import exact

    made = np.empty((d.shape[1] - 4, d.shape[2] - 4, 2), dtype=np.float32)
    exact.gather(d, made)
    return made
