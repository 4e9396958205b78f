"""Which pixels napari draws where, of a layer whose transform may tilt it out of its slices.

It draws no turn out of a slice: rows and columns lie where the transform restricted to the axes
that are drawn has them, and its inverse restricted to the others, rounded, says which slice.
"""

from __future__ import annotations

from itertools import permutations
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def pixel_drawn(matrix: Array, drawn: list[int], world: Array) -> Array:
    """Which pixel is drawn at a place of the world.

    Parameters
    ----------
    matrix : ndarray, shape (D + 1, D + 1)
        From pixels to the world.
    drawn : list of int
        Axes that are drawn.
    world : ndarray, shape (D,)
    """
    inverse, others = np.linalg.inv(matrix), _others(matrix, drawn)
    found = np.empty(len(world))
    # Of a volume that is seen edge-on there is no one pixel.
    seen = np.linalg.pinv(matrix[np.ix_(drawn, drawn)])
    found[drawn] = seen @ (world - matrix[:-1, -1])[drawn]
    across = inverse[np.ix_(others, others)] @ world[others] + inverse[others, -1]
    found[others] = np.round(across)
    return found


def sliders_at(matrix: Array, drawn: list[int], pixel: npt.ArrayLike) -> dict[int, float]:
    """Where in the world the sliders of the other axes have a pixel's slice drawn."""
    inverse, others = np.linalg.inv(matrix), _others(matrix, drawn)
    ahead = np.asarray(pixel)[others] - inverse[others, -1]
    world = np.linalg.pinv(inverse[np.ix_(others, others)]) @ ahead
    return dict(zip(others, world.tolist(), strict=True))


def _others(matrix: Array, drawn: list[int]) -> list[int]:
    return [axis for axis in range(len(matrix) - 1) if axis not in drawn]


def nearest_axes(linear: Array) -> tuple[tuple[int, ...], Array]:
    """To which axis of the world each axis of pixels is nearest, and its steps along these.

    Parameters
    ----------
    linear : ndarray, shape (n, n)
        Steps of a pixel, as columns.
    """
    linear = linear / np.linalg.norm(linear, axis=0)

    def nearness(main: Any) -> float:
        return float(np.abs(np.diag(linear[list(main)])).sum())

    main = max(permutations(range(len(linear))), key=nearness)
    return main, linear[list(main)]


def rotation_of(linear: Array) -> Array:
    """The rotation nearest to a matrix; nothing, shape (0, 0), where it does not turn."""
    left, _, right = np.linalg.svd(linear)
    turn = np.round(left @ right, 9) + 0.0
    return np.empty((0, 0)) if np.array_equal(turn, np.eye(len(turn))) else turn
