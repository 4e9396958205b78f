"""The motion back: a field that leads what is seen to where it came from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.moved_points import looked_up
from napari_hmrf.field.warp import inverse_map
from napari_hmrf.solver.problem import as_numbers

Float64Array = npt.NDArray[np.float64]

#: A point is found when it is known to so many pixels, and given up after so many steps.
_NEAR, _STEPS = 1e-6, 30
#: No step goes further than so many pixels: beyond, the slope of a field says nothing.
_FARTHEST = 4.0


class Inverse(NamedTuple):
    """A field inverted, and how well.

    Attributes
    ----------
    displacement : ndarray, shape ([D,] H, W, n), float64
        Of the points of the grid as they are seen after the motion: what is seen at P was at
        P + u(P). In the unit of the spacing.
    residual : float
        How far, in pixels, the field leads P + u(P) from P at the worst site; only of sites that
        tissue came to, and NaN if it came to none. A volume that folds has no inverse there, and
        it is large; of a slice that folds the part is taken that is not turned over.
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
    Newton's method for motion that is trilinear between sites.

    Parameters
    ----------
    displacement : array_like, shape (H, W, 2) or (D, H, W, 3)
        Material displacement, components in the order of the axes, in the unit of `spacing`.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    tissue : array_like of bool, shape (H, W), optional
        What moves, in two dimensions; by default everything. Where tissue has left a gap beside
        what does not move, the rim between both is taken to be stretched over it.

    Raises
    ------
    ProblemError
        Naming the input at fault.
    """
    d = as_field(displacement)
    n = d.shape[-1]
    sites = np.moveaxis(np.indices(d.shape[:-1], dtype=np.float64), 0, -1)
    if n == 3:
        origins, known = _by_newton(d / spacing, sites)
    else:
        origins, known = inverse_map(d, spacing=spacing, tissue=tissue)
        if not known.all() and tissue is not None:
            sheet, there = inverse_map(d, spacing=spacing)
            origins[~known], filled = sheet[~known], known | there
        else:
            filled = known
        if not filled.all():
            origins = _extended(origins - sites, filled) + sites
    back = (origins - sites) * spacing
    residual = np.nan
    if known.any():
        away = looked_up(d / spacing, origins[known]) + origins[known] - sites[known]
        residual = float(np.linalg.norm(away, axis=-1).max())
    return Inverse(back, residual)


def as_field(displacement: npt.ArrayLike) -> Float64Array:
    """A displacement of a slice or of a volume, in double precision; or a `ProblemError`."""
    d = as_numbers("displacement", displacement).astype(np.float64)
    if d.ndim not in (3, 4) or d.shape[-1] != d.ndim - 1:
        raise ProblemError(
            "displacement", f"has shape {d.shape}. Give (H, W, 2), or (D, H, W, 3) of a volume."
        )
    return d


def _by_newton(
    pixels: Float64Array, sites: Float64Array
) -> tuple[Float64Array, npt.NDArray[np.bool_]]:
    """Find the origin of each site of a volume; all are taken to have one."""
    n = sites.shape[-1]
    targets = sites.reshape(-1, n)
    found = targets - pixels.reshape(-1, n)
    slopes = np.zeros((*pixels.shape, n))
    for axis in range(n):
        if pixels.shape[axis] > 1:  # along a single slice nothing changes
            slopes[..., axis] = np.gradient(pixels, axis=axis)
    open_ones = np.arange(len(targets))
    for _ in range(_STEPS):
        at = found[open_ones]
        away = at + looked_up(pixels, at) - targets[open_ones]
        slope = np.eye(n) + looked_up(slopes.reshape(*sites.shape[:-1], n * n), at).reshape(
            -1, n, n
        )
        # Where a field folds there is no way back; a slope that is no slope is stepped over.
        flat = np.abs(np.linalg.det(slope)) < 1e-3
        slope[flat] = np.eye(n)
        step = np.linalg.solve(slope, away[..., None])[..., 0]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        found[open_ones] = at - step * np.minimum(1, _FARTHEST / np.maximum(length, _NEAR))
        open_ones = open_ones[length[:, 0] > _NEAR]
        if not len(open_ones):
            break
    return found.reshape(sites.shape), np.ones(sites.shape[:-1], dtype=bool)


def _extended(values: Float64Array, known: npt.NDArray[np.bool_]) -> Float64Array:
    """Give sites that are not known the value of the nearest that is; 0 if none is."""
    if not known.any():
        return np.zeros_like(values)
    nearest = scipy.ndimage.distance_transform_edt(
        ~known, return_distances=False, return_indices=True
    )
    extended: Float64Array = values[tuple(nearest)]
    return extended
