"""Small levels, which share memory and run V-cycles on one thread; see `small_cycle`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import small_cycle
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector, paces_of
from napari_hmrf.solver.backends.linear import Steps

Grids = Sequence[tuple[int, ...]]

# Number of sites below which a level is small, and number of finest levels that are never treated
# as small, so that a small problem compiles all kernels that a large problem requires.
_SMALL, _LARGE = 8000, 2


def divided(grids: Grids) -> tuple[Grids, Grids]:
    """Split a list of grids, finest first, into grids of large levels and of small levels."""
    few = next((k for k, (height, width) in enumerate(grids) if height * width < _SMALL), 0)
    large = max(few, _LARGE)
    return grids[:large], grids[large:]


class SmallLevel(CpuLevel):
    """Level that may be the finest of the small levels.

    Attributes
    ----------
    together : SmallLevels or None
        All small levels if this level is the finest small level, otherwise None.
    """

    together: SmallLevels | None = None

    @property
    def spare_correction(self) -> Vector:
        """Second array of `relax`, which alternates with `correction`."""
        return self._other

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Compute the correction, using all coarser levels if there are any."""
        if self.together is None:
            super().finish(steps, coarsest)
        else:
            self.correction = self.together.cycle(steps, coarsest)


class SmallLevels:
    """Shared memory of the small levels, and their V-cycle.

    Parameters
    ----------
    grids : sequence of tuple of int
        Grids of the levels, finest first.
    planes : int
        Number of model planes per level.
    level : callable
        Function that returns a level for a grid and an iterator over its arrays, in the order of
        `small_cycle`.
    cycle : callable
        V-cycle: ``cycle(values, table, down, up, coarsest)``.
    """

    def __init__(
        self,
        grids: Grids,
        planes: int,
        level: Callable[[tuple[int, ...], Iterator[Vector]], Any],
        cycle: Callable[..., None],
    ) -> None:
        self._grids, self._planes, self._level, self._cycle = grids, planes, level, cycle
        shapes = [tuple(side + 4 for side in grid) for grid in grids]
        arrays = 2 * int(small_cycle.MODEL)
        starts = np.cumsum([0, *((arrays + planes) * height * width for height, width in shapes)])
        self._values: Vector = np.zeros(starts[-1], dtype=np.float32)
        self._table = np.array([(*grid, start) for grid, start in zip(grids, starts, strict=False)])
        self.levels = []
        for grid, shape, start in zip(grids, shapes, starts, strict=False):
            size = (arrays + planes) * shape[0] * shape[1]
            values = self._values[start : start + size].reshape(-1, *shape)
            self.levels.append(level(grid, _arrays(values, arrays)))
        first = self.levels[0]
        self._pair = first.correction, first.spare_correction
        first.together, first.finishes_cycle = self, True

    def copy(self) -> SmallLevels:
        """Return a copy of all levels."""
        made = SmallLevels(self._grids, self._planes, self._level, self._cycle)
        np.copyto(made._values, self._values)
        return made

    def cycle(self, steps: Steps, coarsest: Steps) -> Vector:
        """Run a V-cycle and return the correction of the finest small level."""
        self._cycle(
            self._values,
            self._table,
            paces_of(steps, from_zero=True),
            paces_of(steps, from_zero=False),
            paces_of(coarsest, from_zero=True),
        )
        number = len(coarsest) if len(self.levels) == 1 else 2 * len(steps)
        found: Vector = self._pair[0 if number % 2 == 1 else 1]
        return found


def _arrays(values: npt.NDArray[np.float32], shared: int) -> Iterator[Vector]:
    """Yield a level's arrays with two planes each, then the planes of its model."""
    for number in range(0, shared, 2):
        yield values[number : number + 2]
    yield values[shared:]
