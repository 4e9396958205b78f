"""How far a displacement may be scaled up before tissue is squeezed to little, or folds."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.floating[Any]]
Float64Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

# A scale is found to this part of itself.
_NEAR = 1e-4
# What the smallest determinant keeps above the least one: more than rounding takes.
_MARGIN = 1e-5


def largest_scale(
    displacement: FloatArray, spacing: Sequence[float], tissue: BoolArray, least: float
) -> float:
    """Find the largest part of a displacement, at most all of it, that squeezes no tissue too much.

    The measure is that of `smallest_determinant`: each corner of one-sided differences around a
    site. On the way to that part, from none of it on, no corner is squeezed more either.

    Parameters
    ----------
    displacement : ndarray, shape ([D,] H, W, n)
        In the unit of `spacing`.
    spacing : sequence of float, shape (n,)
    tissue : ndarray of bool, shape ([D,] H, W)
    least : float
        The smallest determinant that is allowed, above 0 and below 1.

    Returns
    -------
    float
        Above 0, and at most 1.
    """
    n = tissue.ndim
    steps = [_steps(displacement, spacing, tissue, axis) for axis in range(n)]
    # A gradient of norm g < 1 leaves a determinant of at least (1 - g)^n: where that is enough, no
    # corner is looked at. Its square is at most the sum over the axes of the longer of both steps.
    squares = np.zeros(tissue.shape, dtype=displacement.dtype)
    for axis, (change, _) in enumerate(steps):
        length = np.einsum("...c,...c->...", change, change).swapaxes(0, axis)
        squares += np.maximum(length[1:], length[:-1]).swapaxes(0, axis)
    sites = np.nonzero(tissue & (squares > (1 - least ** (1 / n)) ** 2))
    if not len(sites[0]):
        return 1.0
    return _march(*_corners(steps, sites, least + _MARGIN), least + _MARGIN)


class _Steps(NamedTuple):
    """From each site to the next along an axis, from before the first to behind the last."""

    # Of displacement, in pixels; 0 where there is no step.
    change: FloatArray
    # Whether both ends are tissue.
    exists: BoolArray


def _steps(
    displacement: FloatArray, spacing: Sequence[float], tissue: BoolArray, axis: int
) -> _Steps:
    d, there = displacement.swapaxes(0, axis), tissue.swapaxes(0, axis)
    shape = [size + (along == axis) for along, size in enumerate(tissue.shape)]
    change = np.zeros((*shape, tissue.ndim), dtype=d.dtype)
    exists = np.zeros(shape, dtype=bool)
    inner = change.swapaxes(0, axis)[1:-1]
    np.subtract(d[1:], d[:-1], out=inner)
    if any(size != 1 for size in spacing):
        inner /= np.asarray(spacing, dtype=d.dtype)
    both = np.logical_and(there[1:], there[:-1], out=exists.swapaxes(0, axis)[1:-1])
    if not both.all():
        inner *= both[..., None]
    return _Steps(change, exists)


def _corners(
    steps: list[_Steps], sites: tuple[npt.NDArray[np.intp], ...], least: float
) -> tuple[Float64Array, Float64Array]:
    """The coefficients of corners' determinants at a scale s, and how fast these fall."""
    # det(1 + s G) = 1 + s a + s^2 b + s^3 c. Corners that cannot come near the least are left out.
    n, sides = len(steps), []
    for axis, step in enumerate(steps):
        behind, ahead = sites, [index + (along == axis) for along, index in enumerate(sites)]
        (before, after), (is_before, is_after) = (
            [values[tuple(at)].T for at in (behind, ahead)] for values in step
        )
        # As in the measure: where a neighbour is missing, the step to the other one counts.
        sides.append((np.where(is_after, after, before), np.where(is_before, before, after)))
    found = []
    for corner in product(*sides):
        g = [column.astype(np.float64) for column in corner]
        minors = {
            (i, j): g[i][i] * g[j][j] - g[i][j] * g[j][i] for i, j in combinations(range(n), 2)
        }
        powers = [sum(g[i][i] for i in range(n)), sum(minors.values())]
        if n == 3:
            first = g[0][1] * (g[1][2] * g[2][0] - g[1][0] * g[2][2])
            second = g[0][2] * (g[1][0] * g[2][1] - g[1][1] * g[2][0])
            powers.append(g[0][0] * minors[1, 2] + first + second)
        made = np.stack(powers)
        near = np.abs(made).sum(axis=0) > 1 - least
        found.append(made[:, near])
    coefficients = np.concatenate(found, axis=1)
    powers_of = np.arange(1, n + 1)[:, None]
    return coefficients, (powers_of * np.abs(coefficients)).sum(axis=0)


def _march(coefficients: Float64Array, fall: Float64Array, least: float) -> float:
    """Go from 0 towards 1, never past the first scale at which a determinant is the least one."""
    # Up to 1 no determinant falls faster than `fall`: a step by it oversteps nothing.
    powers, scale = np.arange(1, len(coefficients) + 1), 0.0
    while scale < 1:
        slack = 1 - least + scale**powers @ coefficients
        near = slack < fall * (1 - scale)
        if not near.any():
            return 1.0
        coefficients, fall = coefficients[:, near], fall[near]
        gain = float((slack[near] / fall).min())
        scale += gain
        if gain < _NEAR * scale:
            return scale
    return 1.0
