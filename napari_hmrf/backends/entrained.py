"""Fields of rigid bodies that move and take tissue along: what cycles that hold bodies do not see.

With all bodies held a cycle sees of rigid tissue what it sees of any that is held. What is left are
the few motions of bodies. Each has a field: a body that moves so, the others at rest, and tissue
that follows. Conjugate gradients are *deflated* by these (Nicolaides, SIAM J. Numer. Anal.,
1987): their directions do no work on them, so that they converge as if bodies were held.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

Vectors = npt.NDArray[np.float32]

# Below this part of a field's own stiffness, what another leaves of it is rounding.
_INDEPENDENT = 1e-4


class Entrained:
    """The fields of all motions, and the forces that they take.

    Parameters
    ----------
    fields, forces : ndarray, shape (motions, ...)
    close : bool
        Whether bodies are so close together that what lies between is not seen well.

    Attributes
    ----------
    close : bool
    sure : bool
        Whether single precision tells the motions apart.
    """

    def __init__(self, fields: Vectors, forces: Vectors, close: bool) -> None:
        self.close = close
        self._fields, self._forces = (each.reshape(len(each), -1) for each in (fields, forces))
        # One by one: BLAS multiplies matrices as narrow as these more slowly.
        stiffness = np.zeros((len(fields), len(fields)))
        for k, force in enumerate(self._forces):
            stiffness[k, : k + 1] = [field @ force for field in self._fields[: k + 1]]
        stiffness += np.tril(stiffness, -1).T
        self._lengths = np.abs(self._fields).max(axis=1)
        scale = np.sqrt(np.maximum(np.diag(stiffness), 0.0))
        self.sure = bool((scale > 0).all())
        if self.sure:
            least = np.linalg.eigvalsh(stiffness / np.outer(scale, scale))[0]
            self.sure = bool(least > _INDEPENDENT)
        if self.sure:
            self._compliance = np.linalg.inv(stiffness)

    def settle(self, d: Vectors, rest: Vectors) -> float:
        """Move bodies to where `rest` does no work on a field, in place; the energy that takes."""
        work = self._fields @ rest.ravel()
        shares = self._compliance @ work
        _add(self._fields, shares, d)
        _add(self._forces, -shares, rest)
        return float(shares @ work) / 2

    def deflate(self, direction: Vectors) -> None:
        """Move bodies along, in place, so that a direction's forces do no work on any field."""
        _add(self._fields, -self._compliance @ (self._forces @ direction.ravel()), direction)

    def astray(self, rest: Vectors) -> float:
        """How far, at most, bodies and what they entrain are from where `rest` moves them."""
        shares = self._compliance @ (self._fields @ rest.ravel())
        return float(np.abs(shares) @ self._lengths)


def _add(vectors: Vectors, shares: npt.NDArray[np.floating], total: Vectors) -> None:
    """Total += the sum of shares of vectors."""
    share = np.asarray(shares, dtype=np.float32)
    scipy.linalg.blas.sgemv(1.0, vectors.T, share, 1.0, total.reshape(-1), overwrite_y=True)
