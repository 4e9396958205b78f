"""Arrows at true length, few enough that each can be told from its neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt


def apart(
    arrows: npt.NDArray[np.float32], gap: float, spacing: Sequence[float] = (1.0, 1.0)
) -> npt.NDArray[np.intp]:
    """Choose arrows of which none lies on another; where two do, the longer one stays.

    Parameters
    ----------
    arrows : ndarray, shape (N, 2, 2)
        (start, step) in pixels.
    gap : float
        How far lines must at least be apart, in the unit of `spacing`.
    spacing : sequence of float, shape (2,)
        Size of a pixel in (row, col) direction.

    Returns
    -------
    ndarray of int
        Which to keep, in order.
    """
    if not len(arrows):
        return np.zeros(0, dtype=np.intp)
    # In cells as wide as the gap: a kept line claims its cells and those around them.
    starts, steps = arrows[:, 0] * spacing / gap, arrows[:, 1] * spacing / gap
    lowest = np.minimum(starts, starts + steps).min(axis=0) - 1
    starts = starts - lowest
    size = np.maximum(starts, starts + steps).max(axis=0).astype(int) + 3
    claimed = np.zeros(size, dtype=bool)
    lengths = np.linalg.norm(steps, axis=1)
    kept = []
    for number in np.argsort(-lengths, kind="stable"):
        along = np.linspace(0, 1, int(2 * lengths[number]) + 2)[:, None]
        rows, cols = (starts[number] + along * steps[number]).astype(int).T
        if claimed[rows, cols].any():
            continue
        kept.append(number)
        for row in (-1, 0, 1):
            for col in (-1, 0, 1):
                claimed[rows + row, cols + col] = True
    return np.sort(np.array(kept, dtype=np.intp))
