"""What large motion may ask of a backend: an energy, and the linear model of where tissue is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.linear import Balance, HeldPlanes, Planes


class FiniteModel(Protocol):
    """Tissue that moves far; lengths are in pixels."""

    @property
    def levels(self) -> Sequence[Any]:
        """`LinearLevel`s of the linear model, finest first."""
        ...

    @property
    def bounds(self) -> tuple[float, float]:
        """As of a `LinearModel`."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """The grid, (H, W)."""
        ...

    @property
    def moves(self) -> HeldPlanes:
        """Which components are unknown in the linear model."""
        ...

    @property
    def tangents(self) -> Any:
        """The linear model as an `Assembled` material: what factors take."""
        ...

    def energy(self, d: Planes) -> tuple[float, float]:
        """The energy of a displacement, and the least Jacobian of any corner."""
        ...

    def forces(self, d: Planes) -> Planes:
        """The derivative of the energy by all components; valid until the next call.

        Forces from outside, once there are any, are to be taken off here, and off the energy.
        """
        ...

    def linearise(self, d: Planes, held: HeldPlanes, positive: bool = False) -> None:
        """Make the linear model that of small motion around a displacement, with what is held.

        If `positive`, without directions in which the tissue buckles.
        """
        ...

    def balance(self, load: Planes) -> Balance:
        """A load, as iterations take it, 0 where nothing moves."""
        ...

    def image(self, way: Planes) -> Planes:
        """What the linear model pulls with along a way, where components move."""
        ...

    def length(
        self, d: Planes, way: Planes, part: float, floor: float, each: bool = False
    ) -> tuple[float, npt.NDArray[np.float64]]:
        """How far along a way all corners keep a part of their Jacobian, and stay above a floor.

        If `each`, also that of each element, (H - 1, W - 1).
        """
        ...

    def clear(self) -> None:
        """Make all corrections zero: numbers may have overflowed."""
        ...
