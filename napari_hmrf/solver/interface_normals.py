"""Normals of the interface between two labels, whose sites are a staircase.

The interface passes between neighbouring sites of different labels. The midpoints of these pairs
are at most half a pixel from the true surface. A quadratic surface is therefore fitted to the
midpoints around each site, in the widest window in which it stays near all of them: a plane is
recognized over tens of pixels, and a curved surface is fitted in a narrower window.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

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
#: Weight of a penalty on the curvature, which only keeps the fit of a few midpoints regular.
_PENALTY = 1.0
#: Standard deviation of the blur that gives the first estimate, in pixels.
_BLUR = 2.0
#: Standard deviation of the Gaussian mean of fitted normals, in pixels. It removes the jumps
#: between windows of different width.
_MEAN = 1.5
# Number of midpoints per pixel of an interface, at most.
_DENSITY = 2.0
# Number of frames of a fit.
_FRAMES = 3
# Number of sites that are fitted together, to limit the memory.
_TOGETHER = 1024


def interface_normals(
    first: Mask, second: Mask, sites: npt.NDArray[np.intp], spacing: Sequence[float]
) -> Float64Array:
    """Return the normals of the interface between two labels, at sites near the interface.

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
    ndarray, shape (n, axes)
        Unit normal in space, from `first` to `second`.
    """
    size = np.asarray(spacing, np.float64) / max(spacing)
    points = _midpoints(first, second) * size
    guess = _blurred_normals(first, second, sites, size)
    if not len(points):
        return guess  # the labels touch at corners only
    at = sites * size
    normals = guess.copy()
    tree, axes = scipy.spatial.cKDTree(points), first.ndim
    todo = np.arange(len(at))
    for width in _WIDTHS[axes]:
        narrowest = width == _WIDTHS[axes][-1]
        reach = _REACH * width
        area = 2 * reach if axes == 2 else np.pi * reach**2
        most = min(len(points), 8 + int(_DENSITY * area))
        left = []
        for start in range(0, len(todo), _TOGETHER):
            some = todo[start : start + _TOGETHER]
            far, of = tree.query(at[some], k=np.arange(1, most + 1))
            weight = np.where(far <= reach, np.exp(-0.5 * (far / width) ** 2), 0.0)
            fitted, residual = _fit(points[of] - at[some, None], weight, guess[some])
            worst = np.abs(np.where(weight > 0, residual, 0.0)).max(axis=1)
            good = (worst <= _NEAR) | narrowest
            normals[some[good]] = fitted[good]
            left.append(some[~good])
        todo = np.concatenate(left) if left else todo[:0]
        if not len(todo):
            break
    normals *= np.where((normals * guess).sum(axis=1) < 0, -1, 1)[:, None]
    return _means(at, normals)


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
    """Return the normals of the blurred labels at sites."""
    difference = second.astype(np.float64) - first
    blurred = scipy.ndimage.gaussian_filter(difference, tuple(_BLUR / size), mode="nearest")
    where = tuple(sites.T)
    slopes = [np.gradient(blurred, step, axis=axis)[where] for axis, step in enumerate(size)]
    slope = np.stack(slopes, axis=-1)
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    slope[length[:, 0] == 0, 0] = 1.0
    return slope / np.where(length == 0, 1.0, length)


def _fit(
    relative: Float64Array, weight: Float64Array, normals: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Fit quadratic surfaces to points, and return their normals at the origin and residuals.

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
    residual : ndarray, shape (n, k)
        Distance of each point from the surface along the normal of the last frame.
    """
    axes = relative.shape[2]
    pairs = list(itertools.combinations_with_replacement(range(axes - 1), 2))
    penalty = np.diag([1e-9] * axes + [_PENALTY] * len(pairs))
    residual = np.zeros(weight.shape)
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
        residual = height - (terms @ shape)[..., 0]
        tilted = normals - (along @ shape[:, 1:axes])[..., 0]
        normals = tilted / np.linalg.norm(tilted, axis=1, keepdims=True)
    return normals, residual


def _means(at: Float64Array, normals: Float64Array) -> Float64Array:
    """Return Gaussian means of the normals of nearby sites."""
    most = min(len(at), 24 if at.shape[1] == 2 else 64)
    tree = scipy.spatial.cKDTree(at)
    means = np.empty_like(normals)
    for start in range(0, len(at), _TOGETHER):
        far, of = tree.query(at[start : start + _TOGETHER], k=np.arange(1, most + 1))
        weight = np.exp(-0.5 * (far / _MEAN) ** 2)
        # On the two sides of a fold, normals differ, and only similar normals are averaged.
        alike = (normals[of] * normals[start : start + _TOGETHER, None]).sum(axis=-1)
        weight *= np.maximum(alike, 0.0) ** 8
        means[start : start + _TOGETHER] = (weight[..., None] * normals[of]).sum(axis=1)
    return np.asarray(means / np.linalg.norm(means, axis=1, keepdims=True))
