"""Interior-point method for observations that may slip: slower than exchanging states, but robust.

The energy 1/2 d^T A d + sum of p |y - d| is convex. With y - d = a - b, a and b >= 0, and forces f
of observations between -p and p, the minimum satisfies

    A d = f,   a (p - f) = 0,   b (p + f) = 0,

and f is feasible in the dual problem: the sum of a (p - f) + b (p + f) bounds the distance of the
energy from its minimum (the duality gap). Mehrotra's predictor and corrector follow a path on which
these products are equal (Wright, Primal-Dual Interior-Point Methods, 1997). Each step needs the
factors of A + W, where W >= 0 are springs on all observed components, so that no motion is free.
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
# Fraction of the distance to the boundary of the feasible set that a step may take.
_FRACTION = 0.9995
# Largest product at the end, relative to the limit times the scale of displacements.
_GAP = 1e-19
# Least product that a step aims at.
_LEAST_GAP = 1e-22
# Largest product that is accepted if rounding ends the iteration.
_ACCEPTED_GAP = 1e-8
# Largest motion in the last step, relative to the scale of displacements.
_LAST_MOTION = 1e-10
# Number of steps with a closed gap after which any remaining motion is rounding.
_CLOSED_STEPS = 8
# Least scale of displacements, in pixels.
_LEAST_SCALE = 1e-3
# Fraction of a step below which a step that makes the products equal replaces it.
_SHORT = 0.1
# Fraction of their mean at which this step aims.
_CENTRING = 0.5
# Springs that hold tissue in place, as a fraction of the diagonal. The weakest that rounding allows
# are used; they change the steps, but not the result.
_PROXIMAL = tuple(10.0**power for power in range(-16, -10))
# Largest number of corrections of a step.
_CORRECTIONS = 10
# Size of a correction, relative to the step, up to which it is the last.
_LAST_CORRECTION = 1e-9
# Signs of the two sides of an observed position.
_SIDE = np.array([[1.0], [-1.0]])


def solve(model: LinearModel, states: ActiveSet, d: Planes, report: Report) -> None:
    """Move `d` in place to the least energy, and find the corresponding states.

    Raises
    ------
    ConvergenceError
        If the gap cannot be closed.
    """
    steep = model.steepness
    states.place_fixed(d)
    moves = (steep > 0) & ~states.fixed
    at, y, p = states.at, states.y, states.limit
    scale = max(_LEAST_SCALE, float(np.abs(y).max()))
    if states.given is not None:
        scale = max(scale, float(np.abs(d).max()))
    d.ravel()[at] = y
    low, force = np.zeros_like(d), np.zeros(len(at))
    # Distance beyond the observed position on either side, a and b, and distance of the force from
    # either limit.
    past, slack = np.full((2, len(at)), scale), np.stack([p, p])
    far = gap = np.inf
    closed = 0
    for number in range(_MOST_STEPS):
        products = past * slack / (p * scale)
        gap = float(products.max())
        report(Monitor(f"interior point, step {number}, a gap of {gap:.1e}", 0.5))
        closed += gap < _GAP
        if closed and (far <= _LAST_MOTION * scale or closed > _CLOSED_STEPS):
            break
        weight = 1 / (past / slack).sum(axis=0)
        factors = _factors(model, moves, at, weight)
        if factors is None:
            break
        rest = states.with_given(model.pull(d, low)).copy()
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
                # If the products differ widely, steps with second-order corrections may cycle.
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
            "the slipping observations are undetermined: the duality gap is still "
            f"{gap:.1g}. Raise the penalty, or hold more of the tissue"
        )
    slips = past / scale > slack / p
    states.slip_as(np.where(slips[0], 1.0, np.where(slips[1], -1.0, 0.0)))


def _factors(
    model: LinearModel, moves: HeldPlanes, at: npt.NDArray[np.intp], weight: Vector
) -> Factors | None:
    """Return the factors of the model with springs on observations; None if it is singular."""
    for proximal in _PROXIMAL:
        springs = proximal * model.steepness
        springs.ravel()[at] += weight
        try:
            return Factors(model.material, moves, lambda part: None, springs)
        except Singular:
            continue
    return None


def _room(values: Vector, steps: Vector) -> float:
    """Return the factor of a step at which the first value vanishes."""
    ends = np.divide(-values, steps, out=np.full_like(values, np.inf), where=steps < 0)
    return float(ends.min(initial=np.inf))
