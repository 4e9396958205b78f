"""Small levels, which share memory and run V-cycles on one thread; see `small_cycle`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from napari_hmrf.solver.backends.cpu import small_cycle
from napari_hmrf.solver.backends.cpu.level import Vector, paces_of
from napari_hmrf.solver.backends.linear import Steps

Grids = Sequence[tuple[int, ...]]

# Number of sites below which a level is small, and number of finest levels that are never treated
# as small, so that a small problem compiles all kernels that a large problem requires.
_SMALL, _LARGE = 8000, 2


def divided(grids: Grids) -> tuple[Grids, Grids]:
    """Split a list of grids, finest first, into grids of large levels and of small levels.

    All levels of a volume are large.
    """
    if len(grids[0]) == 3:
        return grids, []
    few = next((k for k, (height, width) in enumerate(grids) if height * width < _SMALL), 0)
    large = max(few, _LARGE)
    return grids[:large], grids[large:]


class SmallLevels:
    """Shared memory of the small levels, and their V-cycle.

    Parameters
    ----------
    grids : sequence of tuple of int
        Grids of the levels, finest first.
    planes : int
        Number of model planes per level.
    level : callable
        Function that returns a level for a grid and its memory: arrays by name, including the
        model planes "own".
    cycle : callable
        V-cycle: ``cycle(values, table, down, up, coarsest)``.
    """

    def __init__(
        self,
        grids: Grids,
        planes: int,
        level: Callable[[tuple[int, ...], Mapping[str, Vector]], Any],
        cycle: Callable[..., None],
    ) -> None:
        self._grids, self._planes, self._level, self._cycle = grids, planes, level, cycle
        shapes = [tuple(side + 4 for side in grid) for grid in grids]
        arrays = 2 * int(small_cycle.MODEL)
        starts = np.cumsum([0, *((arrays + planes) * height * width for height, width in shapes)])
        self._values: Vector = np.zeros(starts[-1], dtype=np.float32)
        self._table = np.array([(*grid, start) for grid, start in zip(grids, starts, strict=False)])
        self.levels, self._pairs = [], []
        for grid, shape, start in zip(grids, shapes, starts, strict=False):
            size = (arrays + planes) * shape[0] * shape[1]
            memory = _memory(self._values[start : start + size].reshape(-1, *shape))
            self._pairs.append((memory["correction"], memory["other"]))
            self.levels.append(level(grid, memory))
        for number, made in enumerate(self.levels):
            made.cycle_to_coarsest = partial(self.cycle, number)

    def copy(self) -> SmallLevels:
        """Return a copy of all levels."""
        made = SmallLevels(self._grids, self._planes, self._level, self._cycle)
        np.copyto(made._values, self._values)
        return made

    def cycle(self, first: int, steps: Steps, coarsest: Steps) -> Vector:
        """Run a V-cycle from a small level, 0 for the finest, and return its correction."""
        self._cycle(
            self._values,
            self._table[first:],
            paces_of(steps, from_zero=True),
            paces_of(steps, from_zero=False),
            paces_of(coarsest, from_zero=True),
        )
        is_last = first == len(self.levels) - 1
        number = len(coarsest) if is_last else 2 * len(steps)
        found: Vector = self._pairs[first][0 if number % 2 == 1 else 1]
        return found


def _memory(values: Vector) -> dict[str, Vector]:
    """Return the arrays of a level by name, at the places where `small_cycle` finds them."""
    places = {
        "inverse": small_cycle.INVERSE,
        "load": small_cycle.LOAD,
        "correction": small_cycle.CORRECTION,
        "other": small_cycle.OTHER,
        "pins": small_cycle.PINS,
        "weight": small_cycle.WEIGHT,
    }
    memory = {name: values[2 * place : 2 * place + 2] for name, place in places.items()}
    return {**memory, "own": values[2 * small_cycle.MODEL :]}
