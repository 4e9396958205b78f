"""Observations that slip, by an interior point: slower than exchanging states, and always there.

The energy 1/2 d^T A d + sum of p |y - d| is convex. With y - d = a - b, a and b >= 0, and forces f
of observations between -p and p, its least has

    A d = f,   a (p - f) = 0,   b (p + f) = 0,

and f is a point of the dual problem: sum of a (p - f) + b (p + f) bounds how far the energy is
from its least (the duality gap). Mehrotra's predictor and corrector go there along a path on which
these products are equal (Wright, Primal-Dual Interior-Point Methods, 1997). Each step takes the
factors of A + W, where W >= 0 are springs on all that is observed, so that nothing is ever free.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from napari_hmrf.backends.dissection import Singular
from napari_hmrf.backends.factors import Factors
from napari_hmrf.backends.linear import LinearModel, Planes
from napari_hmrf.errors import ConvergenceError
from napari_hmrf.optimizers.active import ActiveSet
from napari_hmrf.optimizers.base import Monitor, Report

Vector = npt.NDArray[np.float64]

_MOST_STEPS = 80
# How far a step goes towards where something would vanish.
_FRACTION = 0.995
# At the end: the gap, over all that could be; what the last step moves, in units of what is
# observed; and the gap where rounding ends the way, at most.
_GAP, _STILL, _CLOSE = 1e-13, 1e-9, 1e-9
_LEAST_SCALE = 1e-3
# What is closer to its mark than this is held there.
_AWAY = 1e-6
# Springs to where tissue is, as a part of the diagonal: they change steps, not where these lead.
_PROXIMAL = 1e-13
# Steps after which what still moves is rounding.
_ROUNDED = 3
_TINY = 1e-16


def solve(model: LinearModel, states: ActiveSet, d: Planes, report: Report) -> float:
    """Move `d` in place to the least energy, and find the states that go with it.

    Returns how far the last step moved anything, in pixels.

    Raises
    ------
    ConvergenceError
        If the gap cannot be closed.
    """
    steep = model.steepness
    moves = steep > 0
    at, y, p = states.at, states.y, states.limit
    scale = max(_LEAST_SCALE, float(np.abs(y).max()))
    d.ravel()[at] = y
    force, whole = np.zeros(len(at)), float(p.sum()) * scale
    a, b = np.full((2, len(at)), 0.1 * scale)
    far, closed = np.inf, 0
    for number in range(_MOST_STEPS):
        up, down = np.maximum(p - force, _TINY * p), np.maximum(p + force, _TINY * p)
        gap = float((a * up + b * down).sum())
        report(
            Monitor(f"interior point, step {number}, a gap of {gap / whole:.1e}, {far:.1e}", 0.5)
        )
        off = y - d.ravel()[at] - (a - b)
        closed += gap <= _GAP * whole and float(np.abs(off).max()) <= _STILL * scale
        if closed and (far <= _STILL * scale or closed > _ROUNDED):
            break
        rest = model.pull(d).copy()
        rest.ravel()[at] += force
        rest[~moves] = 0
        weight = 1 / (a / up + b / down)
        springs = _PROXIMAL * steep
        springs.ravel()[at] += weight
        try:
            factors = Factors(model.material, moves, lambda part: None, springs)
        except Singular:
            break
        mean, aim = gap / (2 * len(at)), 0.0
        bent_a, bent_b = np.zeros((2, len(at)))
        for predicted in (True, False):
            rest_a = (aim * mean + bent_a) / up - a
            rest_b = (aim * mean - bent_b) / down - b
            target = off - rest_a + rest_b
            load = rest.copy()
            load.ravel()[at] += weight * target
            way = factors.solve(load)
            left = load + model.pull(way)
            left.ravel()[at] -= weight * way.ravel()[at]
            left[~moves] = 0
            way += factors.solve(left)
            stronger = weight * (target - way.ravel()[at])
            more_a, more_b = rest_a + a / up * stronger, rest_b - b / down * stronger
            pairs = (a, more_a), (b, more_b), (up, -stronger), (down, stronger)
            part = min(1.0, _FRACTION * min(_room(*pair) for pair in pairs))
            if predicted:
                then = (a + part * more_a) * (up - part * stronger)
                then += (b + part * more_b) * (down + part * stronger)
                aim = (max(float(then.sum()), 0.0) / gap) ** 3
                bent_a, bent_b = more_a * stronger, more_b * stronger
        np.add(d, part * way, out=d)
        force += part * stronger
        a = np.maximum(a + part * more_a, _TINY * scale)
        b = np.maximum(b + part * more_b, _TINY * scale)
        far = float(np.abs(part * way).max())
    if not (gap <= _CLOSE * whole and math.isfinite(far)):
        raise ConvergenceError(
            "which observations slip stays open: the energy is known to a part of "
            f"{gap / whole:.1g} only. Raise the penalty, or hold more of the tissue"
        )
    states.slip_as(np.where(a > _AWAY * scale, 1.0, np.where(b > _AWAY * scale, -1.0, 0.0)))
    return far


def _room(values: Vector, steps: Vector) -> float:
    """How often a step can be taken until a value vanishes."""
    ends = np.divide(-values, steps, out=np.full_like(values, np.inf), where=steps < 0)
    return float(ends.min(initial=np.inf))
