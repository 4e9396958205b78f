"""Large-motion model of parts that slide along each other, composed of ordinary models.

Each part has an ordinary large-motion model on its own box of the unfolded grid, and the energy is
the sum of their energies and that of the contact (`solver.contact`). The linear model is composed
and preconditioned as that of small motion (`sliding_model`), except that parts that touch move
together wherever they have slid (`contact_corrections`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.field.neighbours import corner_slices
from napari_hmrf.solver.backends.cpu.contact_corrections import (
    Elements,
    Everywhere,
    NearContact,
    corrections,
)
from napari_hmrf.solver.backends.cpu.finite_base import CpuFiniteModelBase
from napari_hmrf.solver.backends.cpu.finite_model import CpuFiniteModel
from napari_hmrf.solver.backends.cpu.finite_volume_model import CpuFiniteVolumeModel
from napari_hmrf.solver.backends.cpu.level import Vector
from napari_hmrf.solver.backends.cpu.sliding_model import (
    PartComponent,
    SlidingLevelBase,
    bordered,
    points_of_part,
)
from napari_hmrf.solver.backends.direct.sparse_factors import Links
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.planes import inside, planes
from napari_hmrf.solver.contact import Contact
from napari_hmrf.solver.coupling import Box
from napari_hmrf.solver.data_term import DataTerm, packed_axes
from napari_hmrf.solver.priors.elements import stiffest
from napari_hmrf.solver.priors.finite_strain import FiniteMaterial

Index = tuple[slice, ...]

#: Largest change of the displacement, in pixels, after which corrections of parts that touch are
#: used again. They only precondition the linear system.
_REUSED = 0.01
#: Number of elements that are assembled together, to limit the memory.
_TOGETHER = 5000


class _Part(PartComponent):
    """Model of a part, with its own data term."""

    def __init__(self, model: Any, material: FiniteMaterial, scale: float, box: Box) -> None:
        super().__init__(model, material, scale, box)
        assert material.data is not None
        self._data = material.data
        #: Displacement of the linear model, and a step.
        self.state: Planes = np.zeros(self.exact.shape)
        self.way: Planes = np.zeros(self.exact.shape)

    def at(self, d: Planes) -> Planes:
        """Return the displacement of this part; valid until the next call."""
        inside(self.exact)[...] = self.view(d)
        return self.exact

    def add_contact(self, tensors: Planes) -> None:
        """Set the data term to that of the part, plus tensors of the unfolded grid."""
        weights = self._data.weights.copy()
        weights_inside = inside(weights)
        weights_inside += tensors[(slice(None), *self.box.unfolded)] / self.scale
        self.model.set_data(self._data._replace(weights=weights))


class FiniteSlidingLevel(SlidingLevelBase):
    """Finest level of `CpuFiniteSlidingModel`."""

    #: Contact of the parts, with its second derivatives.
    contact: Contact
    #: Corrections that move all parts together: everywhere, and near the contact.
    together: tuple[NearContact, Everywhere]

    def set_data(self, data: DataTerm) -> None:
        """Ignore the call, because each part has the data of its sites."""

    def free_parts(self) -> None:
        """Set the free components, where `inverse` is that of the diagonal of each part."""
        super().free_parts()
        for part in self._parts:
            part.view(self.inverse)[...] = inside(part.model.levels[0].inverse) / part.scale

    def _move_together(self, rest: Vector, steps: Steps, coarsest: Steps) -> None:
        """Add the corrections of parts that touch."""
        correction, (near, everywhere) = inside(self.correction), self.together
        correction += near.correction(inside(rest))
        self._subtract_image(self.load, rest)
        correction += everywhere.correction(inside(rest))
        self._subtract_image(self.load, rest)
        correction += near.correction(inside(rest))

    def couple(self, d: npt.NDArray[Any], out: npt.NDArray[Any], scale: float) -> None:
        """Add ``scale`` times the forces of the contact that no part contains to `out`."""
        self.contact.add_image(d, out, scale)


class CpuFiniteSlidingModel(CpuFiniteModelBase):
    """`FiniteModel` of sliding parts, on their unfolded grid.

    Parameters
    ----------
    material : FiniteMaterial
        Material of the unfolded grid, with its coupling.
    """

    coupled = True

    def __init__(self, material: FiniteMaterial) -> None:
        coupling = material.coupling
        assert coupling is not None
        self._coupling, self.shape = coupling, tuple(material.m.shape)
        self._contact = Contact(coupling, material.m, material.shape.sides, material.unit)
        most = stiffest(material.m)
        self._of_parts = []
        for box in coupling.boxes:
            compute_thread.check_cancelled()
            scale = stiffest(material.m[box.unfolded]) / most
            part = _material_of_part(material, box, scale)
            self._of_parts.append(_Part(_ordinary_model(part), part, scale, box))
        level = FiniteSlidingLevel(self.shape, self._of_parts)
        level.contact = self._contact
        self.levels = (level,)
        #: Displacement, free components and fraction of left-out terms of the last corrections.
        self._corrected: tuple[Planes, HeldPlanes, float] | None = None
        self._pull: Planes = np.zeros(level.correction.shape)
        self.assemble(material)

    def _set_material(self, material: FiniteMaterial) -> None:
        self._corrected = None
        for part in self._of_parts:
            part.model.assemble(_material_of_part(material, part.box, part.scale))

    def fits(self, material: FiniteMaterial) -> bool:
        """Return whether `assemble` can reuse this model for a material."""
        return self.material is not None and self.material.is_tissue_of(material)

    def energy(self, d: Planes) -> tuple[float, float]:
        """Return the energy of a displacement, and the smallest Jacobian that it limits."""
        total, least = self._contact.energy(d), math.inf
        for part in self._of_parts:
            energy, jacobian = part.model.energy(part.at(d))
            total, least = total + part.scale * energy, min(least, jacobian)
        return total, least if math.isfinite(total) else min(least, 0.0)

    def least_jacobian(self, d: Planes) -> float:
        """Return the smallest Jacobian of all element corners, including growth."""
        return float(min(part.model.least_jacobian(part.at(d)) for part in self._of_parts))

    def forces(self, d: Planes) -> Planes:
        """Return the gradient of the energy; valid until the next call."""
        self._pull.fill(0)
        for part in self._of_parts:
            part.view(self._pull)[...] = part.scale * inside(part.model.forces(part.at(d)))
        self._contact.add_forces(d, self._pull)
        return self._pull

    def linearise(
        self,
        d: Planes,
        held: HeldPlanes,
        forces: Planes,
        positive: float = 0.0,
        springs: Planes | None = None,
    ) -> None:
        """Build the linear model at a displacement; see `FiniteModel`. There are no springs."""
        assert springs is None
        self._contact.linearise(d, positive)
        tensors = self._contact.tensors()
        for part in self._of_parts:
            compute_thread.check_cancelled()
            np.copyto(part.state, part.at(d))
            part.add_contact(tensors)
            part.model.linearise(part.state, bordered(part.view(held)), part.way, positive)
        level = self.levels[0]
        level.free_parts()
        if self._corrected is not None:
            at, moves, share = self._corrected
            moved = float(np.abs(d - at).max())
            if moved <= _REUSED and share == positive and np.array_equal(moves, self.moves):
                return
        tissue = self._pieces()
        level.together = corrections(self._positions(), self.moves, tissue, self._contact)
        self._corrected = d.copy(), self.moves, positive

    def length(
        self, d: Planes, way: Planes, part: float, floor: float, each: bool = False
    ) -> tuple[float, npt.NDArray[np.float64]]:
        """Return the largest step along `way` with valid Jacobians; see `FiniteModel`."""
        least = math.inf
        lengths = np.full(tuple(size - 1 for size in self.shape), np.inf) if each else np.zeros(0)
        for one in self._of_parts:
            inside(one.way)[...] = one.view(way)
            length, own = one.model.length(one.at(d), one.way, part, floor, each)
            least = min(least, length)
            if each:
                lengths[_between(one.box.unfolded)] = own
        return least, lengths

    @property
    def tangents(self) -> _Matrices:
        """Linear model as an `Assembled` material, without `links`."""
        return _Matrices(self._matrices())

    def _positions(self) -> npt.NDArray[np.float64]:
        """Return the position of each site of the unfolded grid in the deformed image, in sites."""
        shape = self._coupling.stiffness.shape
        at = np.stack(np.unravel_index(self._coupling.places(), shape)).astype(np.float64)
        at = at.reshape(-1, *self.shape)
        sides = np.array(self.material.shape.sides)  # type: ignore[union-attr]
        for part in self._of_parts:
            moved = inside(part.state) / sides.reshape(-1, *(1,) * len(shape))
            at[(slice(None), *part.box.unfolded)] += moved
        return at

    def _pieces(self) -> Iterator[Elements]:
        """Yield all elements of the linear model, a few slabs of a part at a time."""
        axes = len(self.shape)
        sites = np.arange(math.prod(self.shape)).reshape(self.shape)
        for part in self._of_parts:
            ((_, matrices),) = part.model.tangents.parts
            sides = tuple(side.stop - side.start - 1 for side in part.box.unfolded)
            across = [slice(0, side) for side in sides[1:]]
            step = max(1, _TOGETHER // max(1, math.prod(sides[1:])))
            for first in range(0, sides[0], step):
                last = min(first + step, sides[0])
                made = part.scale * matrices(slice(first, last), *across)
                near = sites[part.box.unfolded][first : last + 1]
                corners = np.stack([near[at] for at in corner_slices(made.shape[:-2])], axis=-1)
                places = (corners[..., None] * axes + np.arange(axes)).reshape(made.shape[:-1])
                is_real = np.diagonal(made, axis1=-2, axis2=-1).any(axis=-1)
                yield Elements(places[is_real], made[is_real])

    def _matrices(self) -> npt.NDArray[np.float64]:
        """Return the matrices of all elements of the linear model."""
        count = 2 ** len(self.shape) * len(self.shape)
        made = np.zeros((*(size - 1 for size in self.shape), count, count))
        for part in self._of_parts:
            elements = tuple(slice(0, side.stop - side.start - 1) for side in part.box.unfolded)
            ((_, matrices),) = part.model.tangents.parts
            made[_between(part.box.unfolded)] = part.scale * matrices(*elements)
        return made

    @property
    def links(self) -> Links:
        """Connections of the parts in the linear model, for direct factorizations."""
        # Sites in contact are at the same place of the deformed image.
        shape = self._coupling.stiffness.shape
        at = self._positions().reshape(len(shape), -1)
        places = np.clip(np.rint(at).astype(np.intp), 0, np.array(shape)[:, None] - 1)
        return Links(self._contact.matrix(), shape, np.ravel_multi_index(tuple(places), shape))


class _Matrices:
    """Matrices of all elements of the unfolded grid as an `Assembled` material."""

    patch = 2
    margin = 0
    symmetric = True

    def __init__(self, matrices: npt.NDArray[np.float64]) -> None:
        self._matrices = matrices

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], Any], ...]:
        """Single part with all components, and the function that returns its matrices."""
        axes = tuple(range(self._matrices.ndim - 2))
        return ((axes, lambda *elements: self._matrices[elements]),)


def _between(sites: Index) -> Index:
    """Return the elements between some sites."""
    return tuple(slice(side.start, side.stop - 1) for side in sites)


def _ordinary_model(material: FiniteMaterial) -> CpuFiniteModel | CpuFiniteVolumeModel:
    """Return a new model of a material without sliding parts."""
    make = CpuFiniteVolumeModel if material.m.ndim == 3 else CpuFiniteModel
    model = make(tuple(material.m.shape), has_data=True)
    model.assemble(material)
    return model


def _material_of_part(material: FiniteMaterial, box: Box, scale: float) -> FiniteMaterial:
    """Return the ordinary material of a part, with its data term and its growth."""
    at = box.unfolded
    weights = np.zeros((len(packed_axes(material.m.ndim)), *material.m[at].shape))
    if material.data is not None:
        weights += inside(material.data.weights)[(slice(None), *at)] / scale
    nu, growth = material.poisson, material.growth
    return replace(
        material,
        m=loops.only_read(material.m[at]),
        poisson=loops.only_read(nu[at]) if isinstance(nu, np.ndarray) else nu,
        data=DataTerm(planes(np.moveaxis(weights, 0, -1)), points_of_part(material, box, scale)),
        coupling=None,
        growth=None if growth is None else loops.only_read(growth[at]),
    )


_model: Kept[CpuFiniteSlidingModel] = Kept(is_large=True)


def the_model(material: FiniteMaterial) -> CpuFiniteSlidingModel:
    """Return the model of a material, which is the last model if the tissue is the same."""
    model = _model.get(lambda last: last.fits(material), lambda: CpuFiniteSlidingModel(material))
    model.assemble(material)
    return model
