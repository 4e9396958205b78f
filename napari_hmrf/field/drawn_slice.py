"""Pixels that napari draws for a layer with tilted slices.

napari ignores rotations out of a slice. It places rows and columns by the transform restricted to
the displayed axes, and selects the slice by the inverse transform restricted to the other axes,
rounded to whole pixels.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def pixel_drawn(matrix: Array, drawn: list[int], world: Array) -> Array:
    """Return the pixels that napari draws at world positions.

    Parameters
    ----------
    matrix : ndarray, shape (D + 1, D + 1)
        Homogeneous transform from pixels to world coordinates.
    drawn : list of int
        Displayed axes.
    world : ndarray, shape (..., D)
        World positions.

    Returns
    -------
    ndarray, shape (..., D)
        Positions in pixels, which are whole numbers along axes that are not displayed.
    """
    inverse, others = np.linalg.inv(matrix), _others(matrix, drawn)
    pixel = np.empty(world.shape)
    # The matrix is singular if a volume is displayed edge-on, hence the pseudo-inverse.
    seen = np.linalg.pinv(matrix[np.ix_(drawn, drawn)])
    pixel[..., drawn] = (world - matrix[:-1, -1])[..., drawn] @ seen.T
    across = world[..., others] @ inverse[np.ix_(others, others)].T + inverse[others, -1]
    pixel[..., others] = np.round(across)
    return pixel


def sliders_at(matrix: Array, drawn: list[int], pixel: npt.ArrayLike) -> dict[int, float]:
    """Return the slider positions at which napari draws the slice that contains a pixel.

    Parameters
    ----------
    matrix, drawn
        As for `pixel_drawn`.
    pixel : array_like, shape (D,)
        Position in pixels.

    Returns
    -------
    dict of int to float
        World position of the slider of each axis that is not displayed.
    """
    inverse, others = np.linalg.inv(matrix), _others(matrix, drawn)
    offset = np.asarray(pixel)[others] - inverse[others, -1]
    world = np.linalg.pinv(inverse[np.ix_(others, others)]) @ offset
    return dict(zip(others, world.tolist(), strict=True))


def _others(matrix: Array, drawn: list[int]) -> list[int]:
    return [axis for axis in range(len(matrix) - 1) if axis not in drawn]


def nearest_axes(linear: Array) -> tuple[tuple[int, ...], Array]:
    """Assign the nearest world axis to each pixel axis.

    Parameters
    ----------
    linear : ndarray, shape (n, n)
        World step of one pixel along each axis, as columns.

    Returns
    -------
    main : tuple of int
        World axis of each pixel axis.
    steps : ndarray, shape (n, n)
        Unit vectors of the pixel axes, as columns, with rows in the order of `main`.
    """
    linear = linear / np.linalg.norm(linear, axis=0)

    def nearness(main: Any) -> float:
        return float(np.abs(np.diag(linear[list(main)])).sum())

    main = max(permutations(range(len(linear))), key=nearness)
    return main, linear[list(main)]


def rotation_of(linear: Array) -> Array:
    """Return the rotation nearest to a matrix, or an array of shape (0, 0) for the identity."""
    left, _, right = np.linalg.svd(linear)
    turn = np.round(left @ right, 9) + 0.0
    return np.empty((0, 0)) if np.array_equal(turn, np.eye(len(turn))) else turn
