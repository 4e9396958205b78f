"""Warm start: the linear combination of earlier solutions that is closest to a problem."""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import ArgumentError
from napari_hmrf.real_arrays import FloatArray, are_equal
from napari_hmrf.solver.backends.earlier_results import WarmStart
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution

#: One or more solutions used as a warm start.
Initial = Solution | Sequence[Solution]
Float64Array = npt.NDArray[np.float64]
# Relative difference up to which two changes count as equal.
_ROUNDING = 1e-5
# Value added to the diagonal of the normal equations, to keep them regular if all changes are 0.
_TINY = 1e-300
# Values of the latest solutions at the indices of observations, to which a drag adds one solution
# in each frame.
_seen: Kept[_Seen] = Kept()
# Number of load values that are compared at once, to limit the use of memory.
_BLOCK_SIZE = 1 << 20


def combine_solutions(initial: Initial, problem: Problem) -> WarmStart:
    """Return the combination of earlier solutions that is closest to the observations and loads.

    Displacements are proportional to observations and loads. The weights of the solutions add up to
    one, so that the common part of all solutions is preserved.

    Parameters
    ----------
    initial : Solution or sequence of Solution
    problem : Problem

    Returns
    -------
    WarmStart
        Displacements, their weights, and the largest deviation from the observations and loads.

    Raises
    ------
    ArgumentError
        If a solution has another grid.
    """
    solutions = (initial,) if isinstance(initial, Solution) else tuple(initial)
    for solution in solutions:
        shape, spacing = solution.tissue.shape, solution.spacing
        if (shape, spacing) != (problem.shape, problem.spacing):
            raise ArgumentError(
                f"initial has a grid of {shape} pixels of size {spacing}, but the problem has a "
                f"grid of {problem.shape} pixels of size {problem.spacing}. Leave initial out"
            )
    displacements = tuple(solution.displacement for solution in solutions)
    blocks = _Blocks(problem, solutions)
    count = len(solutions) - 1
    normal, right = np.zeros((count, count)), np.zeros(count)
    for target, first, changes in blocks:
        if count:
            # `einsum`, because a matrix product in BLAS starts threads, which would occupy the
            # cores that the solve needs.
            normal += np.einsum("an,bn->ab", changes, changes)
            right += np.einsum("an,n->a", changes, target - first)
    weights = _nearest(normal, right) if count else right
    deviation = 0.0 if blocks.comparable else math.inf
    for target, first, changes in blocks:
        difference = target - first
        if count:
            difference -= np.einsum("a,an->n", weights, changes)
        deviation = max(deviation, float(np.abs(difference).max(initial=0.0)))
    shares = (1.0 - float(weights.sum()), *map(float, weights))
    latest = solutions[0].reach
    unfinished = latest is not None and latest.stopped
    return WarmStart(displacements, shares, problem.unit, deviation / problem.unit, unfinished)


def nearest_to_targets(solution: Solution, earlier: Initial) -> Solution:
    """Return the solution of a large motion that is closest to its targets.

    A solve that continues an earlier one may end farther from its targets, because tissue buckles
    another way. Growth that was completed counts first, then the distance of the farthest site from
    its target, then the distance from equilibrium.

    Parameters
    ----------
    solution : Solution
        Latest solution.
    earlier : Solution or sequence of Solution
        Earlier solutions; those of another problem or prior are ignored.

    Returns
    -------
    Solution
        `solution`, or an earlier solution that is closer. The latter is marked as stopped only if
        `solution` is, because a larger budget would not lead further otherwise.
    """
    best = solution
    for each in (earlier,) if isinstance(earlier, Solution) else earlier:
        if _shortfall(each) < _shortfall(best) and _is_same_problem(each, solution):
            best = each
    if best is solution or best.reach is None or solution.reach is None:
        return best
    return replace(best, reach=replace(best.reach, stopped=solution.reach.stopped))


def _shortfall(solution: Solution) -> tuple[float, float, float]:
    """Return how far a solution of large motion is from its growth, targets and equilibrium."""
    reach = solution.reach
    return (0.0, 0.0, 0.0) if reach is None else (-reach.grown, reach.missing, reach.unbalanced)


def _is_same_problem(one: Solution, other: Solution) -> bool:
    """Return whether two solutions on one grid have the same problem and prior."""
    first, second = one.provenance, other.provenance
    same_prior = first.parameters.get("prior") == second.parameters.get("prior")
    return same_prior and first.inputs == second.inputs


class _Seen:
    """Values of displacements at observations.

    Parameters
    ----------
    at : ndarray of int
        Indices of the observed components.
    """

    def __init__(self, at: npt.NDArray[np.intp]) -> None:
        self.at = at
        self._latest: list[tuple[weakref.ref[FloatArray], FloatArray]] = []

    def of(self, displacements: Sequence[FloatArray]) -> list[FloatArray]:
        """Return the values of displacements, which stay known until the next call."""
        known = [(ref(), values) for ref, values in self._latest]
        found = []
        for displacement in displacements:
            values = next((each for other, each in known if other is displacement), None)
            found.append(displacement.ravel().take(self.at) if values is None else values)
        self._latest = [
            (weakref.ref(each), values) for each, values in zip(displacements, found, strict=True)
        ]
        return found


class _Blocks:
    """Observations and loads of a problem and of each solution, in blocks of values."""

    # Loads are scaled to the size of the displacements, so that both have similar weights. They
    # are split into blocks, because the loads of a volume are large. Values in void are left out:
    # no combination could match those of tissue that was removed.

    def __init__(self, problem: Problem, solutions: tuple[Solution, ...]) -> None:
        self._problem, self._solutions = problem, solutions
        loads = [solution.loads for solution in solutions]
        self._loads: list[tuple[FloatArray | None, ...]] = []
        for name in ("growth", "force"):
            arrays = [None if each is None else getattr(each, name) for each in loads]
            target = None if problem.loads is None else getattr(problem.loads, name)
            if not all(are_equal(array, target) for array in arrays):
                self._loads.append((target, *arrays))
        shapes = [{each.shape for each in arrays if each is not None} for arrays in self._loads]
        #: True if all loads have the same form, such as one number for each site.
        self.comparable = all(len(forms) == 1 for forms in shapes)

    def __iter__(self) -> Iterator[tuple[Float64Array, Float64Array, Float64Array]]:
        """Yield blocks: values of the problem and of the first solution, changes to the others."""
        yield self._observations
        if not self.comparable:
            return
        for arrays in self._loads:
            given = [array for array in arrays if array is not None]
            largest = max(map(self._largest, given))
            scale = self._largest_displacement / largest if largest > 0 else 0.0
            tissue = self._problem.tissue.reshape(-1)
            count = given[0].size // tissue.size
            sites = max(_BLOCK_SIZE // count, 1)
            for begin in range(0, tissue.size, sites):
                block = slice(begin, begin + sites)
                mask = tissue[block]
                yield _with_changes(
                    np.zeros(count * int(np.count_nonzero(mask)))
                    if array is None
                    else scale * array.reshape(-1, count)[block][mask].astype(np.float64).ravel()
                    for array in arrays
                )

    @cached_property
    def _observations(self) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Observed displacements, those of the first solution, and changes to the others."""
        problem = self._problem
        own = problem.known_values
        parts = _seen.get(
            lambda last: last.at is problem.known_at, lambda: _Seen(problem.known_at)
        ).of([each.displacement for each in self._solutions])
        # Components that are the same everywhere, such as those of fixed tissue, have no effect.
        varies = np.zeros(len(own), dtype=np.bool_)
        for part in parts:
            varies |= part != own
        return _with_changes(each[varies] for each in (own, *parts))

    def _largest(self, values: FloatArray) -> float:
        """Return the largest absolute value in tissue, of values of shape (H, W, ...)."""
        tissue = self._problem.tissue.reshape(-1, 1)
        sizes = np.abs(values).reshape(len(tissue), -1)
        return float(sizes.max(where=tissue, initial=0.0))

    @cached_property
    def _largest_displacement(self) -> float:
        """Largest absolute value of any displacement component of any solution in tissue."""
        return max(self._largest(each.displacement) for each in self._solutions)


def _with_changes(
    values: Iterable[npt.NDArray[np.floating]],
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the first two arrays, and the differences of the others from the second array."""
    target, first, *others = (each.astype(np.float64) for each in values)
    changes = np.empty((len(others), len(first)))
    for change, other in zip(changes, others, strict=True):
        np.subtract(other, first, out=change)
    return target, first, changes


def _nearest(normal: Float64Array, right: Float64Array) -> Float64Array:
    """Solve the normal equations for the weight of each change."""
    # There are few equations, independent of the number of observations. Weak damping
    # distributes the weight equally over equal changes.
    damped = normal + (_ROUNDING**2 * np.trace(normal) + _TINY) * np.eye(len(right))
    return np.linalg.solve(damped, right)
