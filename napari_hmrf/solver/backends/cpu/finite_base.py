"""Model of large motion on the processor: the part that is the same for images and volumes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.cpu.transfer import PAD
from napari_hmrf.solver.backends.direct.sparse_factors import Links
from napari_hmrf.solver.backends.linear import Balance, HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.bodies import Bodies, BodySites, bodies_of
from napari_hmrf.solver.backends.rigid.poses import Poses
from napari_hmrf.solver.coarse_levels import smoother_bounds
from napari_hmrf.solver.data_term import DataTerm
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial

# Typical and largest ratio of the spectrum of strained tissue to that of tissue at rest.
_STRAINED, _WORST = 1.3, 2.0
#: Factor on the norm of an element at rest; less than 1 because elements share sites.
CALM = 0.75


class CpuFiniteModelBase:
    """Base class of the large-motion models on the processor; see `FiniteModel`.

    Subclasses compute the moduli and the tangents of the elements. All linear models share the
    same memory.

    Parameters
    ----------
    levels : list
        Levels of the linear model, finest first.
    has_data : bool
        True if all levels have arrays for a data term.

    Attributes
    ----------
    loops : module
        Compiled loops of the energy: `finite_strain` or `finite_bricks`.
    coarsen : callable
        Loop that computes the tangents of a level from those of the next finer level.
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

    loops: ClassVar[Any]
    coarsen: ClassVar[Any]
    bounds: tuple[float, float]
    material: FiniteMaterial | None = None
    springs: Planes | None = None
    rehearsed: tuple[HeldPlanes, float] | None = None
    bodies: Sequence[BodySites] = ()
    #: True if the model has connections between sliding parts, `links`.
    coupled: ClassVar[bool] = False
    #: Energy that no displacement changes.
    _stored = 0.0
    #: Moduli of the elements and constants of their shape, for the loops.
    _elements: tuple[Any, ...]
    #: Number of threads among which rows are divided, if the loops take it.
    _parts: tuple[int, ...] = ()

    def __init__(self, levels: Sequence[Any], has_data: bool) -> None:
        self.levels, self.shape, self.has_data = levels, tuple(levels[0].grid), has_data
        self._pull: Planes = np.zeros(levels[0].inverse.shape)
        self._energies, self._least = np.zeros((2, self.shape[0]))

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

    def set_data(self, data: DataTerm) -> None:
        """Replace the data term of the present material."""
        assert self.material is not None
        self.material = replace(self.material, data=data)
        self.levels[0].set_data(data)

    @property
    def links(self) -> Links | None:
        """Return None, because connected tissue has no connections between parts."""
        return None

    def _set_material(self, material: FiniteMaterial) -> None:
        """Compute the moduli of the elements."""
        raise NotImplementedError

    def fits(self, material: FiniteMaterial) -> bool:
        """Return whether `assemble` can reuse this model for a material."""
        same = self.shape == tuple(material.m.shape)
        return same and self.has_data == (material.data is not None)

    def energy(self, d: Planes) -> tuple[float, float]:
        """Return the energy of a displacement, and the smallest Jacobian that it limits.

        In an image, it is the smallest at any element corner; in a volume, a bound below those of
        all elements. It is the Jacobian of the elastic deformation, without growth.
        """
        return self._energy(d, *self._elements)

    def _energy(self, d: Planes, *elements: Any) -> tuple[float, float]:
        self.loops.energy(d, *elements, self._energies, self._least, *self._parts)
        return float(self._energies.sum()) + self._stored, float(self._least.min())

    def forces(self, d: Planes) -> Planes:
        """Return the gradient of the elastic energy; valid until the next call."""
        self.loops.forces(d, *self._elements, self._pull, *self._parts)
        return self._pull

    def length(
        self, d: Planes, way: Planes, part: float, floor: float, each: bool = False
    ) -> tuple[float, npt.NDArray[np.float64]]:
        """Return the largest step along `way` that leaves no element folded; see `FiniteModel`."""
        axes = len(self.shape)
        lengths = np.full(d.shape[1:], np.inf) if each else np.zeros((0,) * axes)
        about = d, way, *self._elements[:2], part, floor, self._least
        self.loops.length(*about, lengths, *self._parts)
        elements = (slice(PAD, -PAD - 1),) * axes
        return float(self._least.min()), lengths[elements] if each else lengths

    def linearise(
        self,
        d: Planes,
        held: HeldPlanes,
        forces: Planes,
        positive: float = 0.0,
        springs: Planes | None = None,
    ) -> None:
        """Build the linear model of small motion around a displacement; see `FiniteModel`."""
        self.springs = springs
        self._write_tangents(d, positive)
        if self.bodies:
            assert self.material is not None
            self.levels[0].bodies = Bodies(self.bodies, self.material, held, d)
            self._stiffen_bodies(d, forces, positive)
        self._coarsen_tangents()
        self._hold(held, springs)

    def _write_tangents(self, d: Planes, positive: float) -> None:
        """Write the tangents of the finest level."""
        raise NotImplementedError

    def _stiffen_bodies(self, d: Planes, forces: Planes, positive: float) -> None:
        """Add the rotational stiffness of bodies; by default, only their sites' own is used."""

    def _coarsen_tangents(self) -> None:
        for fine, coarse in pairwise(self.levels):
            self.coarsen(fine.tangent, coarse.tangent)

    def _hold(self, held: HeldPlanes, springs: Planes | None) -> None:
        """Set the constraints, the springs and the data term of a new linear model."""
        pairs = list(pairwise(self.levels))
        if self.has_data:
            for fine, coarse in pairs:
                fine.coarsen_data(coarse)
        self.levels[0].hold_with_springs(held, springs)
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


_model: Kept[CpuFiniteModelBase] = Kept(is_large=True)


def the_model(material: FiniteMaterial, kind: Any) -> Any:
    """Return the model of a material, in the memory of the last model if the grid is the same.

    Parameters
    ----------
    material : FiniteMaterial
    kind : type
        Class of the model: `CpuFiniteModel` or `CpuFiniteVolumeModel`.
    """
    grid, has_data = tuple(material.m.shape), material.data is not None
    model = _model.get(lambda last: last.fits(material), lambda: kind(grid, has_data))
    model.assemble(material)
    return model
