"""Motion of points and outlines with the tissue."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import as_numbers, grid_in_words

#: Numbers of line segments that replace each side of a rectangle, and an ellipse.
_PIECES, _ROUND = 8, 64


def moved_points(
    points: npt.ArrayLike, displacement: npt.ArrayLike, *, spacing: Sequence[float]
) -> npt.NDArray[np.float64]:
    """Move points with the tissue, from X to X + d(X), where d is linear between pixels.

    Parameters
    ----------
    points : array_like, shape (N, n)
        Positions in pixels, in axis order. Points outside the image move like the nearest point on
        its border.
    displacement : array_like, shape ([D,] H, W, n)
        Material displacement, in the unit of `spacing`.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.

    Returns
    -------
    ndarray, shape (N, n), float64
        Moved positions, in pixels.

    Raises
    ------
    ProblemError
        If the points do not have one coordinate for each component of the displacement.
    """
    d = as_numbers("displacement", displacement)
    at = as_numbers("points", points).astype(np.float64)
    n = d.shape[-1]
    if at.ndim != 2 or at.shape[1] != n:
        raise ProblemError("points", f"have shape {at.shape}. Pass (N, {n}), a row for each point.")
    return at + interpolate_linearly(d, at) / spacing


def refuse_outside(points: npt.ArrayLike, shape: tuple[int, ...]) -> None:
    """Raise an error if all points are outside a grid.

    The usual reason is that the points are in mm instead of pixels.

    Parameters
    ----------
    points : array_like, shape (N, n)
        Positions in pixels.
    shape : tuple of int
        Number of pixels along each axis.

    Raises
    ------
    ProblemError
        If all points are outside the grid; the error names the first point.
    """
    at = as_numbers("points", points).astype(np.float64)
    if at.ndim != 2 or at.shape[1] != len(shape) or not len(at):
        return
    if ((at >= -0.5) & (at <= np.array(shape) - 0.5)).all(axis=1).any():
        return
    raise ProblemError(
        "points",
        f"lie outside the grid of {grid_in_words(shape)} pixels, the first at "
        f"{tuple(at[0].tolist())}. Pass positions in pixels; Grid.to_pixels(points) converts "
        "points in mm.",
    )


def interpolate_linearly(
    field: npt.NDArray[np.floating], points: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Interpolate a field linearly at points; beyond its border the field is constant.

    Parameters
    ----------
    field : ndarray, shape ([D,] H, W, k)
    points : ndarray, shape (N, n)
        Positions in pixels.

    Returns
    -------
    ndarray, shape (N, k), float64
        Interpolated values.
    """
    parts = [
        scipy.ndimage.map_coordinates(field[..., part], points.T, order=1, mode="nearest")
        for part in range(field.shape[-1])
    ]
    return np.stack(parts, axis=-1)


def interpolate_in_tissue(
    field: npt.NDArray[np.floating],
    tissue: npt.NDArray[np.bool_],
    points: npt.NDArray[np.float64],
    *,
    spacing: Sequence[float],
) -> npt.NDArray[np.float64]:
    """Interpolate a field linearly at points, and continue it beyond the tissue.

    Sites without tissue have the value of the nearest tissue.

    Parameters
    ----------
    field : ndarray, shape ([D,] H, W, k)
        Values, of which those of tissue are used.
    tissue : ndarray of bool, shape ([D,] H, W)
    points : ndarray, shape (N, n)
        Positions in pixels. Beyond the border, the extended field is constant.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis, for the distance to tissue.

    Returns
    -------
    ndarray, shape (N, k), float64
        Interpolated values.
    """
    size = np.asarray(spacing, np.float64)
    inner = scipy.ndimage.binary_erosion(tissue, border_value=1)
    surface = np.argwhere(tissue & ~inner if (tissue & ~inner).any() else tissue)
    tree = scipy.spatial.cKDTree(surface * size)
    last = np.array(tissue.shape) - 1
    at = np.clip(points, 0, last)
    low = np.minimum(at.astype(np.intp), np.maximum(last - 1, 0))
    total = np.zeros((len(points), field.shape[-1]))
    for corner in np.ndindex(*(2,) * tissue.ndim):
        site = np.minimum(low + corner, last)
        share = np.where(corner, at - low, 1 - (at - low)).prod(axis=1)
        void = ~tissue[tuple(site.T)]
        if void.any():
            _, nearest = tree.query(site[void] * size)
            site[void] = surface[nearest]
        total += share[:, None] * field[tuple(site.T)]
    return total


def interpolate_with_slopes(
    field: npt.NDArray[np.floating], points: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Interpolate a field linearly at points, and compute its derivatives.

    Parameters
    ----------
    field, points
        As for `interpolate_linearly`.

    Returns
    -------
    values : ndarray, shape (N, k)
        As returned by `interpolate_linearly`.
    slopes : ndarray, shape (N, k, n)
        Derivatives with respect to each axis, per pixel, in the cell that contains the point; 0
        beyond the border.
    """
    n = points.shape[1]
    last = np.array(field.shape[:-1]) - 1
    at = np.clip(points, 0, last)
    low = np.minimum(at.astype(np.intp), np.maximum(last - 1, 0))
    ends = [low, np.minimum(low + 1, last)]
    corners = [
        np.stack([end[:, axis] for end in ends]).reshape(*np.eye(n, dtype=int)[axis] + 1, -1)
        for axis in range(n)
    ]
    # Interpolate axis by axis: `parts` contains the values, then the slopes along the axes so far.
    parts = [field[tuple(corners)].astype(np.float64)]
    for axis in range(n):
        share, inside = (at - low)[:, axis, None], (at == points)[:, axis, None]
        slope = (parts[0][1] - parts[0][0]) * inside
        parts = [*(part[0] + (part[1] - part[0]) * share for part in parts), slope]
    return parts[0], np.stack(parts[1:], axis=-1)


def bendable(corners: npt.NDArray[np.float64], kind: str) -> tuple[npt.NDArray[np.float64], str]:
    """Convert a rectangle or an ellipse to a polygon, which can deform with the tissue.

    Parameters
    ----------
    corners : ndarray, shape (N, n)
        Vertices in pixels, in order along the outline; for an ellipse, the corners of its
        bounding box.
    kind : str
        Type of shape in napari; only "rectangle" and "ellipse" are converted.

    Returns
    -------
    points : ndarray, shape (M, n)
        Vertices in pixels.
    kind : str
        "polygon" for a rectangle or an ellipse, otherwise the given type.
    """
    if kind == "rectangle":
        part = np.linspace(0, 1, _PIECES, endpoint=False)[:, None]
        ends = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        return np.concatenate([begin + part * (end - begin) for begin, end in ends]), "polygon"
    if kind == "ellipse":
        angles = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)[:, None]
        along, across = (corners[1] - corners[0]) / 2, (corners[3] - corners[0]) / 2
        middle = corners.mean(axis=0)
        return middle + np.cos(angles) * along + np.sin(angles) * across, "polygon"
    return corners, kind
