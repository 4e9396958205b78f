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
    level : CpuElasticLevel
        Finest level in single precision.
    exact : tuple
        Elements for the loops in double precision (`volume_loops.exact`).
    """

    def __init__(self, level: Any, exact: tuple[Any, ...]) -> None:
        rounded = level.vector()
        memory = dict.fromkeys(("load", "correction", "other"), rounded)
        super().__init__(level.grid, True, level.layout, {"inverse": level.inverse, **memory})
        self._level, self._exact = level, exact
        self.bodies, self.sums_up = level.bodies, level.sums_up

    def rounded(self, rest: Float64Array) -> Vector:
        """Return the residual in single precision for cycles; valid until the next call."""
        np.copyto(self.load, rest, casting="same_kind")
        return self.load

    def vector(self, values: npt.NDArray[Any] | None = None) -> Any:
        """Return a zero vector, or a copy of the given planes."""
        return np.zeros(self.load.shape) if values is None else values.astype(np.float64)

    def scratch_vector(self) -> Any:
        """Return a vector that is valid until the next cycle."""
        return self.vector()

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
        level, inverse = self._level, flat(self.inverse)
        *tissue, shape = self._exact
        about = flat(direction), 0.0, level.layout.starts, *tissue, inverse, inverse, 0.0, None
        out = flat(image), level.parts
        volume.rest(flat(direction), *about, shape, level.where, -1.0, *out)
        level.add_data(direction, self.inverse, image)
        return self.product(direction, image)
