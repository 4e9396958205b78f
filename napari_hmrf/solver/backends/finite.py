"""Protocol of a model of large motion: an energy, and a linear model of the present state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.linear import Balance, HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.bodies import BodySites
from napari_hmrf.solver.backends.rigid.poses import Poses
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial


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

    #: Held components, and the factor by which cycles underestimate the error; None if unknown.
    rehearsed: tuple[HeldPlanes, float] | None

    def assemble(self, material: FiniteMaterial) -> None:
        """Take another material of the same grid."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """The grid, (H, W)."""
        ...

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the unknown components of the linear model."""
        ...

    @property
    def tangents(self) -> Any:
        """The linear model as an `Assembled` material: what factors take."""
        ...

    def energy(self, d: Planes) -> tuple[float, float]:
        """Return the energy of a displacement, and the least Jacobian of any corner."""
        ...

    def forces(self, d: Planes) -> Planes:
        """Return the derivative of the energy by all components; valid until the next call.

        Forces from outside are no business of the model's.
        """
        ...

    def linearise(
        self,
        d: Planes,
        held: HeldPlanes,
        forces: Planes,
        positive: float = 0.0,
        springs: Planes | None = None,
    ) -> None:
        """Make the linear model that of small motion around a displacement, with what is held.

        Parameters
        ----------
        d : ndarray, planes
        held : ndarray of bool, planes
        forces : ndarray, planes
            The derivative of all energy there is: it turns rigid bodies further, or back.
        positive : float
            How much of what lets tissue buckle is left out: 1 for all, and it does not.
        springs : ndarray, planes, optional
            What else resists motion of each component.
        """
        ...

    @property
    def springs(self) -> Planes | None:
        """Those that it was made with."""
        ...

    @property
    def bodies(self) -> list[BodySites]:
        """The sites of each rigid body."""
        ...

    def poses(self, held: HeldPlanes) -> Poses:
        """Return the poses of bodies, with their held components."""
        ...

    def project(self, values: Planes) -> None:
        """Replace displacements or forces by those of bodies that move as one, in place."""
        ...

    def balance(self, load: Planes) -> Balance:
        """Return a load as iterations take it: 0 where nothing moves, and of bodies as one."""
        ...

    def image(self, way: Planes) -> Planes:
        """Return the force of the linear model along a way, where components move."""
        ...

    def length(
        self, d: Planes, way: Planes, part: float, floor: float, each: bool = False
    ) -> tuple[float, npt.NDArray[np.float64]]:
        """Return how far along a way all corners keep a part of their Jacobian, above a floor.

        If `each`, also that of each element, (H - 1, W - 1).
        """
        ...

    def clear(self) -> None:
        """Make all corrections zero: numbers may have overflowed."""
        ...
