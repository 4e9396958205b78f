"""Inverse of a displacement field, from moved positions to their origins."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.field.moved_points import interpolate_linearly, interpolate_with_slopes
from napari_hmrf.field.warp import as_field, inverse_map
from napari_hmrf.real_arrays import as_mask

Float64Array = npt.NDArray[np.float64]

#: Newton step length, in pixels, below which the iteration stops; and maximum number of steps.
_NEAR, _STEPS = 1e-6, 30
#: Largest length of a Newton step, in pixels; slopes are unreliable at larger distances.
_FARTHEST = 4.0
#: Number of points that are inverted together, which limits memory to a few MB.
_AT_ONCE = 2**14


class Inverse(NamedTuple):
    """Inverse of a displacement field, and its error.

    Attributes
    ----------
    displacement : ndarray, shape ([D,] H, W, n), float64
        Displacement u from each grid point P, after the motion, to its origin P + u(P), in the unit
        of the spacing.
    residual : float
        Largest distance, in pixels, between a site P and the point to which the field moves
        P + u(P), over the sites that moved tissue covers. In a volume with a mask, sites with an
        origin in the outermost layer of the tissue are excluded. NaN if no sites remain. A field
        on a whole volume has no inverse at folds, and its residual is large there. At folds of a
        slice, or of a volume with a mask, the origin is in the non-inverted part of the tissue.
    """

    displacement: Float64Array
    residual: float


def inverse_displacement(
    displacement: npt.ArrayLike,
    *,
    spacing: Sequence[float],
    tissue: npt.ArrayLike | None = None,
    trilinear: bool = True,
) -> Inverse:
    """Compute the inverse u of a displacement d: u(P) = X - P, where X + d(X) = P.

    Slices are inverted by `inverse_map`, which is exact for motion that is linear on triangles.
    Volumes are inverted by `origins_at`, for trilinear motion, a few planes at a time. In a volume
    with a mask, `inverse_map` first finds the visible tissue at each site.

    Parameters
    ----------
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Material displacement, with components in axis order, in the unit of `spacing`.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    tissue : array_like of bool, shape ([D,] H, W), optional
        Mask of the tissue that moves; by default all sites. A gap between moved tissue and other
        sites is filled as if the field were continuous across the border between them.
    trilinear : bool
        If False, volumes are inverted by `inverse_map` only, like slices. The inverse is then the
        map with which `warp` moves images, also at the border, where half a pixel of tissue
        surrounds the outermost sites.

    Returns
    -------
    Inverse

    Raises
    ------
    ProblemError
        If an input has an invalid shape or value; the error names the input.
    """
    d = as_field(displacement).astype(np.float64)
    volume = d.shape[-1] == 3
    if trilinear and volume and (tissue is None or np.all(tissue)):
        return _inverse_of_volume(d / spacing, spacing)
    sites = np.moveaxis(np.indices(d.shape[:-1], dtype=np.float64), 0, -1)
    origins, known = inverse_map(d, spacing=spacing, tissue=tissue)
    pixels, moved = d / spacing, known
    if trilinear and volume:
        mask = as_mask("tissue", tissue)
        moved = known & (mask | (origins != sites).any(axis=-1))
        origins[moved], moved[moved] = _refined(pixels, mask, sites[moved], origins[moved])
    if not known.all() and tissue is not None:
        sheet, covered = inverse_map(d, spacing=spacing)
        origins[~known], filled = sheet[~known], known | covered
    else:
        filled = known
    if not filled.all():
        origins = _extended(origins - sites, filled) + sites
    back = (origins - sites) * spacing
    residual = _residual(pixels, origins[moved], sites[moved]) if moved.any() else np.nan
    return Inverse(back, residual)


def origins_at(
    pixels: npt.NDArray[np.floating], points: Float64Array, near: Float64Array | None = None
) -> Float64Array:
    """Find the origins X of moved points P in a volume, with X + d(X) = P.

    The motion is trilinear between sites and is inverted by Newton's method. Each point is assumed
    to have an origin.

    Parameters
    ----------
    pixels : ndarray, shape (D, H, W, 3)
        Material displacement, in pixels.
    points : ndarray, shape (N, 3)
        Positions after the motion, in pixels.
    near : ndarray, shape (N, 3), optional
        Initial guesses of the origins, in pixels.

    Returns
    -------
    ndarray, shape (N, 3), float64
        Origins, in pixels.
    """
    origins = np.empty(points.shape)
    for start in range(0, len(points), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        origins[part] = _by_newton(pixels, points[part], None if near is None else near[part])
    return origins


def _refined(
    pixels: Float64Array,
    tissue: npt.NDArray[np.bool_],
    points: Float64Array,
    origins: Float64Array,
) -> tuple[Float64Array, npt.NDArray[np.bool_]]:
    """Return origins refined for trilinear motion, and a mask of origins inside the tissue."""
    # Extend the field beyond the tissue, so that Newton steps that leave the tissue can return.
    refined = origins_at(_extended(pixels, tissue), points, origins)
    near = (np.abs(refined - origins) < 1).all(axis=-1)
    # At the border of the tissue, motion is defined on tetrahedra only and is not refined.
    within = near & (
        interpolate_linearly(tissue[..., np.newaxis].astype(float), refined)[:, 0] > 1 - _NEAR
    )
    return np.where(within[:, np.newaxis], refined, origins), within


def _inverse_of_volume(pixels: Float64Array, spacing: Sequence[float]) -> Inverse:
    """Invert the motion of a whole volume at all sites, a few planes at a time."""
    back, residual = np.empty(pixels.shape), 0.0
    planes = 1 + _AT_ONCE // (1 + math.prod(pixels.shape[1:3]))
    for first in range(0, len(pixels), planes):
        part = back[first : first + planes]
        sites = np.indices(part.shape[:-1], dtype=np.float64).reshape(3, -1).T
        sites[:, 0] += first
        origins = origins_at(pixels, sites)
        residual = max(residual, _residual(pixels, origins, sites))
        part[...] = ((origins - sites) * spacing).reshape(part.shape)
    return Inverse(back, residual)


def _residual(pixels: Float64Array, origins: Float64Array, sites: Float64Array) -> float:
    """Return the largest distance, in pixels, between a site and its moved origin."""
    away = interpolate_linearly(pixels, origins) + origins - sites
    return float(np.linalg.norm(away, axis=-1).max())


def _by_newton(
    pixels: npt.NDArray[np.floating], targets: Float64Array, near: Float64Array | None = None
) -> Float64Array:
    """Find the origins of all points together by Newton's method."""
    origins = targets - interpolate_linearly(pixels, targets) if near is None else near.copy()
    active = np.arange(len(targets))
    for _ in range(_STEPS):
        at = origins[active]
        values, slopes = interpolate_with_slopes(pixels, at)
        slope = slopes + np.eye(3)
        # Replace singular slopes, which occur at folds, with the identity.
        slope[np.abs(np.linalg.det(slope)) < 1e-3] = np.eye(3)
        step = np.linalg.solve(slope, (at + values - targets[active])[..., None])[..., 0]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        origins[active] = at - step * np.minimum(1, _FARTHEST / np.maximum(length, _NEAR))
        active = active[length[:, 0] > _NEAR]
        if not len(active):
            break
    return origins


def _extended(values: Float64Array, known: npt.NDArray[np.bool_]) -> Float64Array:
    """Extend values to all sites from the nearest known site; 0 if no site is known."""
    if not known.any():
        return np.zeros_like(values)
    nearest = scipy.ndimage.distance_transform_edt(
        ~known, return_distances=False, return_indices=True
    )
    extended: Float64Array = values[tuple(nearest)]
    return extended
