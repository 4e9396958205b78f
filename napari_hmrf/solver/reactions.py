"""Reaction forces at sites with observed displacement."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.arguments import require_kind
from napari_hmrf.errors import ArgumentError
from napari_hmrf.real_arrays import grid_in_words
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.rigid.bodies import Bodies, bodies_of
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.data_term import DataTerm
from napari_hmrf.solver.drift import has_drift, with_drift_of
from napari_hmrf.solver.priors import NeoHookeanPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.slip_forces import slip_forces
from napari_hmrf.solver.solution import Solution

#: Relative difference up to which spacings count as equal.
_SAME_SPACING = 1e-6


def reactions(problem: Problem, solution: Solution) -> npt.NDArray[np.float64]:
    """Return the force that each observation exerts on the tissue.

    Observations are prescribed displacements, those with a precision, such as a wall along which
    tissue slides, and uncertain landmarks. The reactions and the forces of the problem's loads add
    up to zero. The sum over a mark is the force that constrains or pulls this mark:
    ``reactions(problem, solution)[mark].sum(axis=0)``.
    The accuracy of the reactions depends on the accuracy of the field: for accurate reactions,
    solve to a smaller tolerance than for displacements.

    Parameters
    ----------
    problem : Problem
    solution : Solution
        Solution of this problem, which contains the prior of the solve.

    Returns
    -------
    ndarray, shape (H, W, 2) or (D, H, W, 3)
        Reaction forces, with components in the order of the axes; 0 at sites without observation.
        A landmark acts on the corners of its element.
        In an image, forces per thickness, in the unit of stiffness times length; in a volume,
        forces, in the unit of stiffness times length squared. The force on a rigid body that is
        not due to slipping observations is distributed over its other observed sites.

    Raises
    ------
    ArgumentError
        If an argument has the wrong type, the solution belongs to another problem, or its prior is
        not elastic.
    ProblemError
        If parts of the tissue slide along each other.
    """
    require_kind(Problem, "problem", problem, "Problem(observed, confidence, stiffness)")
    require_kind(Solution, "solution", solution, "the result of solve()")
    if solution.elasticity is None:
        raise ArgumentError(
            "solution has no forces, because its prior is not elastic. Solve with ElasticPrior() "
            "or NeoHookeanPrior()"
        )
    prior = solution.elasticity.prior
    if not np.allclose(problem.spacing, solution.spacing, rtol=_SAME_SPACING, atol=0):
        raise ArgumentError(
            f"the problem has pixels of {grid_in_words(problem.spacing)}, but the solution has "
            f"pixels of {grid_in_words(solution.spacing)}. Pass the problem that was solved"
        )
    inputs = solution.provenance.inputs
    if inputs is not problem.digests and dict(inputs) != dict(problem.digests):
        raise ArgumentError(
            "the solution was computed from another problem. Pass the problem that was solved"
        )
    if has_drift(problem, prior):
        problem = with_drift_of(problem, solution)
    joined = connected(problem, prior)
    problem = joined.problem
    forces, acts = prior.forces(problem, solution.displacement), _observed(problem)
    if problem.has_rigid:
        planes, held = host.planes(forces), host.planes(acts).astype(np.bool_)
        moved = None
        if isinstance(prior, NeoHookeanPrior):
            moved = host.planes(solution.displacement / np.float64(problem.unit))
        # An observation that slips exerts its largest force; the others bear the rest.
        pulls = host.planes(slip_forces(problem, prior, solution.displacement))
        held &= pulls == 0
        bodies = Bodies(bodies_of(problem.stiffness), prior.material(problem), held, moved)
        on_bodies = bodies.hold(np.zeros_like(held))
        pulls[~on_bodies] = 0
        planes -= pulls
        bodies.carry(planes)
        forces = host.field(planes + pulls)
    return joined.returned(np.where(acts, forces * prior.force_unit(problem), 0.0))


def _observed(problem: Problem) -> npt.NDArray[np.bool_]:
    """Return the components on which an observation acts, shape (H, W, 2) or (D, H, W, 3)."""
    data = DataTerm.of(problem, 1.0)
    if data is None:
        return problem.known
    acts = data.weights[: data.axes] > 0
    if data.points is not None:
        corners, precision = data.points.lumped()
        acts.reshape(data.axes, -1)[:, corners] |= precision > 0
    observed: npt.NDArray[np.bool_] = problem.known | host.field(acts)
    return observed
