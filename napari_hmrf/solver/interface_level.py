"""Level of points near an interface: their signed distance from a smooth surface.

The surface is given by points and normals. The level of a point y is the weighted mean of its
distances from the tangent planes (implicit moving least squares),

    level(y) = sum_i w_i g_i (y - p_i) . N_i / sum_i w_i g_i,
    w_i = (1 - q)^4 (4 q + 1),    g_i = exp(-|y - p_i|^2 / (2 width^2))

where q is the distance from p_i along its tangent plane, relative to a reach; w_i = 0 for q >= 1,
and for points whose normal is opposite to that of the nearest point.
Beyond the end of the interface, its presence decreases from 1 to 0: it is a smooth step of
sum_i w_i, relative to the sum at a typical point of the interface. Level and presence have
continuous second derivatives, except in the middle of a part of a few pixels, where the nearest
face changes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

Float64Array = npt.NDArray[np.float64]

#: Points are evaluated in groups of this size, to limit the memory.
_TOGETHER = 2048
#: Standard deviation of the Gaussian weights, relative to the reach.
_WIDTH = 1 / 3
#: Weight at a point, relative to that of a typical point of the interface, at which its presence is
#: 0, and at which it is 1. At the very end of a straight interface, the weight is 0.5.
_ABSENT, _PRESENT = 0.2, 0.42
#: Cosine of the angle between two normals, times this, is the weight of one at the other, from 0 to
#: 1: the two faces of a thin part have opposite normals, and are different surfaces.
_ALIKE = 4.0


class Levels(NamedTuple):
    """Levels of points, and the presence of the interface there, from 0 to 1.

    Attributes
    ----------
    values, presence : ndarray, shape (n,)
        Levels are 0 where the interface is absent.
    slopes, presence_slopes : ndarray, shape (n, axes)
        Gradients.
    curvatures, presence_curvatures : ndarray, shape (n, axes, axes)
        Second derivatives.
    """

    values: Float64Array
    slopes: Float64Array
    curvatures: Float64Array
    presence: Float64Array
    presence_slopes: Float64Array
    presence_curvatures: Float64Array

    @classmethod
    def absent(cls, count: int, axes: int) -> Levels:
        """Return the levels of points far from the interface."""
        shapes = (count,), (count, axes), (count, axes, axes)
        return cls(*map(np.zeros, 2 * shapes))


class Interface:
    """Smooth surface between two parts at rest.

    Parameters
    ----------
    points : ndarray, shape (n, axes)
        Points of the surface.
    normals : ndarray, shape (n, axes)
        Unit normals at these points.
    reach : float
        Largest distance, along its tangent plane, of a point that has a weight.
    depth : float
        Distance from the surface up to which levels are known.
    """

    def __init__(
        self, points: Float64Array, normals: Float64Array, reach: float, depth: float
    ) -> None:
        self._points, self._normals, self._reach = points, normals, reach
        self._radius, self._width = math.hypot(reach, depth), _WIDTH * reach
        self._tree = scipy.spatial.cKDTree(points)
        self._typical = float(np.median(self._weights(points)[0].sum(axis=1)))

    def levels(self, at: Float64Array) -> Levels:
        """Return the levels of points, shape (n, axes)."""
        found = Levels.absent(*at.shape)
        for start in range(0, len(at), _TOGETHER):
            some = slice(start, start + _TOGETHER)
            for total, each in zip(found, self._some_levels(at[some]), strict=True):
                total[some] = each
        return found

    def _some_levels(self, at: Float64Array) -> Levels:
        weight, slope, bend, along, height, normals = self._weights(at)
        eye, total = np.eye(at.shape[1]), weight.sum(axis=1)
        # Derivatives of each weight, which depends on the distance along the tangent plane.
        slopes = slope[..., None] * along
        squares = normals[..., :, None] * normals[..., None, :]
        seconds = bend[..., None, None] * along[..., :, None] * along[..., None, :]
        seconds += slope[..., None, None] * (eye - squares)
        of_total, second = slopes.sum(axis=1), seconds.sum(axis=1)
        # Smooth step with continuous second derivatives.
        t = np.clip((total / self._typical - _ABSENT) / (_PRESENT - _ABSENT), 0, 1)
        unit = self._typical * (_PRESENT - _ABSENT)
        rise = 30 * t**2 * (1 - t) ** 2 / unit
        curve = 60 * t * (1 - t) * (1 - 2 * t) / unit**2
        presence_slope = rise[:, None] * of_total
        presence_curvature = rise[:, None, None] * second
        presence_curvature += curve[:, None, None] * of_total[:, :, None] * of_total[:, None]
        presence = t**3 * (10 - 15 * t + 6 * t**2)
        # The same, times the Gaussian weights.
        near, away = self._near(along, height, normals)
        pull = -away / self._width**2
        mixed = slopes[..., :, None] * pull[..., None, :]
        pulls = pull[..., :, None] * pull[..., None, :] - eye / self._width**2
        seconds += mixed + mixed.swapaxes(-1, -2) + weight[..., None, None] * pulls
        seconds *= near[..., None, None]
        slopes = near[..., None] * (slopes + weight[..., None] * pull)
        weight = near * weight
        is_absent = t == 0
        total = np.where(is_absent, 1.0, weight.sum(axis=1))
        of_total, second = slopes.sum(axis=1), seconds.sum(axis=1)
        of_height = np.einsum("nk,nka->na", height, slopes)
        of_height += np.einsum("nk,nka->na", weight, normals)
        crossed = np.einsum("nka,nkb->nab", slopes, normals)
        heights = np.einsum("nk,nkab->nab", height, seconds) + crossed + crossed.swapaxes(1, 2)
        level = (weight * height).sum(axis=1) / total
        gradient = (of_height - level[:, None] * of_total) / total[:, None]
        outer = gradient[:, :, None] * of_total[:, None]
        curvature = heights - outer - outer.swapaxes(1, 2) - level[:, None, None] * second
        curvature /= total[:, None, None]
        for values in (level, gradient, curvature):
            values[is_absent] = 0
        return Levels(level, gradient, curvature, presence, presence_slope, presence_curvature)

    def _near(
        self, along: Float64Array, height: Float64Array, normals: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return Gaussian weights relative to that of the nearest point, and relative positions."""
        away = along + height[..., None] * normals
        squares = (away**2).sum(axis=-1)
        return np.exp((squares.min(axis=1, keepdims=True) - squares) / (2 * self._width**2)), away

    def _weights(self, at: Float64Array) -> tuple[Float64Array, ...]:
        """Return the weights of the points near each position, and what determines them.

        Returns
        -------
        weights, slopes, bends : ndarray, shape (n, k)
            Weights, their derivatives by the distance along the tangent plane, divided by it, and
            the same of these.
        along : ndarray, shape (n, k, axes)
            Position relative to each point, along its tangent plane.
        heights : ndarray, shape (n, k)
            Distance from the tangent plane.
        normals : ndarray, shape (n, k, axes)
        """
        most = self._tree.query_ball_point(at, self._radius, return_length=True).max(initial=1)
        far, of = self._tree.query(
            at, k=np.arange(1, int(most) + 1), distance_upper_bound=self._radius
        )
        is_near = np.isfinite(far)
        of = np.where(is_near, of, 0)
        normals, away = self._normals[of], at[:, None] - self._points[of]
        heights = (away * normals).sum(axis=-1)
        along = away - heights[..., None] * normals
        q = np.where(is_near, np.linalg.norm(along, axis=-1) / self._reach, 1.0)
        q = np.minimum(q, 1.0)
        alike = np.clip(_ALIKE * np.einsum("nka,na->nk", normals, normals[:, 0]), 0, 1)
        weights = alike * (1 - q) ** 4 * (4 * q + 1)
        slopes = alike * -20 * (1 - q) ** 3 / self._reach**2
        bends = alike * 60 * (1 - q) ** 2 / (self._reach**4 * np.maximum(q, 1e-9))
        return weights, slopes, bends, along, heights, normals
