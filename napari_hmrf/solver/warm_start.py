"""What a solve begins with: the combination of earlier solutions that comes closest to it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ArgumentError
from napari_hmrf.solver.backends.found import Beginning
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution

#: What a solve may begin with.
Initial = Solution | Sequence[Solution]
Float64Array = npt.NDArray[np.float64]
# Changes that are this much of the greatest, or less, are the same change but for rounding.
_SAME = 1e-5
_TINY = 1e-300


def beginning(initial: Initial, problem: Problem) -> Beginning:
    """The combination of earlier solutions that comes closest to what is observed.

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
    at = np.flatnonzero(problem.known)
    first, *others = (each.ravel()[at].astype(np.float64) for each in displacements)
    missing = problem.observed.ravel()[at] - first
    shares = [1.0]
    if others:
        changes = np.stack(others) - first
        found = _nearest(changes, missing)
        missing -= np.einsum("a,an->n", found, changes)
        shares = [1.0 - float(found.sum()), *map(float, found)]
    unit = problem.unit
    return Beginning(displacements, tuple(shares), unit, float(np.abs(missing).max()) / unit)


def _nearest(changes: Float64Array, missing: Float64Array) -> Float64Array:
    """How often to take each change so that their sum comes closest to what is missing."""
    # The normal equations are few, and what is observed may be much. They are damped a little: of
    # changes that are the same each takes a part.
    # `einsum`, as the threads that a larger product wakes in BLAS would go on to wait for more, on
    # the cores that the solve needs.
    normal = np.einsum("an,bn->ab", changes, changes)
    normal += (_SAME**2 * np.trace(normal) + _TINY) * np.eye(len(changes))
    return np.linalg.solve(normal, np.einsum("an,n->a", changes, missing))
