"""Largest scale at which a displacement does not fold tissue or compress it too much."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.deformation import elements
from napari_hmrf.field.slabs import with_neighbours

FloatArray = npt.NDArray[np.floating[Any]]
Float64Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

# Relative accuracy of the scale.
_NEAR = 1e-4
# Margin above the smallest allowed determinant, chosen larger than rounding errors.
_MARGIN = 1e-5
# Number of sites processed together, small enough for intermediate arrays to fit into the cache.
_SITES = 1 << 17


def largest_scale(
    displacement: FloatArray, spacing: Sequence[float], tissue: BoolArray, least: float
) -> float:
    """Find the largest scale, at most 1, at which a displacement keeps Jacobians above a limit.

    At the returned scale and at all smaller scales, the Jacobian determinant at each corner of each
    element (see `smallest_determinant`) is at least `least`.

    Parameters
    ----------
    displacement : ndarray, shape ([D,] H, W, n)
        Material displacement, in the unit of `spacing`.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    tissue : ndarray of bool, shape ([D,] H, W)
        Mask of tissue.
    least : float
        Smallest allowed determinant, above 0 and below 1.

    Returns
    -------
    float
        Scale, above 0 and at most 1.
    """
    least = least + _MARGIN
    planes = max(1, _SITES // math.prod(tissue.shape[1:]))
    corners = [
        _corners_of(displacement, spacing, tissue, least, slice(begin, begin + planes))
        for begin in range(0, len(tissue), planes)
    ]
    return _march(np.concatenate(corners, axis=1), least)


def _corners_of(
    displacement: FloatArray,
    spacing: Sequence[float],
    tissue: BoolArray,
    least: float,
    slab: slice,
) -> Float64Array:
    """Return the coefficients (`_corners`) of the sites in a slab that may violate the limit."""
    n = tissue.ndim
    wide, inner = with_neighbours(slab, len(tissue))
    d, mask = displacement[wide].reshape(-1, n), tissue[wide]
    weights = (1 / np.square(spacing)).astype(d.dtype)
    # If the displacement gradient has norm g < 1, the determinant is at least (1 - g)^n. Skip
    # corners where this bound is above the limit. g^2 is at most the sum, over the axes, of the
    # squared length of the longer of the two steps along each axis.
    squares, steps = np.zeros(len(d), dtype=d.dtype), []
    for axis in range(n):
        step = _steps(mask, axis)
        change = d[step.stride :] - d[: -step.stride]
        length = np.square(change, out=change) @ weights
        length *= step.exists[: -step.stride]
        longer = np.zeros(len(d), dtype=d.dtype)
        longer[: -step.stride] = length
        np.maximum(longer[step.stride :], length, out=longer[step.stride :])
        squares += longer
        steps.append(step)
    candidates = mask & (squares > (1 - least ** (1 / n)) ** 2).reshape(mask.shape)
    candidates[: inner.start] = candidates[inner.stop :] = False
    return _corners(d, spacing, steps, mask, np.flatnonzero(candidates), least)


class _Steps(NamedTuple):
    """Steps from each site to the next site along an axis, in flattened arrays."""

    # Distance to the next site in the flattened array.
    stride: int
    # True if the next site exists and both sites are tissue.
    exists: BoolArray


def _steps(tissue: BoolArray, axis: int) -> _Steps:
    exists = np.zeros(tissue.shape, dtype=bool)
    along = tissue.swapaxes(0, axis)
    np.logical_and(along[1:], along[:-1], out=exists.swapaxes(0, axis)[:-1])
    return _Steps(math.prod(tissue.shape[axis + 1 :]), exists.ravel())


def _corners(
    d: FloatArray,
    spacing: Sequence[float],
    steps: list[_Steps],
    tissue: BoolArray,
    sites: npt.NDArray[np.intp],
    least: float,
) -> Float64Array:
    """Return the coefficients, (n, corners), of each corner's determinant as a polynomial in s.

    Corners at which the determinant cannot reach the limit are omitted.
    """
    # det(I + s G) = 1 + s a + s^2 b + s^3 c.
    n, sides = len(steps), []
    size = np.asarray(spacing, dtype=np.float64)
    for stride, exists in steps:
        last = len(d) - 1
        behind, ahead = np.maximum(sites - stride, 0), np.minimum(sites + stride, last)
        is_after, is_before = exists[sites, None], exists[behind, None] & (sites >= stride)[:, None]
        here = d[sites].astype(np.float64)
        after = np.where(is_after, d[ahead] - here, 0.0) / size
        before = np.where(is_before, here - d[behind], 0.0) / size
        sides.append((after.T, before.T))
    corners = []
    exist, places = elements(tissue), np.unravel_index(sites, tissue.shape)
    ways = product((1, 0), repeat=n)
    for g, way in zip(product(*sides), ways, strict=True):
        is_corner = exist[tuple(place + step for place, step in zip(places, way, strict=True))]
        minors = {
            (i, j): g[i][i] * g[j][j] - g[i][j] * g[j][i] for i, j in combinations(range(n), 2)
        }
        powers = [sum(g[i][i] for i in range(n)), sum(minors.values())]
        if n == 3:
            first = g[0][1] * (g[1][2] * g[2][0] - g[1][0] * g[2][2])
            second = g[0][2] * (g[1][0] * g[2][1] - g[1][1] * g[2][0])
            powers.append(g[0][0] * minors[1, 2] + first + second)
        coefficients = np.stack(powers)
        reaches = np.abs(coefficients).sum(axis=0) > 1 - least
        corners.append(coefficients[:, is_corner & reaches])
    return np.concatenate(corners, axis=1)


def _march(coefficients: Float64Array, least: float) -> float:
    """Return the smallest scale at which a determinant reaches the limit, at most 1."""
    # Up to scale 1, no determinant decreases faster than `fall`, so a step of slack / fall does not
    # cross the limit.
    powers, scale = np.arange(1, len(coefficients) + 1), 0.0
    fall = powers @ np.abs(coefficients)
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
