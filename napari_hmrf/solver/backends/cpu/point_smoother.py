"""Smoother of the finest level with landmarks: an exact step at the corners of their elements.

With P = H^T w H of the landmarks, the block smoother B = (D + W)^-1 becomes

    (D + W + P)^-1 = B - U S^-1 U^T    with U = B H^T and S = w^-1 + H U

S couples only landmarks that share corners. A Chebyshev step with B moves tissue by ``scale s``;
the step with the landmarks is obtained by subtracting ``scale U S^-1 H (s + d)``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.data_term import PointTerm

Float64Array = npt.NDArray[np.float64]


class PointSmoother:
    """Correction of a smoothing step for landmarks.

    Parameters
    ----------
    points : PointTerm
    inverse : ndarray, planes
        Diagonal of B, in single precision; 0 at fixed components.
    mixed : ndarray
        Other components of W, followed by those of B; one or three of each.
    """

    def __init__(
        self, points: PointTerm, inverse: npt.NDArray[Any], mixed: npt.NDArray[Any]
    ) -> None:
        axes, (count, corners) = len(inverse), points.corners.shape
        self._touched, place = np.unique(points.corners, return_inverse=True)
        place, size = place.reshape(count, corners), len(self._touched)
        # Unknowns are numbered by component, then by corner or landmark.
        number = np.repeat(np.arange(count), corners)
        one = scipy.sparse.csr_array(
            (points.shares.ravel(), (number, place.ravel())), shape=(count, size)
        )
        self._at = scipy.sparse.block_diag([one] * axes, format="csr")
        diagonal = inverse.reshape(axes, -1)[:, self._touched].astype(np.float64)
        others = mixed.reshape(len(mixed), -1)[len(mixed) // 2 :, self._touched].astype(np.float64)
        blocks: list[list[Any]] = [[None] * axes for _ in range(axes)]
        pairs = [(i, j) for i in range(axes) for j in range(i + 1, axes)]
        for axis in range(axes):
            blocks[axis][axis] = scipy.sparse.diags_array(diagonal[axis])
        for (i, j), values in zip(pairs, others, strict=True):
            blocks[i][j] = blocks[j][i] = scipy.sparse.diags_array(values)
        spread = scipy.sparse.block_array(blocks, format="csr") @ self._at.T
        share = scipy.sparse.diags_array(1 / points.weights.ravel()) + self._at @ spread
        self._step = (spread @ _inverse(share.tocsr())).tocsr()

    def moved(self, d: npt.NDArray[Any]) -> Float64Array:
        """Return H d, the displacement of all components of all landmarks."""
        values = d.reshape(len(d), -1)[:, self._touched]
        return np.asarray(self._at @ values.ravel(), np.float64)

    def subtract(self, way: Float64Array, out: npt.NDArray[Any]) -> None:
        """Subtract U S^-1 `way` from `out`, in place."""
        flat = out.reshape(len(out), -1)
        flat[:, self._touched] -= (self._step @ way).reshape(len(out), -1).astype(out.dtype)


def _inverse(matrix: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Return the inverse of a sparse matrix by the inverses of its independent blocks."""
    count, block = scipy.sparse.csgraph.connected_components(matrix, directed=False)
    order = np.argsort(block, kind="stable")
    rows, cols, values = [], [], []
    for at in np.split(order, np.cumsum(np.bincount(block, minlength=count))[:-1]):
        dense = np.linalg.inv(matrix[at][:, at].toarray())
        rows.append(np.repeat(at, len(at)))
        cols.append(np.tile(at, len(at)))
        values.append(dense.ravel())
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))
    return scipy.sparse.csr_array(entries, shape=matrix.shape)
