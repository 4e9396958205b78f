"""Exact solutions as a reference; they share only the equations with the package.

Matrices are assembled entry by entry from fractions, as pairs of float64 (32 digits), and are
factorized without iteration. The states of observations that slip are verified by optimality
conditions. The computation is slow, but a result is accurate in all relevant digits unless it is
marked as not sure.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from napari_hmrf import ElasticPrior, Problem, SeilerPrior
from napari_hmrf.solver.connected import connected
from validation.oracles.exact.double_double import Factors, Matrix
from validation.oracles.exact.equations import matrix_of
from validation.oracles.exact.slip import Marks, balance, shortest

#: Relative stiffness of a motion below which tissue is free to move.
FREE = 1e-12


@dataclass(frozen=True, eq=False)
class Exact:
    """Exact displacement field of a problem.

    Attributes
    ----------
    displacement : ndarray, shape (H, W, 2), float64
        Displacement in pixels. If several fields are in equilibrium (see `motions`), the field with
        the least sum of squares.
    moving : ndarray of bool, shape (H, W, 2)
        Mask of components with forces. Other components are at their observed position or at rest.
    motions : int
        Number of independent zero-energy motions, given the observations.
    sure : bool
        True if the field is proven; False if it is only the last field of the search.
    edge : bool
        True if a relative change of some force by 1e-6 would change the number of motions.
    accuracy : float
        Change of the displacement in the last refinement step, in pixels.
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
        """Least eigenvalue with all observations prescribed, for a diagonal scaled to 1.

        It is 0 if there is still a zero-energy motion.
        """
        if not self._matrix.symmetric:
            return 1.0  # by a maximum principle, each site depends on a site that is prescribed
        return Factors(self._matrix, np.flatnonzero(self._loose)).least

    @functools.cached_property
    def least_found(self) -> float:
        """Least eigenvalue if only the observations that do not slip are prescribed.

        If it is below the rounding of double precision, double precision cannot resolve the field.
        """
        if not self._matrix.symmetric:
            return 1.0
        return Factors(self._matrix, np.flatnonzero(self._loose | self._let_go)).least

    @property
    def free(self) -> bool:
        """True if there is a zero-energy motion even with all observations prescribed."""
        return self.least < FREE


def exact_field(
    problem: Problem, prior: ElasticPrior | SeilerPrior, strength: npt.ArrayLike = 1.0
) -> Exact:
    """Find the field in which tissue and observations are in equilibrium.

    Parameters
    ----------
    problem : Problem
        Problem to solve.
    prior : ElasticPrior or SeilerPrior
        Prior of the tissue.
    strength : array_like, broadcast to (H, W, 2)
        Factor on the force of each observation, to test the sensitivity to it.
    """
    if isinstance(prior, SeilerPrior):
        prior = prior.resolved(problem)  # a default penalty is that of all tissue
    joined = connected(problem, prior)
    problem = joined.problem
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
    field = d.reshape(problem.observed.shape) * problem.unit
    joined.extend(field)
    field /= problem.unit
    return Exact(
        field,
        moving.reshape(problem.observed.shape),
        motions,
        not slips or found is not None,
        found is not None and found.edge,
        last,
        matrix,
        loose,
        let_go,
    )
