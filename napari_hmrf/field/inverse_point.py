"""Inverse of a motion at single points of the warped image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import permutations, product
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.moved_points import interpolate_with_slopes

Point = TypeVar("Point", bound=tuple[float, ...])
#: Largest distance, in pixels, from a point to the nearest moved site; points beyond are in a gap.
_APART = 3.0
#: Tolerance of the barycentric coordinates of points inside a tetrahedron; and six times the volume
#: below which a tetrahedron is treated as collapsed.
_SIDE, _COLLAPSED = 1e-9, 1e-12
#: Residual, in pixels, below which an origin is exact; largest number of Newton steps; and
#: determinant of the slopes below which a step is undefined.
_EXACT, _STEPS, _FLAT = 1e-7, 8, 1e-3
#: Corners of the six tetrahedra of a cell, as in `inverse_map`. The corners of each tetrahedron lie
#: on a path of three edges from the first to the last corner of the cell.
_TETRAHEDRA = np.array(
    [
        np.cumsum([(0, 0, 0), *np.eye(3, dtype=int)[list(way)]], axis=0)
        for way in permutations(range(3))
    ]
)


def inverse_point(
    point: Point,
    displacement: npt.NDArray[np.floating],
    spacing: Sequence[float],
    tissue: npt.NDArray[np.bool_],
    farthest: npt.NDArray[np.floating] | None = None,
    fraction: float = 1.0,
) -> Point | None:
    """Invert the motion at one point, to within a fraction of a pixel.

    This is faster than inverting the motion at all sites. In a volume the result is exact for
    motion that is trilinear in each cell.

    Parameters
    ----------
    point : tuple of float
        Position after the motion, ([depth,] row, col) in pixels.
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Material displacement, in the unit of `spacing`.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    tissue : ndarray of bool, shape ([D,] H, W)
        Mask of the tissue that moves.
    farthest : ndarray, shape (n,), optional
        Result of `farthest_of` for the displacement, if already known; computing it takes longer
        than the rest of this function.
    fraction : float
        Fraction of the displacement by which the tissue has moved, from 0 to 1.

    Returns
    -------
    tuple of float, or None
        Origin X, in pixels, for which X + fraction d(X) is the point; None if no tissue is there.
    """
    size = np.asarray(spacing, dtype=np.float64)
    most = farthest_of(displacement) if farthest is None else farthest
    reach = fraction * most / size + _APART
    low = [max(0, math.floor(at - far)) for at, far in zip(point, reach, strict=True)]
    high = [
        min(extent, math.ceil(at + far) + 1)
        for at, far, extent in zip(point, reach, tissue.shape, strict=True)
    ]
    if any(first >= past for first, past in zip(low, high, strict=True)):
        return None
    window = tuple(slice(first, past) for first, past in zip(low, high, strict=True))
    mask = tissue[window]
    steps = fraction * displacement[window] / size
    moved = steps + np.moveaxis(np.indices(mask.shape), 0, -1) + low
    exact = _in_cells(moved, mask, point) if tissue.ndim == 3 else None
    origin = _near_site(moved, mask, point) if exact is None else exact
    return None if origin is None else cast(Point, tuple((origin + low).tolist()))


def _near_site(
    moved: npt.NDArray[np.float64], tissue: npt.NDArray[np.bool_], point: Sequence[float]
) -> npt.NDArray[np.float64] | None:
    """Return the origin, assuming linear motion around the nearest moved site."""
    away = moved - point
    squared = np.where(tissue, (away**2).sum(axis=-1), np.inf)
    site = tuple(int(at) for at in np.unravel_index(int(squared.argmin()), squared.shape))
    if not squared[site] <= _APART**2:
        return None
    n = tissue.ndim
    gradient, step = np.eye(n), np.zeros(n)
    for axis, at in enumerate(site):
        line: tuple[Any, ...] = (*site[:axis], slice(None), *site[axis + 1 :])
        inside, along = tissue[line], moved[line]
        before = at - 1 if at > 0 and inside[at - 1] else at
        after = at + 1 if at + 1 < len(inside) and inside[at + 1] else at
        if before < after:
            gradient[:, axis] = (along[after] - along[before]) / (after - before)
    if abs(np.linalg.det(gradient)) > 1e-3:
        step = np.clip(np.linalg.solve(gradient, -away[site]), -1, 1)
    return np.array(site) + step


def _in_cells(
    moved: npt.NDArray[np.float64], tissue: npt.NDArray[np.bool_], point: Sequence[float]
) -> npt.NDArray[np.float64] | None:
    """Return the origin of a point for motion that is trilinear in each cell, or None.

    The origin for motion that is linear on tetrahedra is returned without refinement if its
    tetrahedron is inverted, if a cell contains sites outside tissue, or if Newton's method fails.
    """
    start, is_upright = _in_tetrahedra(moved, tissue, point)
    if start is None or not is_upright:
        return start
    origin, last = start, np.array(tissue.shape) - 1
    for _ in range(_STEPS):
        inside = ((origin >= -_SIDE) & (origin <= last + _SIDE)).all()
        low = np.clip(np.floor(origin).astype(int), 0, np.maximum(last - 1, 0))
        if not (inside and tissue[tuple(slice(at, at + 2) for at in low)].all()):
            return start
        # On a face between two cells, the slopes of one of the cells are used.
        values, slopes = interpolate_with_slopes(moved, np.clip(origin, 0, last)[np.newaxis])
        away = values[0] - point
        if np.abs(away).max() < _EXACT:
            return origin
        if abs(np.linalg.det(slopes[0])) < _FLAT:
            return start
        origin = origin - np.linalg.solve(slopes[0], away)
        if np.abs(origin - start).max() > 1:
            return start
    return start


def _in_tetrahedra(
    moved: npt.NDArray[np.float64], tissue: npt.NDArray[np.bool_], point: Sequence[float]
) -> tuple[npt.NDArray[np.float64] | None, bool]:
    """Return the origin of a point, and whether its tetrahedron is upright, that is, not inverted.

    An inverted tetrahedron is used only if no other tetrahedron contains the point. If there is no
    tetrahedron around the point, the origin is None.
    """
    cells = [
        moved[tuple(slice(one, size - 1 + one) for one, size in zip(at, tissue.shape, strict=True))]
        for at in product((0, 1), repeat=3)
    ]
    low, high = np.minimum.reduce(cells), np.maximum.reduce(cells)
    around = ((low <= np.add(point, _SIDE)) & (high >= np.subtract(point, _SIDE))).all(axis=-1)
    corners = (np.argwhere(around)[:, None, None] + _TETRAHEDRA).reshape(-1, 4, 3)
    axes = tuple(np.moveaxis(corners, -1, 0))
    places = moved[axes]
    edges = np.swapaxes(places[:, 1:] - places[:, :1], 1, 2)
    rest = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    volumes = np.linalg.det(edges) * np.linalg.det(rest)
    valid = tissue[axes].all(axis=1) & (np.abs(volumes) >= _COLLAPSED)
    edges, volumes, corners = edges[valid], volumes[valid], corners[valid]
    parts = np.linalg.solve(edges, (point - places[valid, 0])[..., np.newaxis])[..., 0]
    inside = (parts >= -_SIDE).all(axis=1) & (parts.sum(axis=1) <= 1 + _SIDE)
    for way in (volumes > 0, volumes < 0):
        numbers = np.flatnonzero(inside & way)
        if len(numbers):
            first = numbers[0]
            origin: npt.NDArray[np.float64] = (
                corners[first, 0] + parts[first] @ rest[valid][first].T
            )
            return origin, bool(volumes[first] > 0)
    return None, False


def farthest_of(displacement: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return the largest displacement along each axis, in the unit of the displacement."""
    # Reducing along the first axis first is much faster than reducing over all pixels at once.
    rows = displacement.reshape(len(displacement), -1)
    most = np.maximum(rows.max(axis=0), -rows.min(axis=0)).reshape(-1, displacement.shape[-1])
    farthest: npt.NDArray[np.floating] = most.max(axis=0)
    return farthest
