"""Small levels, which share memory and run V-cycles on one thread; see `small_cycle`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import small_cycle
from napari_hmrf.solver.backends.cpu.level import Vector, paces_of
from napari_hmrf.solver.backends.linear import Steps

Indices = npt.NDArray[np.int64]
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
    responses : callable, optional
        Several V-cycles, such as `small.responses`, with the arguments of `cycle` and
        ``number, at, found``.
    """

    def __init__(
        self,
        grids: Grids,
        planes: int,
        level: Callable[[tuple[int, ...], Mapping[str, Vector]], Any],
        cycle: Callable[..., None],
        responses: Callable[..., None] | None = None,
    ) -> None:
        self._grids, self._planes, self._level, self._cycle = grids, planes, level, cycle
        self._responses = responses
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
            if responses is not None:
                made.responses = partial(self.responses, number)

    def copy(self) -> SmallLevels:
        """Return a copy of all levels."""
        made = SmallLevels(self._grids, self._planes, self._level, self._cycle, self._responses)
        np.copyto(made._values, self._values)
        return made

    def cycle(self, first: int, steps: Steps, coarsest: Steps) -> Vector:
        """Run a V-cycle from a small level, 0 for the finest, and return its correction."""
        self._cycle(*self._arguments(first, steps, coarsest))
        correction, other = self._pairs[first]
        in_correction = self._place(first, steps, coarsest) == small_cycle.CORRECTION
        return correction if in_correction else other

    def responses(self, first: int, steps: Steps, coarsest: Steps, at: Indices) -> Vector:
        """Return the corrections of a V-cycle for a unit load at each of several values of a level.

        Parameters
        ----------
        first : int
            Number of the level, 0 for the finest.
        steps, coarsest : sequence of (float, float)
            Smoothing steps on each level, and on the coarsest level.
        at : ndarray of int64, shape (N,)
            Indices of the values in the flattened planes of the level.

        Returns
        -------
        ndarray, shape (N, N)
            Correction at each of the values, in a row for each load.
        """
        assert self._responses is not None
        found: Vector = np.empty((len(at), len(at)), np.float32)
        number = self._place(first, steps, coarsest)
        self._responses(*self._arguments(first, steps, coarsest), number, at, found)
        return found

    def _arguments(self, first: int, steps: Steps, coarsest: Steps) -> tuple[Any, ...]:
        """Return the arguments of a V-cycle from a small level."""
        return (
            self._values,
            self._table[first:],
            paces_of(steps, from_zero=True),
            paces_of(steps, from_zero=False),
            paces_of(coarsest, from_zero=True),
        )

    def _place(self, first: int, steps: Steps, coarsest: Steps) -> np.int64:
        """Return which array of a level contains its correction after a V-cycle."""
        is_last = first == len(self.levels) - 1
        number = len(coarsest) if is_last else 2 * len(steps)
        return small_cycle.CORRECTION if number % 2 == 1 else small_cycle.OTHER


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
