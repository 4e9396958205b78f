"""Where what is seen at a point of the moved picture was before it moved, and the other way."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

#: Tissue that is stretched has its sites so many pixels apart at most, or there is a gap.
_APART = 3.0


def inverse_point(
    point: tuple[float, ...],
    displacement: npt.NDArray[np.float32],
    spacing: Sequence[float],
    tissue: npt.NDArray[np.bool_],
    farthest: npt.NDArray[np.float32] | None = None,
    fraction: float = 1.0,
) -> tuple[float, ...] | None:
    """Invert the motion at one point: faster than everywhere, and good to a fraction of a pixel.

    Parameters
    ----------
    point : (float, float)
        (row, col) in pixels.
    displacement : ndarray, shape (H, W, 2)
        Material, in the unit of `spacing`.
    spacing : sequence of float, shape (2,)
        Size of a pixel in (row, col) direction.
    tissue : ndarray of bool, shape (H, W)
        What moves.
    farthest : ndarray, shape (2,), optional
        `farthest_of` the displacement, where it is known: to find it takes longer than the rest.
    fraction : float
        How much of the displacement the tissue has moved by.

    Returns
    -------
    (float, float) or None
        The X, in pixels, with X + fraction d(X) at the point; None where there is no tissue.
    """
    size = np.asarray(spacing, dtype=np.float64)
    most = farthest_of(displacement) if farthest is None else farthest
    reach = fraction * most / size + _APART
    low = [max(0, math.floor(at - far)) for at, far in zip(point, reach, strict=True)]
    high = [
        min(extent, math.ceil(at + far) + 1)
        for at, far, extent in zip(point, reach, tissue.shape, strict=True)
    ]
    if low[0] >= high[0] or low[1] >= high[1]:
        return None
    window = (slice(low[0], high[0]), slice(low[1], high[1]))
    there = tissue[window]
    steps = fraction * displacement[window] / size
    moved = steps + np.moveaxis(np.indices(there.shape), 0, -1) + low
    away = moved - point
    squared = np.where(there, (away**2).sum(axis=-1), np.inf)
    row, col = np.unravel_index(int(squared.argmin()), squared.shape)
    if not squared[row, col] <= _APART**2:
        return None
    # From the nearest site on, the motion is as linear as its neighbours in tissue say.
    gradient, step = np.eye(2), np.zeros(2)
    lines = [(row, there[:, col], moved[:, col]), (col, there[row], moved[row])]
    for axis, (at, inside, along) in enumerate(lines):
        before = at - 1 if at > 0 and inside[at - 1] else at
        after = at + 1 if at + 1 < len(inside) and inside[at + 1] else at
        if before < after:
            gradient[:, axis] = (along[after] - along[before]) / (after - before)
    if abs(np.linalg.det(gradient)) > 1e-3:
        step = np.clip(np.linalg.solve(gradient, -away[row, col]), -1, 1)
    return float(row + low[0] + step[0]), float(col + low[1] + step[1])


def farthest_of(displacement: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """How far anything moves, (row, col), in the unit of the displacement."""
    most: npt.NDArray[np.float32] = np.abs(displacement).reshape(-1, 2).max(axis=0)
    return most
