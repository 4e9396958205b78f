"""What was found before, for the next solve to begin with."""

from __future__ import annotations

import numpy as np

from napari_hmrf.solver.loads import are_same
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution

#: How many are kept. Each costs a pass over the image; a patch that is dragged about has two
#: directions, and with the place it set out from that makes three.
KEPT = 4


class Earlier:
    """The newest solutions of one grid, for different observations and loads.

    How far tissue moves is proportional to how far it is pushed: between them, a patch that was
    moved before is moved on by hardly a cycle.

    Attributes
    ----------
    solutions : list of Solution
        Newest first.
    """

    def __init__(self) -> None:
        self.solutions: list[Solution] = []
        self._newest: Problem | None = None
        self._of: tuple[object, ...] = ()

    def look_at(self, problem: Problem, series: object) -> None:
        """Forget all that is of another grid or another series."""
        of = (problem.shape, problem.spacing, series)
        if of != self._of:
            self._of = of
            self.solutions, self._newest = [], None

    def add(self, problem: Problem, solution: Solution) -> None:
        """Keep this; instead of the newest one, if the same was asked there."""
        before, self._newest = self._newest, problem
        if before is not None and _same_observations(before, problem):
            del self.solutions[0]
        self.solutions = [solution, *self.solutions][:KEPT]


def _same_observations(one: Problem, other: Problem) -> bool:
    return one is other or (
        are_same(one.loads, other.loads)
        and np.array_equal(one.observed, other.observed)
        and np.array_equal(one.confidence, other.confidence)
    )
