"""Where points of the tissue go, and those of an outline, which bends."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.problem import as_numbers

#: Pieces of a side of a rectangle, and of an ellipse, which are bent.
_PIECES, _ROUND = 8, 64


def moved_points(
    points: npt.ArrayLike, displacement: npt.ArrayLike, *, spacing: Sequence[float]
) -> npt.NDArray[np.float64]:
    """Move points with the tissue: what is at X goes to X + d(X), linear between pixels.

    Parameters
    ----------
    points : array_like, shape (N, n)
        In pixels, in the order of the axes; of an image's edge those beyond it.
    displacement : array_like, shape ([D,] H, W, n)
        Material, in the unit of `spacing`.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.

    Returns
    -------
    ndarray, shape (N, n), float64
        In pixels.

    Raises
    ------
    ProblemError
        If the points have not as many axes as the field.
    """
    d = as_numbers("displacement", displacement)
    at = as_numbers("points", points).astype(np.float64)
    n = d.shape[-1]
    if at.ndim != 2 or at.shape[1] != n:
        raise ProblemError("points", f"have shape {at.shape}. Give (N, {n}), a row for each point.")
    return at + looked_up(d, at) / spacing


def looked_up(
    field: npt.NDArray[np.floating], points: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Look a field, ([D,] H, W, k), up at points, (N, n) in pixels: linear between its sites.

    Beyond its edge it stays as it is there.
    """
    parts = [
        scipy.ndimage.map_coordinates(field[..., part], points.T, order=1, mode="nearest")
        for part in range(field.shape[-1])
    ]
    return np.stack(parts, axis=-1)


def looked_up_with_slopes(
    field: npt.NDArray[np.floating], points: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Look a field up as `looked_up` does, and by how much it changes a pixel further.

    Returns
    -------
    values : ndarray, shape (N, k)
    slopes : ndarray, shape (N, k, n)
        Along each axis: between the corners of the cell that a point is in. 0 beyond the edge.
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
    # Axis by axis, of both ends of each cell that is left: the value, and the slopes so far.
    parts = [field[tuple(corners)].astype(np.float64)]
    for axis in range(n):
        share, inside = (at - low)[:, axis, None], (at == points)[:, axis, None]
        slope = (parts[0][1] - parts[0][0]) * inside
        parts = [*(part[0] + (part[1] - part[0]) * share for part in parts), slope]
    return parts[0], np.stack(parts[1:], axis=-1)


def bendable(corners: npt.NDArray[np.float64], kind: str) -> tuple[npt.NDArray[np.float64], str]:
    """Describe an outline by points that may each go elsewhere.

    Parameters
    ----------
    corners : ndarray, shape (N, n)
        In pixels, in the order along the outline; of an ellipse those of the box around it.
    kind : str
        "rectangle" or "ellipse"; any other is of points already.

    Returns
    -------
    points : ndarray, shape (M, n)
    kind : str
        "polygon", if it was one of the two.
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
