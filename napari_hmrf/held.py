"""Whether what is observed determines how elastic tissue moves.

A piece of tissue can move as a rigid body in three ways (along rows, along columns, and turning) at
no cost. What is observed of it must stop all three, or there is no one answer.
"""

from __future__ import annotations

import numpy as np
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.problem import Problem

# Below this fraction of the largest, what holds a rigid motion is rounding.
_NOTHING = 1e-9
_MOTIONS = ("along rows", "along columns", "by turning")


def check_held(problem: Problem) -> None:
    """Refuse a problem with a piece of tissue that could still move freely.

    Raises
    ------
    ProblemError
        Naming the piece by its size and centre, and how it could move.
    """
    tissue = problem.tissue
    elements = tissue[:-1, :-1] & tissue[:-1, 1:] & tissue[1:, :-1] & tissue[1:, 1:]
    pieces, count = scipy.ndimage.label(elements, structure=np.ones((3, 3)))
    if count == 0:
        raise ProblemError(
            "m", "has tissue nowhere two pixels wide: nothing there could be stretched."
        )
    of_site = np.zeros(tissue.shape, dtype=pieces.dtype)
    for i in (0, 1):
        for j in (0, 1):
            corner = of_site[i : i + pieces.shape[0], j : j + pieces.shape[1]]
            np.maximum(corner, pieces, out=corner)
    for piece, box in enumerate(scipy.ndimage.find_objects(of_site), start=1):
        inside = of_site[box] == piece
        held = ((problem.c[box] > 0) & inside[..., None]).astype(np.float64)
        rows, cols = np.indices(inside.shape)
        rows, cols = rows - inside.shape[0] / 2, cols - inside.shape[1] / 2
        size = max(inside.shape)
        along_rows = np.stack([held[..., 0], 0 * cols, -held[..., 0] * cols / size])
        along_cols = np.stack([0 * rows, held[..., 1], held[..., 1] * rows / size])
        motions = np.concatenate([along_rows.reshape(3, -1), along_cols.reshape(3, -1)], axis=1)
        strength, ways = np.linalg.eigh(motions @ motions.T)
        if strength[0] > _NOTHING * max(strength[-1], 1.0):
            continue
        centre = [
            int(np.mean(at)) + edge.start for at, edge in zip(np.nonzero(inside), box, strict=True)
        ]
        way = _MOTIONS[int(np.argmax(np.abs(ways[:, 0])))]
        what = "is not held anywhere" if strength[-1] <= _NOTHING else f"could still move {way}"
        raise ProblemError(
            "c",
            f"leaves a piece of tissue free: the one of {int(inside.sum())} pixels around "
            f"{tuple(centre)} {what}. Fix some of it in place, or give it no stiffness.",
        )
