"""Earlier solutions, used as warm starts for the next solve."""

from __future__ import annotations

from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.loads import are_same
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution

#: Number of solutions to store. Each solution costs a pass over the image. A dragged patch needs
#: three: one for each of two directions, and one for the origin. One more is in reserve.
KEPT = 4


# Smallest Jacobian determinant of a solution that is used as a warm start for large motion.
_CRUSHED = 0.01


class EarlierSolutions:
    """Most recent solutions on one grid, for different observations and loads.

    Displacements are proportional to observations and loads. A linear combination of these
    solutions is therefore often close to the next solution, which then needs only a few cycles.

    Attributes
    ----------
    solutions : list of Solution
        Solutions, most recent first.
    """

    def __init__(self) -> None:
        self.solutions: list[Solution] = []
        self._latest_problem: Problem | None = None
        self._on_its_way: tuple[Problem, Solution] | None = None
        self._key: tuple[object, ...] = ()

    def keep_for(self, problem: Problem, series: object) -> None:
        """Discard all solutions if the grid or the series has changed."""
        key = (problem.shape, problem.spacing, series)
        if key != self._key:
            self._key = key
            self.solutions, self._latest_problem, self._on_its_way = [], None, None

    def begin_with(self, solution: Solution, problem: Problem) -> None:
        """Store a solution from a file, if it has the grid of a problem and is the first."""
        grid = solution.tissue.shape, tuple(solution.spacing)
        if not self.solutions and grid == (problem.shape, tuple(problem.spacing)):
            self.solutions = [solution]

    def starts(self, problem: Problem, *, large_motion: bool) -> list[Solution]:
        """Return the solutions from which a problem is solved.

        In large motion, a start from elastic tissue, which may be almost folded, or from crushed
        tissue takes longer than a cold start, except for the same observations.

        Parameters
        ----------
        problem : Problem
        large_motion : bool
            True to solve the problem in large motion.
        """
        begun = self._on_its_way
        if begun is not None and _same_observations(begun[0], problem):
            return [begun[1]]
        if not large_motion:
            return [each for each in self.solutions if not _is_crushed(each)]
        latest = self._latest_problem
        is_same = latest is not None and _same_observations(latest, problem)
        return [
            each
            for number, each in enumerate(self.solutions)
            if each.reach is not None and ((is_same and number == 0) or not _is_crushed(each))
        ]

    def keep_on_its_way(self, problem: Problem, solution: Solution) -> None:
        """Store a solution on its way, from which only a solve of the same problem starts."""
        self._on_its_way = problem, solution

    def add(self, problem: Problem, solution: Solution) -> None:
        """Store a solution; it replaces the latest solution if both have the same observations."""
        before, self._latest_problem, self._on_its_way = self._latest_problem, problem, None
        if before is not None and _same_observations(before, problem):
            del self.solutions[0]
        known = solution.displacement
        others = [each for each in self.solutions if each.displacement is not known]
        self.solutions = [solution, *others][:KEPT]


def _is_crushed(solution: Solution) -> bool:
    """Return whether tissue is so crushed that a cold start is faster than a warm start."""
    reach = solution.reach
    return reach is not None and not reach.stopped and reach.least_jacobian < _CRUSHED


def _same_observations(one: Problem, other: Problem) -> bool:
    """Return whether two problems on one grid have the same observations and loads."""
    return one is other or (
        are_same(one.loads, other.loads)
        and are_equal(one.known_values, other.known_values)
        and are_equal(one.confidence, other.confidence)
        and are_equal(one.tissue, other.tissue)
    )
