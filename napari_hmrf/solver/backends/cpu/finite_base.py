"""Part of a model of large motion on the processor that is the same for images and volumes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from napari_hmrf.solver.backends.linear import Balance, HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.bodies import BodySites
from napari_hmrf.solver.backends.rigid.poses import Poses
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial

# Factors by which the spectrum of strained tissue exceeds that at rest: usually, and at most.
_STRAINED, _WORST = 1.3, 2.0
#: Factor of the norm of an element at rest: less than 1, because elements share their sites.
CALM = 0.75


class CpuFiniteModelBase:
    """Base class of the models of large motion on the processor; see `FiniteModel`.

    Attributes
    ----------
    levels : list
        Levels of the linear model, finest first.
    material : FiniteMaterial or None
    springs : ndarray, planes, or None
        Values added to the diagonal by the last `linearise`.
    rehearsed : tuple or None
        Held components, and the factor by which cycles underestimate the error with them.
    bodies : list of tuple of ndarray
        Indices of the sites of each rigid body.
    """

    levels: Sequence[Any]
    material: FiniteMaterial | None = None
    springs: Planes | None = None
    rehearsed: tuple[HeldPlanes, float] | None = None
    bodies: Sequence[BodySites] = ()

    def _bounds(self, usual: float) -> tuple[float, float]:
        """Return the bounds of the spectrum from the usual one at rest."""
        return _STRAINED * usual, _WORST * usual

    def poses(self, held: HeldPlanes) -> Poses:
        """Return the poses of bodies, with their held components."""
        assert self.material is not None
        return Poses(self.bodies, self.material.shape.sides, held)

    def project(self, values: Planes) -> None:
        """Project displacements or forces onto the rigid motions of bodies, in place."""
        bodies = self.levels[0].bodies
        if bodies is not None:
            bodies.project(values)

    def balance(self, rest: Planes) -> Balance:
        """Return the load of an iteration: 0 at fixed components, projected for rigid bodies."""
        rest = np.where(self.levels[0].inverse > 0, rest, 0.0)
        self.project(rest)
        most = max(float(rest.max()), -float(rest.min()))
        unit = most if most > 0 else 1.0
        scaled = (rest / unit).astype(np.float32)
        square = float(np.square(scaled, dtype=np.float64).sum())
        return Balance(scaled, unit, most, unit * math.sqrt(square))

    def image(self, way: Planes) -> Planes:
        """Return A `way` of the linear model; 0 at fixed components."""
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
        """Set all corrections to zero, because they may not be finite."""
        for level in self.levels:
            level.clear()
