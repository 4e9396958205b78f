"""Finest level of a volume in double precision, for tissue with high contrast.

With high contrast, an iteration in single precision stagnates before it has reduced the error in
all soft modes. Only the iteration itself requires double precision; its multigrid preconditioner
runs in single precision.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import volume
from napari_hmrf.solver.backends.cpu.layout import flat
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector

Float64Array = npt.NDArray[np.float64]


class DoubleLevel(CpuLevel):
    """Finest level with vector operations in double precision.

    Parameters
    ----------
    level : CpuVolumeLevel
        Finest level in single precision.
    share : float
        Ratio lambda / mu of all elements, or 1 if each element has its own lambda.
    shape : ndarray
        Constants of the elements' shape (`hexahedra.constants`), in double precision.
    """

    def __init__(self, level: Any, share: np.float64, shape: Float64Array) -> None:
        rounded = level.vector()
        super().__init__(level.grid, iter((level.inverse, *[rounded] * 3)), level.layout)
        self._memory = None
        self._level, self._tissue = level, (flat(level.lame), share)
        self._about = 0.0, shape, level.moving
        self.bodies, self.sums_up = level.bodies, level.sums_up

    def rounded(self, rest: Float64Array) -> Vector:
        """Return the residual in single precision for cycles; valid until the next call."""
        np.copyto(self.load, rest, casting="same_kind")
        return self.load

    def vector(self, values: npt.NDArray[Any] | None = None) -> Any:
        """Return a zero vector, or a copy of the given planes."""
        if self._memory is not None:
            return next(self._memory)
        return np.zeros(self.load.shape) if values is None else values.astype(np.float64)

    def free(self, *vectors: Any) -> None:
        """Discard the vectors instead of reusing them, because memory is scarce in volumes."""

    def advance_by(
        self, d: Any, share: float, rest: Any, direction: Any, image: Any, length: float
    ) -> float:
        """Add ``share * direction`` to `d`, and subtract ``length * image`` from `rest`.

        Return ``rest . rest``.
        """
        moved: float = self._level.advance_by(d, share, rest, direction, image, length)
        return moved

    def apply(self, direction: Any, image: Any) -> float:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        springs, shape, moving = self._about
        inverse, given = flat(self.inverse), (flat(direction), 0.0, self._level.layout.starts)
        about = *self._tissue, inverse, inverse, springs, None, shape, moving
        volume.rest(flat(direction), *given, *about, -1.0, flat(image), self._level.parts)
        self._level.add_data(direction, self.inverse, image)
        return self.product(direction, image)
