"""Affine drift beside observations that may slip.

The least energy E(a) of a field with the drift a is convex. As long as the same observations slip,
it is the energy of a problem in which these observations are forces and the others are certain, and
`drift` finds the drift of this problem exactly. The drift and the slipping observations are
therefore found in turn, as in Newton's method. Halved steps ensure that the energy decreases.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.drift import (
    Progress,
    Solve,
    drift_clauses,
    growth_of,
    provenance_of,
    solve_with_drift,
    without_drift,
)
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.optimizers import Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.slip_forces import slip_forces
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.warm_start import Initial

Float64Array = npt.NDArray[np.float64]
# Share of the tolerance for each of the two fields that are compared, and for their difference.
_SHARE, _AGREE = 0.3, 0.4
# Factor on the tolerance if the same observations slip as with the last drift, and least factor.
_TIGHTER, _TIGHTEST = 0.3, 1e-3
# Largest number of drifts, and of halved steps to each of them.
_MOST_DRIFTS, _MOST_HALVINGS = 30, 20
# Relative decrease of the energy that is rounding error.
_ROUNDING = 1e-9


def solve_with_slipping_drift(
    problem: Problem,
    prior: ElasticPrior,
    optimizer: Optimizer,
    progress: Progress | None,
    initial: Initial | None,
    solve: Solve,
) -> Solution:
    """Solve a problem with observations that may slip together with its drift.

    Parameters
    ----------
    problem : Problem
    prior : ElasticPrior
    optimizer : Optimizer
    progress : callable or None
    initial : Solution, sequence of Solution, or None
        Warm start.
    solve : callable
        Function that solves a problem without drift.

    Raises
    ------
    ProblemError
        As for `solve_with_drift`, for the observations that do not slip.
    ConvergenceError
        If the drift and the slipping observations do not converge.
    """
    begun = time.perf_counter()
    schedule, tolerance = optimizer, Multigrid.tolerance
    if isinstance(optimizer, Multigrid):
        tolerance = optimizer.tolerance
        schedule = replace(optimizer, tolerance=_SHARE * tolerance)
    exact = replace(prior, penalty=math.inf)

    def solve_for(strain: Float64Array, start: Initial | None) -> Solution:
        loads = Loads(growth=growth_of(problem, strain), spacing=problem.spacing)
        loads = loads if problem.loads is None else problem.loads + loads
        return solve(variant_of(plain, loads=loads), prior, schedule, start, progress)

    # Other tissue follows the tissue near it, and does so differently if it is certain.
    of_elements = sites_of_elements(problem.tissue)
    plain, drift = without_drift(problem), np.zeros((len(problem.shape),) * 2)
    slipped, known = solve_for(drift, initial), None
    joined = connected(problem, prior).problem
    for _ in range(_MOST_DRIFTS):
        states = _with_states(joined, prior, slipped, of_elements)
        is_same = known is not None and np.array_equal(states.known, known)
        if is_same and isinstance(schedule, Multigrid):
            # The same observations slip, so only the errors of the fields keep them apart.
            tighter = max(_TIGHTER * schedule.tolerance, _TIGHTEST * tolerance)
            schedule = replace(schedule, tolerance=tighter)
        known = states.known
        found = solve_with_drift(states, exact, schedule, progress, None, solve)
        step = np.array(found.provenance.parameters["drift"]) - drift
        least = float(slipped.energy[-1])
        for _ in range(_MOST_HALVINGS):
            moved = solve_for(drift + step, slipped)
            if float(moved.energy[-1]) <= least + _ROUNDING * abs(least):
                break
            step /= 2
        else:
            break
        drift, slipped = drift + step, moved
        apart = np.abs(slipped.displacement - found.displacement)[of_elements]
        far = float(apart.max(initial=0.0)) / problem.unit
        if far <= _AGREE * tolerance:
            return _result(problem, optimizer, slipped, found, far, begun)
    raise ConvergenceError(
        "no drift was found that agrees with the observations that slip. Give these observations "
        "a confidence of 1, or estimate no drift (`drift=False`)"
    )


def _with_states(
    problem: Problem,
    prior: ElasticPrior,
    slipped: Solution,
    of_elements: npt.NDArray[np.bool_],
) -> Problem:
    """Return the problem in which slipping observations are forces and the others are certain.

    Observations of sites in no element have moved to others, which take their places.
    """
    known = problem.known & of_elements[..., None]
    force = np.where(known, slip_forces(problem, prior, slipped.displacement), 0.0)
    pulls = Loads(force=force * prior.force_unit(problem), spacing=problem.spacing)
    loads = pulls if problem.loads is None else problem.loads + pulls
    known = known & (force == 0)
    return variant_of(problem, known=known, confidence=known.astype(np.float32), loads=loads)


def _result(
    problem: Problem,
    optimizer: Optimizer,
    slipped: Solution,
    found: Solution,
    far: float,
    begun: float,
) -> Solution:
    """Return the field with its drift."""
    convergence = slipped.convergence
    if convergence is not None:
        error = convergence.error + far
        error += 0.0 if found.convergence is None else found.convergence.error
        convergence = replace(convergence, error=error)
    drift = found.provenance.parameters["drift"]
    return replace(
        slipped,
        convergence=convergence,
        provenance=provenance_of(slipped, problem, optimizer, drift, begun),
        notes=(*slipped.notes, *drift_clauses(found)),
    )
