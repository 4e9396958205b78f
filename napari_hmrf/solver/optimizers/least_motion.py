"""The one field of least motion, where observations that slip leave several of the same energy.

What pulls at its limit goes on to pull as much if tissue moves a little: if nothing holds a piece
with less than it could, and what pulls at the piece balances, then it may be anywhere between the
marks of its observations. Of all such fields the one of least sum of squares is the answer,
whatever led there: the point of a polyhedron that is nearest to the origin, in as many dimensions
as there are free motions (least distance programming by non-negative least squares: Lawson and
Hanson, Solving Least Squares Problems, 1974).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import scipy

Float64Array = npt.NDArray[np.float64]

# Of a free motion: components that take so small a part in it are at rest.
_REST = 1e-9


def settle(
    d: Float64Array,
    off: Float64Array,
    side: Float64Array,
    motions: Iterable[Float64Array],
    tissue: npt.NDArray[np.bool_],
) -> None:
    """Move `d` in place to the field of least motion.

    Parameters
    ----------
    d : ndarray, shape (H, W, 2)
        Displacement of least energy.
    off : ndarray, shape (H, W, 2)
        How far each observed component is from what was observed of it, y - d.
    side : ndarray, shape (H, W, 2)
        On which side of `d` what was observed of a component must stay: 1, -1, or 0 if nothing was.
    motions : iterable of ndarray, shape (ways, H, W, 2)
        Free motions; those of different items have no site in common.
    tissue : ndarray of bool, shape (H, W)
    """
    for ways in motions:
        moving = (np.abs(ways).max(axis=0) > _REST) & tissue[..., None]
        basis, _ = np.linalg.qr(ways[:, moving].T)
        at = side[moving] != 0
        turned = side[moving][at, None] * basis[at]
        # x = basis^T (d + basis z) is to be least with side (off - basis z) >= 0.
        start = basis.T @ d[moving]
        most = side[moving][at] * off[moving][at] + turned @ start
        nearest = _least_distance(-turned, -most)
        if nearest is not None:
            d[moving] += basis @ (nearest - start)


def _least_distance(rows: Float64Array, bounds: Float64Array) -> Float64Array | None:
    """The shortest x with rows x >= bounds; None if there is none."""
    if not (bounds > 0).any():
        return np.zeros(rows.shape[1])
    matrix = np.vstack([rows.T, bounds / bounds.max()])
    target = np.zeros(len(matrix))
    target[-1] = 1.0
    try:
        weights, rest = scipy.optimize.nnls(matrix, target, maxiter=50 * matrix.shape[1])
    except RuntimeError:
        return None
    if rest < 1e-12:
        return None
    # What is touched is touched exactly.
    touched = weights > 0
    return np.asarray(np.linalg.lstsq(rows[touched], bounds[touched])[0])
