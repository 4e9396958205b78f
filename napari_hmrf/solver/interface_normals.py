"""Position and normals of the interface between two labels, whose sites are a staircase.

The interface passes between neighbouring sites of different labels. The midpoints of these pairs
are at most half a pixel from the true surface. A quadratic surface is therefore fitted to the
midpoints around each site, in the widest window in which it stays near all of them: a plane is
recognized over tens of pixels, and a curved surface is fitted in a narrower window.

The normals do not depend on the order of the labels or of the axes: a window is a ball, of which
all points count, and a fit has no preferred direction in the plane of the interface.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

Float64Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

#: Standard deviations of the Gaussian weights of a fit, in pixels, from wide to narrow windows.
_WIDTHS = {
    2: (24.0, 16.0, 13.0, 11.0, 9.0, 8.0, 7.0, 6.0, 5.0, 4.2, 3.5, 2.8),
    3: (6.0, 5.0, 4.0, 3.2, 2.5),
}
#: Radius of a window, in standard deviations.
_REACH = 2.0
#: Largest distance of a midpoint from a fitted surface, in pixels. A midpoint is up to half a pixel
#: from the true surface; the rest is the error of the fit.
_NEAR = 0.85
#: Largest distance of a midpoint from the true surface, in pixels.
_HALF = 0.5
#: Weight of a penalty on the squared norm of the matrix of curvatures. It only keeps the fit of a
#: few midpoints regular.
_PENALTY = 1.0
#: Standard deviation of the blur that gives the first estimate, in pixels.
_BLUR = 2.0
#: Standard deviation of the Gaussian mean of fitted normals, in pixels. It removes the jumps
#: between windows of different width.
_MEAN = 1.5
#: Radius of the Gaussian mean, in standard deviations.
_MEAN_REACH = 3.0
# Points this close to the edge of a window, relative to its radius, are outside of the window.
_EDGE = 1e-9
# Gradient of the blurred labels, per pixel, up to which it is rounding error.
_FLAT = 1e-9
# Number of frames of a fit.
_FRAMES = 3
# Number of sites that are fitted together, to limit the memory.
_TOGETHER = 1024


def interface_surface(
    first: Mask, second: Mask, sites: npt.NDArray[np.intp], spacing: Sequence[float]
) -> tuple[Float64Array, Float64Array]:
    """Return normals and distances of the interface between two labels, at sites near it.

    Parameters
    ----------
    first, second : ndarray of bool, shape (H, W) or (D, H, W)
        Sites of the two labels.
    sites : ndarray of int, shape (n, axes)
        Sites in an element that contains both labels.
    spacing : sequence of float, shape (axes,)
        Size of a pixel along each axis.

    Returns
    -------
    normals : ndarray, shape (n, axes)
        Unit normal in space, from `first` to `second`.
    distances : ndarray, shape (n,)
        Distance of each site from the interface along its normal, in the unit of the spacing;
        negative on the side of `first`.
    """
    size = np.asarray(spacing, np.float64) / max(spacing)
    points, at = _midpoints(first, second) * size, sites * size
    guess = _blurred_normals(first, second, sites, size)
    distances = np.zeros(len(at))
    if not len(points):
        return guess, distances  # the labels touch at corners only
    tree, axes = scipy.spatial.cKDTree(points), first.ndim
    flat = ~guess.any(axis=1)
    guess[flat] = _thinnest_directions(points, tree, at[flat])
    normals = guess.copy()
    todo = np.arange(len(at))
    for width in _WIDTHS[axes]:
        narrowest = width == _WIDTHS[axes][-1]
        left = []
        for start in range(0, len(todo), _TOGETHER):
            some = todo[start : start + _TOGETHER]
            weight, of = _window(tree, at[some], width, _REACH)
            fitted, height, residual = _fit(points[of] - at[some, None], weight, guess[some])
            worst = np.abs(np.where(weight > 0, residual, 0.0)).max(axis=1)
            good = (worst <= _NEAR) | narrowest
            # The fit of a few midpoints may pass far from them.
            far = tree.query(at[some])[0] + _HALF
            distance = -np.clip(height, -far, far)
            normals[some[good]], distances[some[good]] = fitted[good], distance[good]
            left.append(some[~good])
        todo = np.concatenate(left) if left else todo[:0]
        if not len(todo):
            break
    signs = np.where((normals * guess).sum(axis=1) < 0, -1, 1)
    return _means(at, normals * signs[:, None]), distances * signs * max(spacing)


def _window(
    tree: Any, at: Float64Array, width: float, reach: float
) -> tuple[Float64Array, npt.NDArray[np.intp]]:
    """Return the Gaussian weights and the indices of all points of a tree near each position.

    Parameters
    ----------
    tree : cKDTree
    at : ndarray, shape (n, axes)
        Positions.
    width : float
        Standard deviation of the weights.
    reach : float
        Radius of the window, in standard deviations.

    Returns
    -------
    weight : ndarray, shape (n, k)
        Weights; 0 where a window has fewer than k points.
    of : ndarray of int, shape (n, k)
        Indices of the points.
    """
    radius = reach * width * (1 - _EDGE)
    most = max(1, int(tree.query_ball_point(at, radius, return_length=True).max(initial=0)))
    far, of = tree.query(at, k=np.arange(1, most + 1), distance_upper_bound=radius)
    return np.exp(-0.5 * (far / width) ** 2), np.minimum(of, tree.n - 1)


def _thinnest_directions(points: Float64Array, tree: Any, at: Float64Array) -> Float64Array:
    """Return the direction in which the points around each position extend least."""
    made = np.empty_like(at)
    narrowest = _WIDTHS[at.shape[1]][-1]
    for start in range(0, len(at), _TOGETHER):
        some = at[start : start + _TOGETHER]
        weight, of = _window(tree, some, narrowest, _REACH)
        relative = points[of] - some[:, None]
        moments = (weight[..., None] * relative).swapaxes(1, 2) @ relative
        made[start : start + _TOGETHER] = np.linalg.eigh(moments)[1][..., 0]
    return made


def _midpoints(first: Mask, second: Mask) -> Float64Array:
    """Return the midpoints of neighbouring sites of different labels, shape (n, axes)."""
    found = []
    for axis in range(first.ndim):
        one, two = np.moveaxis(first, axis, 0), np.moveaxis(second, axis, 0)
        cut = (one[:-1] & two[1:]) | (two[:-1] & one[1:])
        at = np.argwhere(np.moveaxis(cut, 0, axis)).astype(np.float64)
        at[:, axis] += 0.5
        found.append(at)
    return np.concatenate(found)


def _blurred_normals(
    first: Mask, second: Mask, sites: npt.NDArray[np.intp], size: Float64Array
) -> Float64Array:
    """Return the normals of the blurred labels at sites; 0 where the blurred labels are flat."""
    difference = second.astype(np.float64) - first
    blurred = scipy.ndimage.gaussian_filter(difference, tuple(_BLUR / size), mode="nearest")
    where = tuple(sites.T)
    slopes = [np.gradient(blurred, step, axis=axis)[where] for axis, step in enumerate(size)]
    slope = np.stack(slopes, axis=-1)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    return np.where(length > _FLAT, slope / np.maximum(length, _FLAT), 0.0)


def _fit(
    relative: Float64Array, weight: Float64Array, normals: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Fit quadratic surfaces to points, and return their normals, heights and residuals.

    Parameters
    ----------
    relative : ndarray, shape (n, k, axes)
        Positions of the points relative to the site.
    weight : ndarray, shape (n, k)
        Weights of the points.
    normals : ndarray, shape (n, axes)
        First estimate of the normals.

    Returns
    -------
    normals : ndarray, shape (n, axes)
        Normals at the origin.
    height : ndarray, shape (n,)
        Distance of the surface from the origin along the normal.
    residual : ndarray, shape (n, k)
        Distance of each point from the surface along the normal of the last frame.
    """
    axes = relative.shape[2]
    pairs = list(itertools.combinations_with_replacement(range(axes - 1), 2))
    # The coefficient of u_a u_b is the sum of two equal elements of the matrix of curvatures.
    curvatures = [_PENALTY if a == b else _PENALTY / 2 for a, b in pairs]
    penalty = np.diag([1e-9] * axes + curvatures)
    residual, middle = np.zeros(weight.shape), np.zeros(len(normals))
    for _ in range(_FRAMES):
        eye = np.broadcast_to(np.eye(axes), (len(normals), axes, axes))
        frame = np.concatenate([normals[:, :, None], eye], axis=2)
        along = np.linalg.qr(frame)[0][:, :, 1:axes]
        height = (relative * normals[:, None]).sum(axis=-1)
        u = relative @ along
        columns = [np.ones_like(height), *np.moveaxis(u, -1, 0)]
        columns += [u[..., a] * u[..., b] for a, b in pairs]
        terms = np.stack(columns, axis=-1)
        weighted = (weight[..., None] * terms).swapaxes(1, 2)
        shape = np.linalg.solve(weighted @ terms + penalty, weighted @ height[..., None])
        residual, middle = height - (terms @ shape)[..., 0], shape[:, 0, 0]
        tilted = normals - (along @ shape[:, 1:axes])[..., 0]
        normals = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    return normals, middle, residual


def _means(at: Float64Array, normals: Float64Array) -> Float64Array:
    """Return Gaussian means of the normals of nearby sites, in which opposite normals are equal."""
    tree = scipy.spatial.cKDTree(at)
    means = np.empty_like(normals)
    for start in range(0, len(at), _TOGETHER):
        some = slice(start, start + _TOGETHER)
        weight, of = _window(tree, at[some], _MEAN, _MEAN_REACH)
        # On the two sides of a fold, normals differ, and only similar normals are averaged.
        alike = (normals[of] * normals[some, None]).sum(axis=-1)
        weight *= np.sign(alike) * alike**8
        means[some] = (weight[..., None] * normals[of]).sum(axis=1)
    return np.asarray(means / np.linalg.norm(means, axis=1, keepdims=True))
