"""Loads: forces, work, and checks that the constraints can bear the loads."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.backends import host
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes
from napari_hmrf.solver.backends.planes import inside
from napari_hmrf.solver.data_term import DataTerm
from napari_hmrf.solver.loads import are_same
from napari_hmrf.solver.priors import ElasticPrior, NeoHookeanPrior, Prior, SeilerPrior
from napari_hmrf.solver.problem import MAX_REACH, Problem
from napari_hmrf.solver.rigid_modes import free_motions

# Fraction of the sum of all forces up to which a force is rounding error.
_ROUNDING = 1e-9
# Fraction by which loads may exceed the limits of observations, because the linear program has
# limited accuracy.
_AT_LIMIT = 1e-6


class LoadForces(NamedTuple):
    """Forces of loads (planes, or None), and energy of growth at zero displacement."""

    pulls: Planes | None
    energy: float


class _LastLoads(NamedTuple):
    """Forces of the last problem with loads, cached for the next problem."""

    problem: Problem
    prior: ElasticPrior | NeoHookeanPrior
    forces: LoadForces

    def are_valid_for(self, problem: Problem, prior: ElasticPrior | NeoHookeanPrior) -> bool:
        """Return whether tissue and loads are the same; observations may differ."""
        own = self.problem
        return (
            prior == self.prior
            and own.spacing == problem.spacing
            and are_same(own.loads, problem.loads)
            and are_equal(own.stiffness, problem.stiffness)
        )


# Loads of the last image, which do not change while the user drags tissue.
_loads: Kept[_LastLoads] = Kept()


def load_forces(problem: Problem, prior: Prior) -> LoadForces:
    """Return the forces and the energy of a problem's loads; read-only.

    Parameters
    ----------
    problem : Problem
    prior : Prior
    """
    if isinstance(prior, SeilerPrior) or problem.loads is None:
        return LoadForces(None, 0.0)
    last = _loads.valid(lambda last: last.are_valid_for(problem, prior))
    if last is not None:
        return last.forces
    load = prior.load(problem)
    if load is None:
        return LoadForces(None, 0.0)
    loads = LoadForces(host.planes(load.forces), load.energy)
    _loads.value = None if problem.is_volume else _LastLoads(problem, prior, loads)
    return loads


def with_data(
    data: DataTerm | None, problem: Problem, pulls: Planes | None, energy: float
) -> LoadForces:
    """Add the forces and the energy of the data term at zero displacement to those of the loads.

    Parameters
    ----------
    data : DataTerm or None
    problem : Problem
    pulls : ndarray, planes, or None
        Forces of the loads; not changed.
    energy : float
        Energy of the loads.
    """
    if data is None:
        return LoadForces(pulls, energy)
    forces, own = data.load(problem.observed, problem.unit)
    return LoadForces(forces if pulls is None else forces + pulls, energy + own)


def check_reach(d: Planes, problem: Problem) -> None:
    """Raise an error if loads or data move tissue far beyond the image.

    Loads usually do so in a wrong unit, and data if they hardly hold some of the tissue.

    Parameters
    ----------
    d : ndarray, planes
        Displacement, in pixels.
    problem : Problem

    Raises
    ------
    ProblemError
        If any component exceeds `MAX_REACH` times the diagonal of the image.
    """
    sides = np.array(problem.spacing) / problem.unit
    diagonal = float(np.linalg.norm(sides * problem.shape))
    if problem.coupling is not None:  # copies of sites are no tissue
        d = inside(d)[:, problem.coupling.own]
    farthest = max(float(d.max()), -float(d.min()))
    if farthest <= MAX_REACH * diagonal:
        return
    move = f"move tissue by {farthest / diagonal:.2g} times the diagonal of the image. "
    if problem.loads is None:
        raise ProblemError(
            "precision" if problem.landmarks is None else "landmarks",
            move + "Observe or hold more of the tissue, or give its observations smaller standard "
            "deviations.",
        )
    raise ProblemError(
        "loads",
        move + "Use forces and stiffness in consistent units, such as stiffness in kPa, and forces "
        "in kPa times the unit of length of the spacing; or hold more of the tissue.",
    )


def check_balanced(
    problem: Problem,
    observed: HeldPlanes,
    limit: Planes,
    load: Planes | None,
) -> None:
    """Raise an error if loads exceed the limits of the observations that may slip.

    Parameters
    ----------
    problem : Problem
    observed : ndarray of bool, planes
        Observed components.
    limit : ndarray, planes
        Largest force of each observation; infinite for a component that never slips.
    load : ndarray, planes, or None
        Force on each component, or None if there is no load.

    Raises
    ------
    ProblemError
        If the loads would move some tissue without limit.
    """
    if load is None or problem.loads is None or problem.loads.force is None:
        return  # growth has no resultant force
    total, fixed = np.abs(load).sum(), observed & np.isinf(limit)
    at = np.flatnonzero(observed & ~fixed)
    largest = limit.ravel()[at]
    for ways in free_motions(problem, host.field(fixed)):
        motions = [host.planes(way) for way in ways]
        demand = np.array([host.work_of(load, motion) for motion in motions])
        if np.abs(demand).max() <= _ROUNDING * total:
            continue
        stops = np.stack([motion.ravel()[at] for motion in motions])
        stopping = stops.any(axis=0)
        if not _can_hold(stops[:, stopping] * largest[stopping], demand):
            raise ProblemError(
                "loads",
                "exceed the forces of the observations: the largest force of an observation "
                "is the penalty times its confidence, and tissue would slip without limit. Raise "
                "the penalty, hold more of the tissue, or reduce the loads.",
            )


def _can_hold(stops: npt.NDArray[np.float64], demand: npt.NDArray[np.float64]) -> bool:
    """Return whether forces within the limits can balance the loads in all free motions.

    Parameters
    ----------
    stops : ndarray, shape (motions, components)
        Work done by the largest force of each component over each free motion.
    demand : ndarray, shape (motions,)
        Work done by the loads over each free motion.
    """
    size = np.abs(stops).sum(axis=1)
    if (np.abs(demand) > size).any():
        return False
    # Usually the least-squares solution is within the limits.
    square = np.einsum("an,bn->ab", stops, stops)
    shares = np.linalg.lstsq(square, demand)[0]
    residual = np.abs(square @ shares - demand).max()
    if residual <= _ROUNDING * np.abs(demand).max() and np.abs(shares @ stops).max() <= 1:
        return True
    # Otherwise, find the largest multiple of the loads that the observations can balance.
    matrix = np.column_stack([stops / size[:, None], -demand / size])
    cost = np.zeros(matrix.shape[1])
    cost[-1] = -1.0
    limits = [*[(-1.0, 1.0)] * stops.shape[1], (0.0, 2.0)]
    program = scipy.optimize.linprog(cost, A_eq=matrix, b_eq=np.zeros(len(demand)), bounds=limits)
    multiple = float(program.x[-1]) if program.success else math.nan
    return multiple >= 1 - _AT_LIMIT
