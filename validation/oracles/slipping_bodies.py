"""Rigid bodies and drifts beside observations that may slip: exact fields from dense matrices.

The displacement is d = P v + b, where v contains the rigid motions of the bodies and the components
of all other sites, and b is the displacement prescribed exactly. `elasticity` adds the matrix A and
P, and `posterior` the matrix of the data. The strains of a drift are further unknowns. With H = P^T
A P, a dense interior-point method minimizes

    1/2 v^T H v - h^T v + sum(p |y - b - P v|)

which decides the states. The field is then computed for these states, and the conditions of the
minimum are checked: no slipping observation pulls away from its observed position, and forces
within the limits balance the tissue. The energy is convex, so these conditions prove the field.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.optimize

from napari_hmrf import ElasticPrior, Problem
from validation.oracles.elasticity import (
    block_matrix,
    bodies_of,
    growth_load,
    lame_parameters,
    rigid_coordinates,
    rigid_sites,
)
from validation.oracles.posterior import affine_motions, with_data

Array = npt.NDArray[np.float64]

# Number of steps, and products at which the method ends, relative to the limit and the distances.
_STEPS, _GAP = 80, 1e-20
# Distances of held observations, and unbalanced forces relative to the largest, that are accepted.
_SLACK, _UNBALANCED = 1e-8, 1e-7
# Product from which states are tried, relative to the limit and the distances.
_PROMISING = 1e-5
# Singular value of the rows of held observations, relative to the largest, that is rounding error.
_RANK = 1e-10
# Energy below which a motion is free, relative to the largest eigenvalue.
_FREE = 1e-11
# Relative difference between a force and its limit below which an observation may slip.
_TIE = 1e-6


class Slipped(NamedTuple):
    """Field of observations that may slip.

    Attributes
    ----------
    field : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement, in pixels.
    is_proven : bool
        True if the conditions of the minimum hold.
    motions : int
        Number of motions by which other fields of the same energy differ.
    is_free : bool
        True if there is a motion without energy that no observation prevents.
    energy : callable
        Function that returns the energy of a displacement in pixels.
    """

    field: Array
    is_proven: bool
    motions: int
    is_free: bool
    energy: Callable[[Array], float]


def slipped(problem: Problem, prior: ElasticPrior) -> Slipped:
    """Return the field of least energy of a small problem, in pixels."""
    unit = problem.unit
    force_unit = prior.force_unit(problem)
    matrix = block_matrix(problem, prior).tocsr()
    grown = growth_load(problem, prior, *lame_parameters(problem, prior))
    data, pulled = with_data(problem, 0 * matrix, np.zeros(len(grown)))
    if problem.loads is not None and problem.loads.force is not None:
        pulled = pulled + problem.loads.force.astype(np.float64).ravel()
    matrix, data = matrix * (unit / force_unit), data * (unit / force_unit)
    grown, pulled = grown / force_unit, pulled / force_unit
    limits = prior.limit(problem)
    limits = np.full(problem.observed.shape, np.inf) if limits is None else limits
    limits = limits.ravel()
    known, y = problem.known.ravel(), problem.observed.ravel().astype(np.float64) / unit
    fixed = known & np.isinf(limits)
    bodies, moves = bodies_of(problem, rigid_sites(problem.stiffness)), matrix.diagonal() > 0
    basis, start = rigid_coordinates(bodies, moves, fixed, np.where(fixed, y, 0.0))
    at = np.flatnonzero(known & ~fixed)
    limit, dense = limits[at], basis.toarray()
    # Unit columns, so that rigid motions and single components have the same scale.
    dense /= np.linalg.norm(dense, axis=0)
    affine = np.zeros((dense.shape[0], 0))
    if problem.landmarks is not None and problem.landmarks.drift:
        affine = affine_motions(problem) / unit
    count = affine.shape[1]
    strained = np.hstack([dense, -affine])
    dense = np.hstack([dense, 0 * affine])
    rows = np.where(np.abs(dense[at]) < 1e-12, 0.0, dense[at])
    hessian = strained.T @ (matrix @ strained) + dense.T @ (data @ dense)
    load = strained.T @ (grown - matrix @ start) + dense.T @ (pulled - data @ start)
    off = y[at] - start[at]

    def energy(field: Array) -> float:
        d = field.ravel()
        bend, pull = affine.T @ (matrix @ affine), affine.T @ (matrix @ d - grown)
        strain = d - affine @ np.linalg.lstsq(bend, pull)[0] if count else d
        own = strain @ (matrix @ strain) / 2 - grown @ strain
        own += d @ (data @ d) / 2 - pulled @ d
        return float(own + (limit * np.abs(y[at] - d[at])).sum())

    system = _System(hessian, load, rows, off, limit)
    best = None
    for slips in system.states():
        found = system.solved(slips)
        best = found if best is None or found.is_proven else best
        if found.is_proven:
            break
    free = system.motions(rows)
    if best is None:
        return Slipped(start.reshape(problem.observed.shape), False, free, free > 0, energy)
    field = (start + dense @ best.v).reshape(problem.observed.shape)
    return Slipped(field, best.is_proven, best.motions, free > 0, energy)


class _Solved(NamedTuple):
    """Minimum for given states, whether they are proven, and the number of free motions."""

    v: Array
    is_proven: bool
    motions: int


class _System(NamedTuple):
    """Energy ``1/2 v^T H v - h^T v + sum(p |off - R v|)``."""

    hessian: Array
    load: Array
    rows: Array
    off: Array
    limit: Array

    def solved(self, slips: Array) -> _Solved:
        """Return the minimum for given signs of forces, 0 for held observations."""
        hessian, load, rows, off, limit = self
        size = max(float(np.abs(hessian).max(initial=0.0)), 1e-300)
        scale = float(limit.max(initial=0.0) + np.abs(load).max(initial=0.0))
        held = slips == 0
        v, ways = np.zeros(len(load)), np.eye(len(load))
        if held.any():
            v = np.linalg.lstsq(rows[held], off[held], rcond=_RANK)[0]
            ways = scipy.linalg.null_space(rows[held], rcond=_RANK)
        pull = load + rows.T @ (slips * limit)
        values, modes = np.linalg.eigh(ways.T @ hessian @ ways)
        rest = modes.T @ (ways.T @ (pull - hessian @ v))
        stiff = values > _FREE * size
        v = v + ways @ (modes @ np.where(stiff, rest / np.where(stiff, values, 1.0), 0.0))
        left, needed = off - rows @ v, hessian @ v - pull
        near = _SLACK * max(1.0, float(np.abs(off).max(initial=0.0)))
        is_proven = bool((np.abs(rest[~stiff]) <= _UNBALANCED * scale).all())
        is_proven &= bool((np.abs(left[held]) <= near).all() and (slips * left >= -near).all())
        sure = np.zeros((0, len(load)))
        if held.any():
            # Forces within the limits that balance the tissue.
            limits = -limit[held], limit[held]
            force = scipy.optimize.lsq_linear(rows[held].T, needed, limits, "bvls", tol=1e-14).x
            is_proven &= bool(np.abs(rows[held].T @ force - needed).max() <= _UNBALANCED * scale)
            sure = rows[held][np.abs(force) < (1 - _TIE) * limit[held]]
        return _Solved(v, is_proven, self.motions(sure))

    def motions(self, rows: Array) -> int:
        """Return the number of motions without energy that do not move given observations."""
        size = max(float(np.abs(self.hessian).max(initial=0.0)), 1e-300)
        rows = rows[np.abs(rows).max(axis=1, initial=0.0) > 0]
        free = scipy.linalg.null_space(rows, rcond=_RANK) if len(rows) else np.eye(len(self.load))
        return int((np.linalg.eigvalsh(free.T @ self.hessian @ free) <= _FREE * size).sum())

    def states(self) -> Iterator[Array]:
        """Yield signs of forces, 0 for held observations, from ever smaller products."""
        hessian, load, rows, off, limit = self
        if not len(off):
            yield off
            return
        scale = max(1e-3, float(np.abs(off).max()))
        v, force = np.zeros_like(load), np.zeros_like(off)
        side = np.array([[1.0], [-1.0]])
        past, slack = np.full((2, len(off)), scale), np.stack([limit, limit])
        ridge = 1e-13 * np.abs(hessian).max() * np.eye(len(load))
        for _ in range(_STEPS):
            gap = past * slack / (limit * scale)
            slip = past / scale > slack / limit
            if gap.max() < _PROMISING:
                yield np.where(slip[0], 1.0, np.where(slip[1], -1.0, 0.0))
            weight = 1 / (past / slack).sum(axis=0)
            whole = hessian + ridge + (rows.T * weight) @ rows
            size = np.sqrt(np.diagonal(whole))
            rest = load - hessian @ v + rows.T @ force
            if gap.max() < _GAP or not (np.isfinite(whole).all() and np.isfinite(rest).all()):
                return
            whole /= np.outer(size, size)
            apart = off - rows @ v - (past[0] - past[1])
            aim = np.zeros_like(past)
            for is_last in (False, True):
                target = apart - (side * (aim / slack - past)).sum(axis=0)
                right = (rest + rows.T @ (weight * target)) / size
                try:
                    way = np.linalg.solve(whole, right) / size
                except np.linalg.LinAlgError:
                    return
                more = weight * (target - rows @ way)
                narrower = -side * more
                wider = (aim - past * slack - past * narrower) / slack
                room = min(
                    float(np.divide(-x, dx, out=np.full_like(x, np.inf), where=dx < 0).min())
                    for x, dx in ((past, wider), (slack, narrower))
                )
                part = min(1.0, (0.999 if is_last else 1.0) * room)
                if not is_last:
                    then = (past + part * wider) * (slack + part * narrower) / (limit * scale)
                    share = (max(float(then.mean()), 0.0) / float(gap.mean())) ** 3
                    aim = limit * scale * max(float(gap.mean()) * share, 1e-24) - narrower * wider
            v, force = v + part * way, force + part * more
            past, slack = past + part * wider, slack + part * narrower
