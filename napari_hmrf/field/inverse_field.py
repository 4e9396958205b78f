"""The motion back: a field that leads what is seen to where it came from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.field.moved_points import looked_up, looked_up_with_slopes
from napari_hmrf.field.warp import as_field, inverse_map
from napari_hmrf.solver.problem import as_numbers

Float64Array = npt.NDArray[np.float64]

#: A point is found when it is known to so many pixels, and given up after so many steps.
_NEAR, _STEPS = 1e-6, 30
#: No step goes further than so many pixels: beyond, the slope of a field says nothing.
_FARTHEST = 4.0
#: So many points are inverted at once: what that takes of memory is a few MB, whatever a field's.
_AT_ONCE = 2**14


class Inverse(NamedTuple):
    """A field inverted, and how well.

    Attributes
    ----------
    displacement : ndarray, shape ([D,] H, W, n), float64
        Of the points of the grid as they are seen after the motion: what is seen at P was at
        P + u(P). In the unit of the spacing.
    residual : float
        How far, in pixels, the field leads P + u(P) from P at the worst site; only of sites that
        tissue came to, and NaN if it came to none; of a volume only of those that came from within
        tissue, not from its outermost sites. A volume that folds has no inverse there, and it is
        large; of what folds beside something that does not move, and of a slice, the part is taken
        that is not turned over.
    """

    displacement: Float64Array
    residual: float


def inverse_displacement(
    displacement: npt.ArrayLike,
    *,
    spacing: Sequence[float],
    tissue: npt.ArrayLike | None = None,
) -> Inverse:
    """Invert a motion at each site of its grid: u with u(P) = X - P, where X + d(X) = P.

    In two dimensions by `inverse_map`, exact for motion that is linear on triangles; in three by
    `origins_at`, some planes after the others, for motion that is linear along each axis. Where
    something does not move `inverse_map` says first which tissue is seen.

    Parameters
    ----------
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Material displacement, components in the order of the axes, in the unit of `spacing`.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    tissue : array_like of bool, shape ([D,] H, W), optional
        What moves; by default everything. Where tissue has left a gap beside what does not move,
        the rim between both is taken to be stretched over it.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    d = as_field(displacement).astype(np.float64)
    volume = d.shape[-1] == 3
    if volume and (tissue is None or np.all(tissue)):
        return _inverse_of_volume(d / spacing, spacing)
    sites = np.moveaxis(np.indices(d.shape[:-1], dtype=np.float64), 0, -1)
    origins, known = inverse_map(d, spacing=spacing, tissue=tissue)
    pixels, moved = d / spacing, known
    if volume:
        mask = as_numbers("tissue", tissue).astype(bool)
        moved = known & (mask | (origins != sites).any(axis=-1))
        origins[moved], moved[moved] = _refined(pixels, mask, sites[moved], origins[moved])
    if not known.all() and tissue is not None:
        sheet, there = inverse_map(d, spacing=spacing)
        origins[~known], filled = sheet[~known], known | there
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
    """Find where in a volume that which is seen at points came from: X with X + d(X) = P.

    By Newton's method, for motion that is trilinear between sites; all are taken to have an origin.

    Parameters
    ----------
    pixels : ndarray, shape (D, H, W, 3)
        Material displacement, in pixels.
    points : ndarray, shape (N, 3)
        In pixels.
    near : ndarray, shape (N, 3), optional
        Where to begin to look.

    Returns
    -------
    ndarray, shape (N, 3), float64
        In pixels.
    """
    found = np.empty(points.shape)
    for start in range(0, len(points), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        found[part] = _by_newton(pixels, points[part], None if near is None else near[part])
    return found


def _refined(
    pixels: Float64Array,
    tissue: npt.NDArray[np.bool_],
    points: Float64Array,
    origins: Float64Array,
) -> tuple[Float64Array, npt.NDArray[np.bool_]]:
    """Refine origins to trilinear motion; return them and whether they lie within tissue."""
    # The field is extended beyond the tissue, so that steps that lead there come back.
    found = origins_at(_extended(pixels, tissue), points, origins)
    near = (np.abs(found - origins) < 1).all(axis=-1)
    # Beside what does not move the field is no more than that of tetrahedra.
    within = near & (looked_up(tissue[..., np.newaxis].astype(float), found)[:, 0] > 1 - _NEAR)
    return np.where(within[:, np.newaxis], found, origins), within


def _inverse_of_volume(pixels: Float64Array, spacing: Sequence[float]) -> Inverse:
    """Invert a volume's motion at all of its sites."""
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
    """Return the largest distance, in pixels, between a site and the image of its origin."""
    away = looked_up(pixels, origins) + origins - sites
    return float(np.linalg.norm(away, axis=-1).max())


def _by_newton(
    pixels: npt.NDArray[np.floating], targets: Float64Array, near: Float64Array | None = None
) -> Float64Array:
    """Find the origins of some points at once."""
    found = targets - looked_up(pixels, targets) if near is None else near.copy()
    open_ones = np.arange(len(targets))
    for _ in range(_STEPS):
        at = found[open_ones]
        values, slopes = looked_up_with_slopes(pixels, at)
        slope = slopes + np.eye(3)
        # Singular slopes, as of a field that folds, are replaced by the identity.
        slope[np.abs(np.linalg.det(slope)) < 1e-3] = np.eye(3)
        step = np.linalg.solve(slope, (at + values - targets[open_ones])[..., None])[..., 0]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        found[open_ones] = at - step * np.minimum(1, _FARTHEST / np.maximum(length, _NEAR))
        open_ones = open_ones[length[:, 0] > _NEAR]
        if not len(open_ones):
            break
    return found


def _extended(values: Float64Array, known: npt.NDArray[np.bool_]) -> Float64Array:
    """Give sites that are not known the value of the nearest that is; 0 if none is."""
    if not known.any():
        return np.zeros_like(values)
    nearest = scipy.ndimage.distance_transform_edt(
        ~known, return_distances=False, return_indices=True
    )
    extended: Float64Array = values[tuple(nearest)]
    return extended
