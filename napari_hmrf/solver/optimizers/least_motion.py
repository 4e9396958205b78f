"""Field of least motion among several fields of equal energy, with slipping observations.

The force of an observation at its limit stays constant if tissue moves a little. If all
observations of a piece are at their limits and their forces cancel, the energy is the same at any
position of the piece between the observed positions. The field with the smallest sum of squares is
chosen, so that the result does not depend on the iteration. It corresponds to the point nearest to
the origin in a polyhedron with one dimension for each free motion (least distance programming by
non-negative least squares: Lawson and Hanson, Solving Least Squares Problems, 1974).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import scipy

Float64Array = npt.NDArray[np.float64]

# Value in a free motion, relative to its scale, up to which a component is at rest.
_REST = 1e-9
# Motion beyond an observed position, in pixels, that is negligible. With such a bound beside others
# of a pixel, the method fails.
_NEGLIGIBLE = 1e-9


def choose_least_motion(
    d: Float64Array,
    off: Float64Array,
    side: Float64Array,
    motions: Iterable[Float64Array],
    tissue: npt.NDArray[np.bool_],
) -> None:
    """Choose the field of least motion, in place.

    Parameters
    ----------
    d : ndarray, shape (H, W, 2)
        Displacement of lowest energy; changed in place.
    off : ndarray, shape (H, W, 2)
        Observed value minus displacement, y - d, of each observed component.
    side : ndarray, shape (H, W, 2)
        Sign that ``y - d`` of a component must keep: 1 or -1; 0 for an unobserved component.
    motions : iterable of ndarray, each of shape (n, H, W, 2)
        Free motions, in groups without common sites.
    tissue : ndarray of bool, shape (H, W)
        Mask of tissue.
    """
    for ways in motions:
        moving = (np.abs(ways).max(axis=0) > _REST) & tissue[..., None]
        basis, _ = np.linalg.qr(ways[:, moving].T)
        at = side[moving] != 0
        turned = side[moving][at, None] * basis[at]
        # Minimize ||basis^T (d + basis z)|| subject to side (off - basis z) >= 0.
        start = basis.T @ d[moving]
        most = side[moving][at] * off[moving][at] + turned @ start
        nearest = _least_distance(-turned, -most)
        if nearest is not None:
            d[moving] += basis @ (nearest - start)


def _least_distance(rows: Float64Array, bounds: Float64Array) -> Float64Array | None:
    """Return the shortest x with ``rows @ x >= bounds``, or None if there is none."""
    if not (bounds > _NEGLIGIBLE).any():
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
    # The active constraints are equalities, which determine x to full accuracy.
    is_active = weights > 0
    return np.asarray(np.linalg.lstsq(rows[is_active], bounds[is_active])[0])
