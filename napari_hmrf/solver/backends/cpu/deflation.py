"""Deflation of conjugate gradients by the motions of rigid bodies.

Multigrid cycles constrain all rigid bodies like prescribed tissue, so they do not reduce the error
in the few rigid motions of the bodies. Each of these motions has a displacement field: the body
moves, the other bodies stay at rest, and the tissue deforms accordingly. Conjugate gradients are
*deflated* by these fields (Nicolaides, SIAM J. Numer. Anal., 1987): their search directions are
conjugate to the fields, so the iteration converges as fast as if the bodies were prescribed.
"""

# mypy: disable-error-code="untyped-decorator"
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu.compiled import disjoint_parallel, parallel, portion
from napari_hmrf.solver.backends.cpu.level import Vector
from napari_hmrf.solver.backends.cpu.vectors import row_product

# Fields are treated as linearly dependent if an eigenvalue of their scaled stiffness is below this
# value.
_INDEPENDENT = 1e-4


class CpuDeflation:
    """Displacement fields of all rigid motions, and their forces.

    Parameters
    ----------
    fields, forces : ndarray, shape (motions, 2, H + 4, W + 4)
        Displacement field u of each motion, and the product A u.
    lengths : ndarray, shape (motions,)
        Largest displacement of each field, in pixels.
    close : bool
        True if the small level does not resolve the gap between some bodies.

    Attributes
    ----------
    close : bool
        True if the small level does not resolve the gap between some bodies.
    is_independent : bool
        True if the motions are linearly independent in single precision.
    """

    def __init__(self, fields: Vector, forces: Vector, lengths: Vector, close: bool) -> None:
        self.close = close
        self._fields, self._forces = fields, forces
        stiffness = _products(fields, forces)
        stiffness += np.tril(stiffness, -1).T
        self._lengths = lengths
        scale = np.sqrt(np.maximum(np.diag(stiffness), 0.0))
        self.is_independent = bool((scale > 0).all())
        if self.is_independent:
            least = np.linalg.eigvalsh(stiffness / np.outer(scale, scale))[0]
            self.is_independent = bool(least > _INDEPENDENT)
        if self.is_independent:
            self._compliance = np.linalg.inv(stiffness)

    def deflate(self, d: Vector, rest: Vector) -> float:
        """Make the residual `rest` orthogonal to all fields, updating `d` and `rest` in place.

        Return the energy that this update releases.
        """
        work = _products(self._fields, rest[None])[:, 0]
        shares = self._compliance @ work
        _add(self._fields, shares, d)
        _add(self._forces, -shares, rest)
        return float(shares @ work) / 2

    def turn(self, steepest: Vector, direction: Vector, share: float) -> float:
        """Compute ``direction = steepest + share * direction``, made conjugate to all fields.

        Return the largest displacement, in pixels, of the fields that are subtracted from
        `steepest` to make the direction conjugate.
        """
        shares = -self._compliance @ _products(self._forces, steepest[None])[:, 0]
        _turn(steepest, direction, np.float32(share), self._fields, shares.astype(np.float32))
        return float(np.abs(shares) @ self._lengths)

    def remaining_distance(self, rest: Vector) -> float:
        """Return the largest displacement, in pixels, that deflating `rest` would add."""
        shares = self._compliance @ _products(self._fields, rest[None])[:, 0]
        return float(np.abs(shares) @ self._lengths)


def _products(ones: Vector, others: Vector) -> npt.NDArray[np.float64]:
    """Return the lower triangle of the matrix of scalar products of `ones` and `others`."""
    rows = np.zeros((ones.shape[2] - 4, len(ones), len(others)))
    _row_products(ones, others, rows)
    return np.asarray(rows.sum(axis=0))


def _add(some: Vector, shares: npt.NDArray[np.floating], total: Vector) -> None:
    """Add a weighted sum of vectors to `total`, in place."""
    _turn(total, total, np.float32(0), some, shares.astype(np.float32))


@parallel
def _row_products(thread: Any, ones: Any, others: Any, rows: Any) -> None:
    """Compute the contribution of each row to `_products`."""
    for i in portion(thread, len(rows)):
        for k in range(len(ones)):
            for n in range(min(k + 1, len(others))):
                rows[i, k, n] = row_product(ones[k], others[n], i + 2)


@disjoint_parallel
def _turn(thread: Any, steepest: Any, direction: Any, share: Any, some: Any, shares: Any) -> None:
    """Compute ``direction = steepest + share * direction`` plus a weighted sum of vectors."""
    for i in portion(thread, direction.shape[1]):
        for component in range(2):
            for j in range(direction.shape[2]):
                direction[component, i, j] = (
                    steepest[component, i, j] + share * direction[component, i, j]
                )
        for k in range(len(some)):
            for component in range(2):
                for j in range(direction.shape[2]):
                    direction[component, i, j] += shares[k] * some[k, component, i, j]
