"""Field of least motion among several fields of equal energy, where observations slip.

An observation at its limit pulls with a constant force if tissue moves a little. If all
observations of a piece are at their limits and their forces balance, the piece may be anywhere
between the observed positions. Of all such fields the one with the least sum of squares is chosen,
whatever path led to it. It is the point of a polyhedron that is nearest to the origin, in as many
dimensions as there are free motions (least distance programming by non-negative least squares:
Lawson and Hanson, Solving Least Squares Problems, 1974).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import scipy

Float64Array = npt.NDArray[np.float64]

# Value in a free motion up to which a component counts as at rest.
_REST = 1e-9


def choose_least_motion(
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
        Distance of each observed component from its observed value, y - d.
    side : ndarray, shape (H, W, 2)
        Side of `d` on which the observed value of a component must stay: 1 or -1; 0 if the
        component is not observed.
    motions : iterable of ndarray, shape (ways, H, W, 2)
        Free motions; those of different items have no site in common.
    tissue : ndarray of bool, shape (H, W)
        Mask of tissue.
    """
    for ways in motions:
        moving = (np.abs(ways).max(axis=0) > _REST) & tissue[..., None]
        basis, _ = np.linalg.qr(ways[:, moving].T)
        at = side[moving] != 0
        turned = side[moving][at, None] * basis[at]
        # Minimise the norm of x = basis^T (d + basis z) with side (off - basis z) >= 0.
        start = basis.T @ d[moving]
        most = side[moving][at] * off[moving][at] + turned @ start
        nearest = _least_distance(-turned, -most)
        if nearest is not None:
            d[moving] += basis @ (nearest - start)


def _least_distance(rows: Float64Array, bounds: Float64Array) -> Float64Array | None:
    """Return the shortest x with rows x >= bounds; None if there is none."""
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
    # Active constraints hold with equality, which gives x to full accuracy.
    is_active = weights > 0
    return np.asarray(np.linalg.lstsq(rows[is_active], bounds[is_active])[0])
