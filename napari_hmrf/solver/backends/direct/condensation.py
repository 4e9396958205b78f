"""Static condensation of a box of elements onto its ring.

`napari_hmrf.solver.backends.direct.dissection` defines the ring and the matrices A, B and C.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

Float64Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]


class Step(NamedTuple):
    """Condensation of a box.

    All arrays may have leading axes, with one entry for each of several boxes of the same shape.

    Attributes
    ----------
    own, ring : ndarray of int
        Numbers of the interior components and of the ring components.
    inverse, right, left : ndarray
        A^-1, A^-1 B and C A^-1.
    """

    own: Index
    ring: Index
    inverse: Float64Array
    right: Float64Array
    left: Float64Array

    def forward(self, load: Float64Array) -> None:
        """Condense the load of the interior components onto the ring, in place."""
        passed = (self.left @ load[self.own][..., None])[..., 0]
        np.subtract.at(load, self.ring, passed)

    def back(self, load: Float64Array, d: Float64Array) -> None:
        """Compute the displacement of the interior components from that of the ring, in place."""
        found = self.inverse @ load[self.own][..., None] - self.right @ d[self.ring][..., None]
        d[self.own] = found[..., 0]


class SymmetricStep(NamedTuple):
    """Condensation of a box with a symmetric matrix, where A = U^T U.

    Attributes
    ----------
    own, ring : ndarray of int
        Numbers of the interior components and of the ring components.
    factor : ndarray
        U for a single box; U^-1 for several boxes, with leading axes.
    right : ndarray
        U^-T B.
    """

    own: Index
    ring: Index
    factor: Float64Array
    right: Float64Array

    def forward(self, load: Float64Array) -> None:
        """Condense the load as in `Step` and multiply the load of the interior by U^-T."""
        if self.factor.ndim == 2:
            load[self.own] = _triangular(self.factor, load[self.own], transposed=True)
            load[self.ring] -= load[self.own] @ self.right
            return
        own = self.factor.swapaxes(-1, -2) @ load[self.own][..., None]
        load[self.own] = own[..., 0]
        np.subtract.at(load, self.ring, (self.right.swapaxes(-1, -2) @ own)[..., 0])

    def back(self, load: Float64Array, d: Float64Array) -> None:
        """Compute the displacement of the interior components as in `Step`, in place."""
        if self.factor.ndim == 2:
            rest = load[self.own] - self.right @ d[self.ring]
            d[self.own] = _triangular(self.factor, rest)
            return
        rest = load[self.own][..., None] - self.right @ d[self.ring][..., None]
        d[self.own] = (self.factor @ rest)[..., 0]


def _triangular(factor: Float64Array, load: Float64Array, transposed: bool = False) -> Float64Array:
    """Solve U x = load, or U^T x = load."""
    if not len(load):
        return load
    return np.asarray(scipy.linalg.blas.dtrsv(factor, load, trans=int(transposed)))
