"""What the linear models of all priors have in common on the processor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from napari_hmrf.backends.linear import HeldPlanes, Planes


class CpuModel:
    """The part of `LinearModel` that is the same for all.

    Attributes
    ----------
    levels : sequence of CpuLevel
        Finest first; the finest has ``hold(held)``, the others ``hold_as(finer)``.
    """

    levels: Sequence[Any]
    _held: HeldPlanes | None
    #: What `residual` returns: 0 where held.
    _exact_rest: Planes

    def hold(self, held: HeldPlanes) -> None:
        """Hold components on all levels."""
        if self._held is not None and np.array_equal(held, self._held):
            return
        self._held = held.copy()
        self._exact_rest.fill(0)
        self.levels[0].hold(held)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            coarse.hold_as(fine)

    def close(self) -> None:
        """Nothing to do: memory goes with the last reference."""
