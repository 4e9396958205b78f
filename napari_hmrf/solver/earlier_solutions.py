"""Earlier solutions, from which the next solve starts."""

from __future__ import annotations

import numpy as np

from napari_hmrf.solver.loads import are_same
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution

#: Number of solutions to keep. Each costs a pass over the image. A patch that is dragged has two
#: directions and an origin, which makes three; one more is kept in reserve.
KEPT = 4


class Earlier:
    """The latest solutions on one grid, for different observations and loads.

    Displacements are proportional to the prescribed ones, so that a linear combination of these
    solutions is often so close that the next solve takes hardly a cycle.

    Attributes
    ----------
    solutions : list of Solution
        Latest first.
    """

    def __init__(self) -> None:
        self.solutions: list[Solution] = []
        self._newest: Problem | None = None
        self._of: tuple[object, ...] = ()

    def look_at(self, problem: Problem, series: object) -> None:
        """Discard all solutions if the grid or the series has changed."""
        of = (problem.shape, problem.spacing, series)
        if of != self._of:
            self._of = of
            self.solutions, self._newest = [], None

    def add(self, problem: Problem, solution: Solution) -> None:
        """Keep a solution; it replaces the latest one if both have the same observations."""
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
