"""What a solve begins with: the combination of earlier solutions that comes closest to it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ArgumentError
from napari_hmrf.solver.backends.found import Beginning
from napari_hmrf.solver.loads import is_equal
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.real_arrays import FloatArray
from napari_hmrf.solver.solution import Solution

#: What a solve may begin with.
Initial = Solution | Sequence[Solution]
Float64Array = npt.NDArray[np.float64]
# Changes that are this much of the greatest, or less, are the same change but for rounding.
_SAME = 1e-5
_TINY = 1e-300
# Values of loads that are looked at at once.
_AT_ONCE = 1 << 20


def beginning(initial: Initial, problem: Problem) -> Beginning:
    """The combination of earlier solutions that comes closest to what is observed and what pulls.

    How far tissue moves is proportional to how far it is pushed. Their shares add up to one: what
    all of them have in common stays.

    Raises
    ------
    ArgumentError
        If one is of another grid.
    """
    solutions = (initial,) if isinstance(initial, Solution) else tuple(initial)
    for each in solutions:
        theirs, ours = (each.tissue.shape, each.spacing), (problem.shape, problem.spacing)
        if theirs != ours:
            raise ArgumentError(
                f"initial is of a grid of {theirs[0]} pixels of size {theirs[1]}, but the problem "
                f"of {ours[0]} pixels of size {ours[1]}. Leave it out"
            )
    displacements = tuple(each.displacement for each in solutions)
    blocks = _Blocks(problem, solutions)
    count = len(solutions) - 1
    normal, right = np.zeros((count, count)), np.zeros(count)
    for wanted, (first, *others) in blocks:
        if others:
            changes = np.stack(others) - first
            # `einsum`, as the threads that a larger product wakes in BLAS would go on to wait for
            # more, on the cores that the solve needs.
            normal += np.einsum("an,bn->ab", changes, changes)
            right += np.einsum("an,n->a", changes, wanted - first)
    found = _nearest(normal, right) if count else right
    missing = 0.0 if blocks.comparable else math.inf
    for wanted, (first, *others) in blocks:
        left = wanted - first
        if others:
            left -= np.einsum("a,an->n", found, np.stack(others) - first)
        missing = max(missing, float(np.abs(left).max(initial=0.0)))
    shares = (1.0 - float(found.sum()), *map(float, found))
    return Beginning(displacements, shares, problem.unit, missing / problem.unit)


class _Blocks:
    """What is asked of a problem, and what was asked for each solution: observations, and loads."""

    # Loads are told as the motion that they cause, roughly, and in parts: a volume's are large.

    def __init__(self, problem: Problem, solutions: tuple[Solution, ...]) -> None:
        self._problem, self._solutions = problem, solutions
        given = [each.loads for each in solutions]
        self._loads: list[tuple[FloatArray | None, ...]] = []
        for name in ("growth", "force"):
            arrays = [None if each is None else getattr(each, name) for each in given]
            wanted = None if problem.loads is None else getattr(problem.loads, name)
            if not all(is_equal(each, wanted) for each in arrays):
                self._loads.append((wanted, *arrays))
        shapes = [{each.shape for each in some if each is not None} for some in self._loads]
        #: Whether all loads are told in the same way.
        self.comparable = all(len(each) == 1 for each in shapes)

    def __iter__(self) -> Iterator[tuple[Float64Array, list[Float64Array]]]:
        """Blocks of what is asked of the problem, and what was of each solution."""
        at = np.flatnonzero(self._problem.known)
        displacements = [each.displacement.ravel()[at] for each in self._solutions]
        observed = self._problem.observed.ravel()[at].astype(np.float64)
        yield observed, [each.astype(np.float64) for each in displacements]
        if not self.comparable:
            return
        for arrays in self._loads:
            there = [each for each in arrays if each is not None]
            most = max(float(np.abs(each).max()) for each in there)
            scale = self._reach / most if most > 0 else 0.0
            for begin in range(0, there[0].size, _AT_ONCE):
                some = slice(begin, min(begin + _AT_ONCE, there[0].size))
                wanted, *others = (
                    np.zeros(some.stop - some.start)
                    if each is None
                    else scale * each.reshape(-1)[some].astype(np.float64)
                    for each in arrays
                )
                yield wanted, others

    @cached_property
    def _reach(self) -> float:
        """How far tissue has moved."""
        return max(float(np.abs(each.displacement).max()) for each in self._solutions)


def _nearest(normal: Float64Array, right: Float64Array) -> Float64Array:
    """How often to take each change so that their sum comes closest to what is missing."""
    # The normal equations are few, and what is observed may be much. They are damped a little: of
    # changes that are the same each takes a part.
    damped = normal + (_SAME**2 * np.trace(normal) + _TINY) * np.eye(len(right))
    return np.linalg.solve(damped, right)
