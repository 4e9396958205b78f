"""Interior-point method for observations that may slip: slow, but robust.

The energy ``1/2 d^T A d + sum(p |y - d|)`` is convex. Let ``y - d = a - b`` with a >= 0 and b >= 0,
and let f be the forces of the observations, between -p and p. The minimum satisfies

    A d = f,   a (p - f) = 0,   b (p + f) = 0.

Because f is feasible for the dual problem, the duality gap ``sum(a (p - f) + b (p + f))`` is an
upper bound on the difference between the energy and its minimum. Mehrotra's predictor-corrector
method follows the central path, on which all these products are equal (Wright, Primal-Dual
Interior-Point Methods, 1997). Each step factorizes A + W, where the springs W >= 0 on all observed
components prevent free motions.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ConvergenceError
from napari_hmrf.solver.backends.direct.dissection import Singular
from napari_hmrf.solver.backends.direct.factors import Factors
from napari_hmrf.solver.backends.linear import HeldPlanes, LinearModel, Planes
from napari_hmrf.solver.optimizers.base import Monitor, Report
from napari_hmrf.solver.optimizers.refinement import add
from napari_hmrf.solver.optimizers.slip_states import ActiveSet

Vector = npt.NDArray[np.float64]

# Largest number of steps.
_MOST_STEPS = 100
# Largest length of a step, as a fraction of the distance to the boundary of the feasible set.
_FRACTION = 0.9995
# Largest product at which the iteration ends, relative to the limit times the displacement scale.
_GAP = 1e-19
# Smallest target value for the products of a step.
_LEAST_GAP = 1e-22
# Largest product that is accepted if rounding errors end the iteration.
_ACCEPTED_GAP = 1e-8
# Largest motion in a step at which the iteration ends, relative to the scale of displacements.
_LAST_MOTION = 1e-10
# Number of steps with products below `_GAP` after which any remaining motion is rounding error.
_CLOSED_STEPS = 8
# Smallest scale of displacements, in pixels.
_LEAST_SCALE = 1e-3
# Length of a step, as a fraction, below which a centring step is used instead.
_SHORT = 0.1
# Target of a centring step for all products, as a fraction of their mean.
_CENTRING = 0.5
# Stiffness of springs on all components, as a fraction of the diagonal. The weakest springs with
# which the factorization succeeds are used. These springs affect the steps but not the result.
_PROXIMAL = tuple(10.0**power for power in range(-16, -10))
# Largest number of refinements of a step.
_CORRECTIONS = 10
# Size of a refinement, relative to the step, below which the refinement of a step ends.
_LAST_CORRECTION = 1e-9
# Signs for a and b, the two sides of an observed position.
_SIDE = np.array([[1.0], [-1.0]])


def solve(model: LinearModel, states: ActiveSet, d: Planes, report: Report) -> None:
    """Minimize the energy over `d` in place, and set the states accordingly.

    Raises
    ------
    ConvergenceError
        If the duality gap cannot be closed.
    """
    steep = model.steepness
    states.place_fixed(d)
    moves = (steep > 0) & ~states.fixed
    at, y, p = states.at, states.y, states.limit
    scale = max(_LEAST_SCALE, float(np.abs(y).max()))
    d.ravel()[at] = y
    low, force = np.zeros_like(d), np.zeros(len(at))
    # `past`: distance from the observed position on each side, a and b. `slack`: distance of the
    # force from each limit.
    past, slack = np.full((2, len(at)), scale), np.stack([p, p])
    far = gap = np.inf
    closed = 0
    for number in range(_MOST_STEPS):
        products = past * slack / (p * scale)
        gap = float(products.max())
        report(Monitor(f"interior-point step {number}, gap {gap:.1e}", 0.5))
        closed += gap < _GAP
        if closed and (far <= _LAST_MOTION * scale or closed > _CLOSED_STEPS):
            break
        weight = 1 / (past / slack).sum(axis=0)
        factors = _factors(model, moves, at, weight)
        if factors is None:
            break
        rest = model.pull(d, low).copy()
        rest.ravel()[at] += force
        rest[~moves] = 0
        apart = y - d.ravel()[at] - low.ravel()[at] - (past[0] - past[1])
        aim = np.zeros_like(past)
        for stage in ("predict", "correct", "centre"):
            target = apart - (_SIDE * (aim / slack - past)).sum(axis=0)
            load = rest.copy()
            load.ravel()[at] += weight * target
            way = factors.solve(load)
            for _ in range(_CORRECTIONS):
                left = load + model.pull(way)
                left.ravel()[at] -= weight * way.ravel()[at]
                left[~moves] = 0
                more = factors.solve(left)
                way += more
                if np.abs(more).max() <= _LAST_CORRECTION * np.abs(way).max():
                    break
            stronger = weight * (target - way.ravel()[at])
            narrower = -_SIDE * stronger
            wider = (aim - past * slack - past * narrower) / slack
            most = 1.0 if stage == "predict" else _FRACTION
            part = min(1.0, most * _room(past, wider), most * _room(slack, narrower))
            if stage == "predict":
                then = (past + part * wider) * (slack + part * narrower) / (p * scale)
                share = (max(float(then.mean()), 0.0) / float(products.mean())) ** 3
                mean = max(float(products.mean()) * share, _LEAST_GAP)
                aim = p * scale * mean - narrower * wider
            elif part > _SHORT:
                break
            else:
                # Second-order corrections may cycle if the products differ widely.
                mean = max(_CENTRING * float(products.mean()), _LEAST_GAP)
                aim = p * scale * mean
        if not np.isfinite(way).all():
            break
        add(d, low, part * way)
        force += part * stronger
        past, slack = past + part * wider, slack + part * narrower
        far = float(np.abs(part * way).max())
    if not gap <= _ACCEPTED_GAP:
        raise ConvergenceError(
            "no consistent slipping observations were found: the duality gap is still "
            f"{gap:.1g}. Raise the penalty, or hold more of the tissue"
        )
    slips = past / scale > slack / p
    states.slip_as(np.where(slips[0], 1.0, np.where(slips[1], -1.0, 0.0)))


def _factors(
    model: LinearModel, moves: HeldPlanes, at: npt.NDArray[np.intp], weight: Vector
) -> Factors | None:
    """Factorize the model with springs on observations; return None if it is singular."""
    for proximal in _PROXIMAL:
        springs = proximal * model.steepness
        springs.ravel()[at] += weight
        try:
            return Factors(model.material, moves, lambda part: None, springs)
        except Singular:
            continue
    return None


def _room(values: Vector, steps: Vector) -> float:
    """Return the largest multiple of a step that keeps all values non-negative."""
    ends = np.divide(-values, steps, out=np.full_like(values, np.inf), where=steps < 0)
    return float(ends.min(initial=np.inf))
