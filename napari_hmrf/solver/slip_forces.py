"""Forces of the observations that slip in a solution."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors import Elastic
from napari_hmrf.solver.problem import Problem

# Distance from its observed position, relative to the largest displacement and in pixels, up to
# which an observation is held; displacements have single precision.
_HELD, _HELD_PIXELS = 3e-7, 1e-4


def slip_forces(
    problem: Problem, prior: Elastic, displacement: npt.NDArray[np.floating]
) -> npt.NDArray[np.float64]:
    """Return the force of each observation that slips; 0 for all other components.

    Parameters
    ----------
    problem : Problem
    prior : ElasticPrior or NeoHookeanPrior
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement of a solution, in the unit of the spacing.

    Returns
    -------
    ndarray of the same shape
        Forces in the units of the model.
    """
    limit = prior.limit(problem)
    if limit is None:
        return np.zeros(problem.observed.shape)
    off = problem.observed.astype(np.float64) - displacement
    near = _HELD * float(np.abs(displacement).max()) + _HELD_PIXELS * problem.unit
    slips = problem.known & np.isfinite(limit) & (np.abs(off) > near)
    return np.where(slips, np.sign(off) * np.where(slips, limit, 0.0), 0.0)
