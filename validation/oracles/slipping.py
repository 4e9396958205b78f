"""Observations that may slip, beside all other inputs: exact fields from dense matrices.

`parts` assembles the energy 1/2 v^T H v - h^T v of the free components, rigid motions and strains
of a drift v, where d = P v + b. A dense interior-point method minimizes

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
from validation.oracles.parts import Parts, assembled, prescribed

Array = npt.NDArray[np.float64]

# Number of steps, and products at which the method ends, relative to the limit and the distances.
_STEPS, _GAP = 80, 1e-20
# Distances of held observations, and unbalanced forces relative to the largest, that are accepted.
_SLACK, _UNBALANCED = 1e-8, 1e-7
# Product from which states are tried, relative to the limit and the distances.
_PROMISING = 1e-5
# Share of a unit motion in an observation that is rounding error.
_ABSENT = 1e-12
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
    least_strain : float
        Least principal strain of the drift; 0 without a drift.
    strain_sd : float
        Standard deviation of the least certain strain of the drift, if no observation slips.
    energy : callable
        Function that returns the energy of a displacement in pixels.
    """

    field: Array
    is_proven: bool
    motions: int
    is_free: bool
    least_strain: float
    strain_sd: float
    energy: Callable[[Array], float]


def slipped(
    problem: Problem,
    prior: ElasticPrior,
    force: Array | None = None,
    tilt: float = 0.0,
    number: int = 0,
) -> Slipped:
    """Return the field of least energy of a small problem, in pixels.

    The parameters `force`, `tilt` and `number` are those of `parts.assembled`.
    """
    unit, scale = problem.unit, prior.force_unit(problem)
    parts = assembled(problem, prior, force, tilt, number)
    image = parts.own.T @ parts.basis.toarray()
    # Unit columns, so that rigid motions, strains and single components have the same scale.
    fields = parts.basis.toarray()
    sizes = np.linalg.norm(fields, axis=0) + (fields == 0).all(axis=0)
    image /= sizes
    hessian = parts.matrix.toarray() * (unit / scale) / sizes / sizes[:, None]
    load = parts.right / (scale * sizes)
    start = parts.own.T @ parts.start / unit
    slips = problem.known & ~prescribed(problem, prior)
    limits = prior.limit(problem)
    at = np.flatnonzero(slips.ravel() & (parts.own.T @ np.ones(parts.own.shape[0]) > 0))
    limit = np.zeros(0) if limits is None else limits.ravel()[at]
    y = problem.observed.ravel().astype(np.float64) / unit
    off = y[at] - start[at]
    rows = np.where(np.abs(image[at]) < _ABSENT, 0.0, image[at])

    def energy(field: Array) -> float:
        """Return the least energy of all fields of the parts that move the image in this way."""
        v = np.linalg.lstsq(image, field.ravel() - start)[0]
        free = scipy.linalg.null_space(image, rcond=_RANK)
        bend = free.T @ hessian @ free
        v = v + free @ np.linalg.lstsq(bend, free.T @ (load - hessian @ v))[0]
        return float(v @ (hessian @ v) / 2 - load @ v + (limit * np.abs(off - rows @ v)).sum())

    system = _System(hessian, load, rows, off, limit)
    best = None
    for states in system.states():
        found = system.solved(states)
        best = found if best is None or found.is_proven else best
        if found.is_proven:
            break
    free = system.motions(rows)
    v = np.zeros(len(load)) if best is None else best.v
    field = (start + image @ v).reshape(problem.observed.shape)
    is_proven, motions = (False, free) if best is None else (best.is_proven, best.motions)
    least_strain, strain_sd = 0.0, 0.0
    if problem.landmarks is not None and problem.landmarks.drift:
        upper = np.triu_indices(len(problem.shape))
        strain = np.zeros((len(problem.shape),) * 2)
        strain[upper] = strain.T[upper] = (v * unit / sizes)[-len(upper[0]) :]
        least_strain = float(np.linalg.eigvalsh(strain)[0])
        strain_sd = _strain_sd(parts, len(upper[0]))
    return Slipped(field, is_proven, motions, free > 0, least_strain, strain_sd, energy)


def _strain_sd(parts: Parts, count: int) -> float:
    """Return the standard deviation of the least certain of `count` strains of a drift."""
    problem = parts.problem
    assert problem.landmarks is not None
    energy = problem.landmarks.scale.energy(problem.stiffness, problem.spacing)
    whole = parts.matrix.toarray()
    beside, own = whole[:-count, -count:], whole[-count:, -count:]
    least = np.linalg.eigvalsh(own - beside.T @ np.linalg.lstsq(whole[:-count, :-count], beside)[0])
    return float(np.sqrt(energy / least[0])) if least[0] > 0 else np.inf


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
        ridge = 1e-13 * np.abs(hessian).max(initial=0.0) * np.eye(len(load))
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
