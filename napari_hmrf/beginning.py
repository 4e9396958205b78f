"""What a solve begins with: the combination of earlier solutions that comes closest to it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from napari_hmrf.backends.base import FloatArray
from napari_hmrf.backends.host import Beginning
from napari_hmrf.problem import Problem
from napari_hmrf.solution import Solution

#: What a solve may begin with.
Start = Solution | Sequence[Solution]
# Changes that are this much of the greatest, or less, are the same change but for rounding.
_SAME = 1e-5
_TINY = 1e-300


def beginning(start: Start, problem: Problem) -> Beginning:
    """The combination of earlier solutions that comes closest to what is observed.

    How far tissue moves is proportional to how far it is pushed. Their shares add up to one: what
    all of them have in common stays.

    Raises
    ------
    ValueError
        If one is of another grid.
    """
    solutions = (start,) if isinstance(start, Solution) else tuple(start)
    for each in solutions:
        theirs, ours = (each.tissue.shape, each.spacing), (problem.shape, problem.spacing)
        if theirs != ours:
            raise ValueError(
                f"start is of a grid of {theirs[0]} pixels of size {theirs[1]}, but the problem of "
                f"{ours[0]} pixels of size {ours[1]}. Leave it out"
            )
    displacements = tuple(each.displacement for each in solutions)
    shares = _shares(displacements, problem) if len(displacements) > 1 else [1.0]
    return Beginning(displacements, tuple(share / problem.unit for share in shares))


def _shares(displacements: Sequence[FloatArray], problem: Problem) -> list[float]:
    """By least squares, where something is observed."""
    at = np.flatnonzero(problem.observed)
    first, *others = (each.ravel()[at].astype(np.float64) for each in displacements)
    changes = np.stack(others) - first
    # The normal equations are few, and what is observed may be much. They are damped a little: of
    # changes that are the same each takes a part.
    # `einsum`, as the threads that a larger product wakes in BLAS would go on to wait for more, on
    # the cores that the solve needs.
    normal = np.einsum("an,bn->ab", changes, changes)
    normal += (_SAME**2 * np.trace(normal) + _TINY) * np.eye(len(others))
    missing = np.einsum("an,n->a", changes, problem.y.ravel()[at] - first)
    found = np.linalg.solve(normal, missing)
    return [1.0 - float(found.sum()), *map(float, found)]
