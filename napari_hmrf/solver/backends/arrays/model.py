"""Base class of the NumPy models."""

from __future__ import annotations

from typing import Any

import numpy as np

from napari_hmrf.solver.backends.earlier_results import EarlierResults
from napari_hmrf.solver.backends.host_model import HostModel
from napari_hmrf.solver.backends.linear import Planes


class ArrayModel(HostModel):
    """NumPy implementation of the host's part of `LinearModel`; subclasses compute the forces.

    Parameters
    ----------
    material : Any
        Material of the model: an `Assembled` material.
    """

    def __init__(self, material: Any) -> None:
        self.material, self._held, self.earlier = material, None, EarlierResults()

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d at all components, in double precision."""
        raise NotImplementedError

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        rest = self.pull(d) if load is None else self.pull(d) + load
        rest[~self.moves] = 0
        rest /= unit
        self._rest[...] = rest
        return float(np.abs(rest).max()), float(np.linalg.norm(rest))
