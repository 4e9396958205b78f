"""Part of a model of large motion on the processor that is the same for images and volumes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from napari_hmrf.solver.backends.linear import Balance, HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.bodies import BodySites, bodies_of
from napari_hmrf.solver.backends.rigid.poses import Poses
from napari_hmrf.solver.coarse_levels import smoother_bounds
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial

# Typical and largest ratio of the spectrum of strained tissue to that of tissue at rest.
_STRAINED, _WORST = 1.3, 2.0
#: Factor on the norm of an element at rest; less than 1 because elements share sites.
CALM = 0.75


class CpuFiniteModelBase:
    """Base class of the large-motion models on the processor; see `FiniteModel`.

    Attributes
    ----------
    levels : list
        Levels of the linear model, finest first.
    bounds : (float, float)
        Upper bounds on the spectrum, as in `LinearModel.bounds`.
    material : FiniteMaterial or None
        Present material.
    springs : ndarray, planes, or None
        Values that the last call of `linearise` added to the diagonal.
    shape : tuple of int
        Grid, (H, W) or (D, H, W).
    has_data : bool
        True if all levels have arrays for a data term.
    rehearsed : tuple or None
        Prescribed components, and the ratio of the true error to the error that cycles estimate.
    bodies : list of tuple of ndarray
        Indices of the sites of each rigid body.
    """

    levels: Sequence[Any]
    bounds: tuple[float, float]
    material: FiniteMaterial | None = None
    springs: Planes | None = None
    shape: tuple[int, ...] = ()
    has_data: bool = False
    rehearsed: tuple[HeldPlanes, float] | None = None
    bodies: Sequence[BodySites] = ()

    def assemble(self, material: FiniteMaterial) -> None:
        """Replace the material with another material on the same grid."""
        if self.material is not None and self.material == material:
            return
        if self.material is None or not self.material.is_tissue_of(material):
            self.rehearsed = None
        self.material = material
        usual, _ = smoother_bounds(material)
        self.bounds = _STRAINED * usual, _WORST * usual
        self.bodies = bodies_of(material.m) if material.rigid else []
        self.levels[0].bodies = None
        self._set_material(material)
        if material.data is not None:
            self.levels[0].set_data(material.data)

    def _set_material(self, material: FiniteMaterial) -> None:
        """Compute the moduli of the elements."""
        raise NotImplementedError

    def fits(self, material: FiniteMaterial) -> bool:
        """Return whether `assemble` can reuse this model for a material."""
        same = self.shape == tuple(material.m.shape)
        return same and self.has_data == (material.data is not None)

    def _hold(self, held: HeldPlanes, springs: Planes | None) -> None:
        """Set the constraints, the springs and the data term of a new linear model."""
        pairs = list(pairwise(self.levels))
        if self.has_data:
            for fine, coarse in pairs:
                fine.coarsen_data(coarse)
        self.levels[0].hold(held, springs)
        for fine, coarse in pairs:
            coarse.hold_as(fine)
        for level in self.levels:
            level.start_cycles()

    def poses(self, held: HeldPlanes) -> Poses:
        """Return the poses of the bodies with their prescribed components."""
        assert self.material is not None
        return Poses(self.bodies, self.material.shape.sides, held)

    def project(self, values: Planes) -> None:
        """Project displacements or forces onto the rigid motions of bodies, in place."""
        bodies = self.levels[0].bodies
        if bodies is not None:
            bodies.project(values)

    def balance(self, rest: Planes) -> Balance:
        """Return the residual as the load of an iteration.

        It is 0 at fixed components and projected onto the rigid motions of bodies.
        """
        rest = np.where(self.levels[0].inverse > 0, rest, 0.0)
        self.project(rest)
        most = max(float(rest.max()), -float(rest.min()))
        unit = most if most > 0 else 1.0
        rest /= unit
        scaled = rest.astype(np.float32)
        square = float(np.einsum("i,i->", scaled.ravel(), scaled.ravel(), dtype=np.float64))
        return Balance(scaled, unit, most, unit * math.sqrt(square))

    def image(self, way: Planes) -> Planes:
        """Return ``A @ way`` for the linear model, or 0 at fixed components."""
        finest = self.levels[0]
        image = finest.vector()
        finest.apply(way.astype(np.float32), image)
        made: Planes = image.astype(np.float64)
        finest.free(image)
        return made

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the unknown components of the linear model."""
        moves: HeldPlanes = self.levels[0].inverse > 0
        return moves

    def clear(self) -> None:
        """Set all corrections to zero, because they may contain non-finite values."""
        for level in self.levels:
            level.clear()
