"""Where points of the tissue go."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.problem import as_numbers


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
