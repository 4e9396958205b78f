"""Where tissue goes, exactly: an oracle that shares nothing with the package but its equations.

Matrices are assembled entry by entry from fractions, in pairs of float64 (32 digits), factorised
without iteration, and observations that slip are decided by conditions that prove the result. It
is slow and cannot be wrong by a digit that matters; what it is not sure of, it says.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from exact.direct import Factors
from exact.matrices import Matrix, matrix_of
from exact.slip import Marks, balance, shortest
from napari_hmrf import ElasticPrior, Problem, SeilerPrior

#: Tissue that resists some motion with less than this part of what holds its sites is free.
FREE = 1e-12


@dataclass(frozen=True, eq=False)
class Exact:
    """The field of a problem.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2), float64
        In pixels. Of several in balance (see `motions`), the one whose sum of squares is least.
    moving : ndarray of bool, shape (H, W, 2)
        What anything pulls at: elsewhere tissue is where it was seen, or at rest.
    motions : int
        The number of independent motions that cost nothing, observations counted as they are.
    sure : bool
        Whether the field is proven; else it is only where the search ended.
    edge : bool
        Whether a millionth of some force decides how many motions there are.
    accuracy : float
        What the last step of refinement changed, in pixels.
    """

    displacement: npt.NDArray[np.float64]
    moving: npt.NDArray[np.bool_]
    motions: int
    sure: bool
    edge: bool
    accuracy: float
    _matrix: Matrix
    _loose: npt.NDArray[np.bool_]
    _let_go: npt.NDArray[np.bool_]

    @functools.cached_property
    def least(self) -> float:
        """The least eigenvalue if all that is observed is held, the diagonal scaled to 1.

        0 if tissue could still move at no cost.
        """
        if not self._matrix.symmetric:
            return 1.0  # a maximum principle holds: each site hangs on one that stays where it is
        return Factors(self._matrix, np.flatnonzero(self._loose)).least

    @functools.cached_property
    def least_found(self) -> float:
        """The least eigenvalue if only the observations that do not slip are held.

        Below the rounding of double precision, the field depends on digits that it does not have.
        """
        if not self._matrix.symmetric:
            return 1.0
        return Factors(self._matrix, np.flatnonzero(self._loose | self._let_go)).least

    @property
    def free(self) -> bool:
        """Whether some tissue could move at no cost even if all that is observed is held."""
        return self.least < FREE


def exact_field(
    problem: Problem, prior: ElasticPrior | SeilerPrior, strength: npt.ArrayLike = 1.0
) -> Exact:
    """Find the field in which tissue and observations balance.

    Parameters
    ----------
    problem : Problem
    prior : ElasticPrior or SeilerPrior
    strength : array_like, broadcast to (H, W, 2)
        Multiplies the force of each observation, to see how much depends on it.
    """
    matrix = matrix_of(problem, prior)
    moving = matrix.diagonal > 0
    observed = ((problem.confidence > 0) & (problem.stiffness > 0)[..., None]).ravel()
    y = problem.observed.astype(np.float64).ravel() / math.sqrt(
        problem.spacing[0] * problem.spacing[1]
    )
    rest = np.where(observed, y, 0.0)
    loose = moving & ~observed
    limits = prior.limit(problem)
    slips = limits is not None
    found, let_go = None, np.zeros_like(observed)
    if limits is not None:
        fixed = observed & np.isinf(limits).ravel()
        at = np.flatnonzero(moving & observed & ~fixed)
        limit = np.broadcast_to(strength * limits, limits.shape).ravel()[at]
        found = balance(matrix, moving & ~fixed, Marks(at, y[at], limit), rest)
    if found is not None:
        d, motions, last = found.displacement, found.motions, found.last_step
        let_go[at[~found.held]] = True
    else:
        factors = Factors(matrix, np.flatnonzero(loose))
        d, _ = factors.displaced(rest, np.zeros_like(rest))
        nowhere = np.zeros(0, np.int64)
        d = shortest(matrix, d, factors.motions, nowhere, np.zeros(0), np.zeros(0))
        motions, last = len(factors.motions), factors.last_step
    return Exact(
        d.reshape(problem.observed.shape),
        moving.reshape(problem.observed.shape),
        motions,
        not slips or found is not None,
        found is not None and found.edge,
        last,
        matrix,
        loose,
        let_go,
    )
