"""Protocol of a model of large motion: an energy and its linearization at a displacement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.direct.sparse_factors import Links
from napari_hmrf.solver.backends.linear import Balance, HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.bodies import BodySites
from napari_hmrf.solver.backends.rigid.poses import Poses
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial


class FiniteModel(Protocol):
    """Model of tissue in large motion; all lengths are in pixels."""

    @property
    def levels(self) -> Sequence[Any]:
        """Levels (`LinearLevel`) of the linear model, finest first."""
        ...

    @property
    def bounds(self) -> tuple[float, float]:
        """Upper bounds on the spectrum, as in `LinearModel.bounds`."""
        ...

    #: Constrained components and, for these, the ratio of the true error to the error that cycles
    #: estimate; None if unknown.
    rehearsed: tuple[HeldPlanes, float] | None

    def assemble(self, material: FiniteMaterial) -> None:
        """Replace the material; the grid must stay the same."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid, (H, W)."""
        ...

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the free components of the linear model."""
        ...

    @property
    def tangents(self) -> Any:
        """Linear model as an `Assembled` material, for `direct.factors`."""
        ...

    def energy(self, d: Planes) -> tuple[float, float]:
        """Return the energy of a displacement, and the smallest Jacobian that it limits.

        The Jacobian is that of an element corner, in volumes without growth.
        """
        ...

    def least_jacobian(self, d: Planes) -> float:
        """Return the smallest Jacobian of all element corners, including growth."""
        ...

    def forces(self, d: Planes) -> Planes:
        """Return the gradient of the elastic energy, without external forces.

        The result is valid until the next call.
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
        """Assemble the linear model of small motion around a displacement.

        Parameters
        ----------
        d : ndarray, planes
            Displacement, in pixels.
        held : ndarray of bool, planes
            Mask of the constrained components.
        forces : ndarray, planes
            Gradient of the total energy. Its moments contribute to the rotational stiffness of
            rigid bodies.
        positive : float
            Fraction of the indefinite terms to leave out, from 0 to 1. If it is 1, the matrix is
            positive definite.
        springs : ndarray, planes, optional
            Values added to the diagonal.
        """
        ...

    @property
    def springs(self) -> Planes | None:
        """Values added to the diagonal of the current linear model."""
        ...

    @property
    def coupled(self) -> bool:
        """True if the tissue has sliding parts, whose connections are `links`."""
        ...

    @property
    def links(self) -> Links | None:
        """Connections between sliding parts, which `tangents` lacks; None if there are none."""
        ...

    @property
    def bodies(self) -> Sequence[BodySites]:
        """Indices of the sites of each rigid body."""
        ...

    def poses(self, held: HeldPlanes) -> Poses:
        """Return the poses of the bodies for the constrained components `held`."""
        ...

    def project(self, values: Planes) -> None:
        """Project displacements or forces onto the rigid motions of bodies, in place."""
        ...

    def balance(self, load: Planes) -> Balance:
        """Return the residual of a load, 0 at fixed components and projected for rigid bodies."""
        ...

    def image(self, way: Planes) -> Planes:
        """Return ``A @ way`` for the matrix A of the linear model; 0 at fixed components."""
        ...

    def length(
        self, d: Planes, way: Planes, part: float, floor: float, each: bool = False
    ) -> tuple[float, npt.NDArray[np.float64]]:
        """Return the largest step along `way` that satisfies limits on the corners' Jacobians.

        Parameters
        ----------
        d, way : ndarray, planes
            Displacement and search direction, in pixels.
        part : float
            Smallest allowed ratio of a corner's Jacobian after the step to its current value.
        floor : float
            Smallest Jacobian of a corner after the step. A corner that is already below must keep
            at least its current value.
        each : bool
            True to compute the largest step of each element as well.

        Returns
        -------
        float
            Largest step, as a multiple of `way`; may be infinite.
        ndarray, shape (H - 1, W - 1)
            Largest step of each element; empty unless `each` is True.
        """
        ...

    def clear(self) -> None:
        """Reset all corrections to zero, because they may contain values that are not finite."""
        ...
