"""Static condensation of a box onto its ring.

See `napari_hmrf.solver.backends.direct.dissection` for the matrices.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

Float64Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]


class Step(NamedTuple):
    """A condensation: its components, A^-1, A^-1 B, and C A^-1.

    All may have leading axes, for boxes of the same shape.
    """

    own: Index
    ring: Index
    inverse: Float64Array
    right: Float64Array
    left: Float64Array

    def forward(self, load: Float64Array) -> None:
        """Pass the load of own components to the ring, in place."""
        passed = (self.left @ load[self.own][..., None])[..., 0]
        np.subtract.at(load, self.ring, passed)

    def back(self, load: Float64Array, d: Float64Array) -> None:
        """Find the displacement of own components from their load and the ring's, in place."""
        found = self.inverse @ load[self.own][..., None] - self.right @ d[self.ring][..., None]
        d[self.own] = found[..., 0]


class SymmetricStep(NamedTuple):
    """A condensation of symmetric boxes: U of A = U^T U, or its inverse, and U^-T B.

    Many small boxes, with leading axes, have the inverse.
    """

    own: Index
    ring: Index
    factor: Float64Array
    right: Float64Array

    def forward(self, load: Float64Array) -> None:
        """Apply as `Step` does; the load of own components becomes U^-T times it."""
        if self.factor.ndim == 2:
            load[self.own] = _triangular(self.factor, load[self.own], transposed=True)
            load[self.ring] -= load[self.own] @ self.right
            return
        own = self.factor.swapaxes(-1, -2) @ load[self.own][..., None]
        load[self.own] = own[..., 0]
        np.subtract.at(load, self.ring, (self.right.swapaxes(-1, -2) @ own)[..., 0])

    def back(self, load: Float64Array, d: Float64Array) -> None:
        """Apply as `Step` does."""
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
