"""Fields of rigid bodies that move and take tissue along: what cycles that hold bodies do not see.

With all bodies held a cycle sees of rigid tissue what it sees of any that is held. What is left are
the few motions of bodies. Each has a field: a body that moves so, the others at rest, and tissue
that follows. Conjugate gradients are *deflated* by these (Nicolaides, SIAM J. Numer. Anal.,
1987): their directions do no work on them, so that they converge as if bodies were held.
"""

# mypy: disable-error-code="untyped-decorator"
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import prange

from napari_hmrf.solver.backends.cpu.compiled import parallel
from napari_hmrf.solver.backends.cpu.level import Vector
from napari_hmrf.solver.backends.cpu.vectors import row_product

# Below this part of a field's own stiffness, what another leaves of it is rounding.
_INDEPENDENT = 1e-4


class CpuEntrained:
    """The fields of all motions, and the forces that they take.

    Parameters
    ----------
    fields, forces : ndarray, shape (motions, 2, H + 4, W + 4)
    lengths : ndarray, shape (motions,)
        How far fields move anything, at most.
    close : bool
        Whether bodies are so close together that what lies between is not seen well.

    Attributes
    ----------
    close : bool
    sure : bool
        True if single precision separates the motions.
    """

    def __init__(self, fields: Vector, forces: Vector, lengths: Vector, close: bool) -> None:
        self.close = close
        self._fields, self._forces = fields, forces
        stiffness = _products(fields, forces)
        stiffness += np.tril(stiffness, -1).T
        self._lengths = lengths
        scale = np.sqrt(np.maximum(np.diag(stiffness), 0.0))
        self.sure = bool((scale > 0).all())
        if self.sure:
            least = np.linalg.eigvalsh(stiffness / np.outer(scale, scale))[0]
            self.sure = bool(least > _INDEPENDENT)
        if self.sure:
            self._compliance = np.linalg.inv(stiffness)

    def settle(self, d: Vector, rest: Vector) -> float:
        """Move bodies to where `rest` does no work on a field, in place; the energy that takes."""
        work = _products(self._fields, rest[None])[:, 0]
        shares = self._compliance @ work
        _add(self._fields, shares, d)
        _add(self._forces, -shares, rest)
        return float(shares @ work) / 2

    def turn(self, steepest: Vector, direction: Vector, share: float) -> float:
        """Compute direction = steepest + share direction, with bodies moved so that none resists.

        They move so far, which is returned, that the forces of `steepest` do no work on any field.
        """
        shares = -self._compliance @ _products(self._forces, steepest[None])[:, 0]
        _turn(steepest, direction, np.float32(share), self._fields, shares.astype(np.float32))
        return float(np.abs(shares) @ self._lengths)

    def astray(self, rest: Vector) -> float:
        """Return the largest distance of bodies and entrained tissue from their goal in `rest`."""
        shares = self._compliance @ _products(self._fields, rest[None])[:, 0]
        return float(np.abs(shares) @ self._lengths)


def _products(ones: Vector, others: Vector) -> npt.NDArray[np.float64]:
    """The scalar products of some vectors with no later ones of others."""
    rows = np.zeros((ones.shape[2] - 4, len(ones), len(others)))
    _row_products(ones, others, rows)
    return np.asarray(rows.sum(axis=0))


def _add(some: Vector, shares: npt.NDArray[np.floating], total: Vector) -> None:
    """Total += the sum of shares of vectors."""
    _turn(total, total, np.float32(0), some, shares.astype(np.float32))


@parallel
def _row_products(ones: Any, others: Any, rows: Any) -> None:
    """Row by row."""
    for i in prange(len(rows)):
        for k in range(len(ones)):
            for n in range(min(k + 1, len(others))):
                rows[i, k, n] = row_product(ones[k], others[n], i + 2)


@parallel
def _turn(steepest: Any, direction: Any, share: Any, some: Any, shares: Any) -> None:
    """Direction = steepest + share direction + the sum of shares of vectors."""
    for i in prange(direction.shape[1]):
        for component in range(2):
            for j in range(direction.shape[2]):
                direction[component, i, j] = (
                    steepest[component, i, j] + share * direction[component, i, j]
                )
        for k in range(len(some)):
            for component in range(2):
                for j in range(direction.shape[2]):
                    direction[component, i, j] += shares[k] * some[k, component, i, j]
