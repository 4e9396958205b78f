"""One level of a linear model as arrays: constraints and, on coarser levels, springs."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.linear import HeldPlanes
from napari_hmrf.solver.coarse_levels import MOST_PINS, SPRING

Vector = npt.NDArray[np.float32]
Real = npt.NDArray[np.floating[Any]]


class ArrayLevel:
    """Level with the arrays that shaders need: tissue, constraints and springs.

    Parameters
    ----------
    grid : tuple of int
        Grid of the level, (H, W) or (D, H, W).
    finest : bool
        True for the finest level.

    Attributes
    ----------
    steep : ndarray, shape (2, H + 4, W + 4)
        Curvature of the model's energy; 0 at components that cannot move.
    diagonal : ndarray, shape (2, H + 4, W + 4)
        Diagonal of the model's matrix, without springs.
    inverse : ndarray, shape (2, H + 4, W + 4)
        Reciprocal of the diagonal with springs; 0 at fixed components.
    pins : ndarray, shape (2, H + 4, W + 4)
        Constrained components: 1 or 0 on the finest level, an interpolated count on coarser levels.
    weight : ndarray, shape (2, H + 4, W + 4), or None
        Stiffness of the springs; None on the finest level.
    """

    steep: Vector
    diagonal: Vector
    #: None, because these levels run no cycles.
    responses = None

    def __init__(self, grid: tuple[int, ...], finest: bool) -> None:
        self.grid = grid
        self.inverse, self.pins = self.vector(), self.vector()
        self.weight = None if finest else self.vector()

    def vector(self) -> Vector:
        """Return a vector of zeros."""
        return np.zeros((len(self.grid), *(size + 4 for size in self.grid)), dtype=np.float32)

    def free(self, *vectors: Vector) -> None:
        """Ignore the call; memory is freed with the last reference."""

    def weigh(self, a: Vector, b: Vector) -> tuple[float, float]:
        """Return the largest absolute value of `a`, and the scalar product of `a` and `b`."""
        return float(np.abs(a).max()), float(np.vdot(a.astype(np.float64), b.astype(np.float64)))

    def hold(self, held: HeldPlanes) -> None:
        """Set the constrained components of the finest level."""
        self.pins[...] = self._pinned(held)
        self._invert(self.diagonal, (self.steep > 0) & ~held)

    def _pinned(self, held: HeldPlanes) -> HeldPlanes:
        """Return a mask of the components that put springs on the next coarser level."""
        return held

    def hold_as(self, finer: Self) -> None:
        """Set the springs at sites near constrained sites of the next finer level.

        The stiffness of a spring is ``coarse_levels.SPRING * pins * diagonal``.
        """
        assert self.weight is not None
        inside = (slice(None), *[slice(2, -2)] * len(self.grid))
        self.pins[inside] = np.minimum(restricted(finer.pins, self.grid), MOST_PINS)
        np.multiply(np.float32(SPRING) * self.pins, self.diagonal, out=self.weight)
        self._invert(self.diagonal + self.weight, self.steep > 0)

    def _invert(self, diagonal: Vector, moves: HeldPlanes) -> None:
        self.inverse.fill(0)
        np.divide(1, diagonal, out=self.inverse, where=moves)


def restricted(fine: Real, grid: tuple[int, ...]) -> Real:
    """Apply the transpose of linear interpolation; coarse site i coincides with fine site 2 i."""
    fine = np.pad(fine, ((0, 0), *[(0, 2)] * len(grid)))
    for axis, count in enumerate(grid):
        fine = _along(fine, count, 1 + axis)
    return fine


def _along(fine: Real, count: int, axis: int) -> Real:
    before, here, after = (
        np.take(fine, 2 * np.arange(count) + offset, axis=axis) for offset in (1, 2, 3)
    )
    return np.asarray(here + np.float32(0.5) * (before + after))
