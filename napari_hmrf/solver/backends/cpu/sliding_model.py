"""Model of parts that slide along each other, composed of ordinary models.

The fields of all parts are on one unfolded grid (`solver.coupling`). Each part has an ordinary
model on its own box, with the precision ``k n n^T`` at its coupled sites; the coupling between two
parts adds ``-k n n^T`` between a site and its copy.

The preconditioner is a symmetric Schwarz iteration of three steps, each an ordinary cycle:

1. The parts slide: each part is corrected on its own, along fixed surfaces.
2. All tissue moves as if it were connected: the residual is folded to the image, corrected by the
   cycle of the ordinary model, and the correction is copied to all fields.
3. The parts slide again.

Any motion without gaps is the sum of a motion of the connected tissue and of motions of the parts
along their surfaces. The number of iterations therefore depends neither on the size of the image
nor on the strength k, and a step of the iteration costs about three ordinary cycles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.cpu.elastic_model import CpuElasticModel
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector
from napari_hmrf.solver.backends.host_model import HostModel
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.planes import inside, planes
from napari_hmrf.solver.backends.rigid.bodies import bodies_of
from napari_hmrf.solver.coarse_levels import smoother_bounds
from napari_hmrf.solver.coupling import Box, Coupling
from napari_hmrf.solver.data_term import DataTerm, PointTerm, packed_axes
from napari_hmrf.solver.optimizers.cycle import Cycle, smoothing_of
from napari_hmrf.solver.priors.elements import ElasticMaterial, stiffest

#: Factor on the correction of each cycle. A cycle may correct a motion by twice its error; without
#: the factor, two such corrections would cancel, and the iteration would hardly reduce the motion.
_DAMPING = 0.75
#: Stiffness that represents rigid tissue, relative to the stiffest other tissue of a part. It is
#: larger than in connected tissue, because elements at an interface have only the share of the
#: part's own sites: 400 takes half as many cycles as 40 where a body touches an interface.
_STAND_IN = 400.0

Values = npt.NDArray[Any]


class Component:
    """Ordinary model of a part or of the image, with its cycle.

    Parameters
    ----------
    model : CpuElasticModel, CpuVolumeModel or CpuFiniteModelBase
        Model of the material.
    material : ElasticMaterial
    scale : float
        Stiffness unit of this model in units of the composed model.
    """

    def __init__(self, model: Any, material: ElasticMaterial, scale: float) -> None:
        self.model, self.scale = model, scale
        self.cycle = Cycle(self.model, smoothing_of(material))
        shape = (material.m.ndim, *(size + 4 for size in material.m.shape))
        self.given, self.result = (np.zeros(shape, np.float32) for _ in range(2))
        self.exact: Planes = np.zeros(shape)

    def correction(self, steps: Steps, coarsest: Steps) -> Values:
        """Run a cycle for the load in `given`; return a view of the correction without border."""
        self.cycle.use_steps(steps, coarsest)
        load = self.given
        load *= np.float32(_DAMPING / self.scale)
        return inside(np.asarray(self.cycle.run(load)))


class PartComponent(Component):
    """Model of a part in its box of the unfolded grid."""

    def __init__(self, model: Any, material: ElasticMaterial, scale: float, box: Box) -> None:
        super().__init__(model, material, scale)
        self.box = box
        #: 1 at the free components of the part, 0 elsewhere.
        self.free: Values = np.zeros((material.m.ndim, *material.m.shape), np.float32)

    def view(self, values: Values) -> Values:
        """Return the values of this part in planes of the unfolded grid."""
        return inside(values)[(slice(None), *self.box.unfolded)]


class SlidingLevelBase(CpuLevel):
    """Finest level of a composed model; its `finish` runs the cycles of all components."""

    finishes_cycle = True

    def __init__(self, grid: tuple[int, ...], parts: Sequence[PartComponent]) -> None:
        super().__init__(grid, finest=True)
        self._parts = parts
        self._image, self._sum = self.vector(), self.vector()

    def clear(self) -> None:
        """Set all corrections to zero."""
        super().clear()
        for part in self._parts:
            part.model.clear()

    def couple(self, d: Values, out: Values, scale: float) -> None:
        """Add ``scale`` times the forces of the coupling that no part contains to `out`."""
        raise NotImplementedError

    def free_parts(self) -> None:
        """Set the free components after those of all parts have changed."""
        free = np.zeros(self.inverse.shape, np.bool_)
        for part in self._parts:
            moves = inside(part.model.moves)
            part.free[...] = moves
            part.view(free)[...] = moves
        self.inverse[...] = free

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        image.fill(0)
        self.couple(direction, image, 1.0)
        for part in self._parts:
            compute_thread.check_cancelled()
            inside(part.given)[...] = part.view(direction)
            part.model.levels[0].apply(part.given, part.result)
            view = part.view(image)
            view += np.float32(part.scale) * inside(part.result)
            view *= part.free
        return self.product(direction, image)

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Compute the correction: slide, move as connected tissue, slide."""
        total, rest = self.correction, self._image
        total.fill(0)
        self._slide(self.load, steps, coarsest)
        self._subtract_image(self.load, rest)
        self._move_together(rest, steps, coarsest)
        self._subtract_image(self.load, rest)
        self._slide(rest, steps, coarsest)

    def _subtract_image(self, load: Vector, rest: Vector) -> None:
        """Write the residual of the correction to `rest`."""
        self.apply(self.correction, self._sum)
        np.subtract(load, self._sum, out=rest)

    def _slide(self, rest: Vector, steps: Steps, coarsest: Steps) -> None:
        """Add the corrections of the parts, each along fixed surfaces."""
        for part in self._parts:
            compute_thread.check_cancelled()
            part.given.fill(0)
            inside(part.given)[...] = part.view(rest)
            view = part.view(self.correction)
            view += part.correction(steps, coarsest) * part.free

    def _move_together(self, rest: Vector, steps: Steps, coarsest: Steps) -> None:
        """Add a correction that moves the parts as if they were connected."""
        raise NotImplementedError


class SlidingLevel(SlidingLevelBase):
    """Finest level of `SlidingModel`."""

    def __init__(
        self,
        grid: tuple[int, ...],
        parts: Sequence[PartComponent],
        whole: Component,
        coupling: Coupling,
        unit: float,
    ) -> None:
        super().__init__(grid, parts)
        self._coupling, self._whole = coupling, whole
        padded = tuple(size + 4 for size in grid)
        places = []
        for sites in (coupling.first, coupling.second):
            index = np.unravel_index(sites, grid)
            places.append(np.ravel_multi_index(tuple(at + 2 for at in index), padded))
        self._first, self._second = places
        self._normals = np.ascontiguousarray(coupling.normals.T)
        self._strength = coupling.strength / unit

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components of all models."""
        for part in self._parts:
            part.model.hold(bordered(part.view(held)))
        image = self._coupling.folded(np.moveaxis(inside(held), 0, -1))
        self._whole.model.hold(bordered(np.moveaxis(image, -1, 0)))
        self.free_parts()

    def couple(self, d: Values, out: Values, scale: float) -> None:
        """Add ``scale`` times the forces between different fields to `out`, in place."""
        flat, total = d.reshape(len(d), -1), out.reshape(len(out), -1)
        for one, two in ((self._first, self._second), (self._second, self._first)):
            along = (flat[:, one] * self._normals).sum(axis=0) * self._strength
            for plane, normal in zip(total, self._normals, strict=True):
                np.add.at(plane, two, (-scale * along * normal).astype(out.dtype))

    def clear(self) -> None:
        """Set all corrections to zero."""
        super().clear()
        self._whole.model.clear()

    def _move_together(self, rest: Vector, steps: Steps, coarsest: Steps) -> None:
        """Add the correction of the connected tissue to the fields of all parts."""
        compute_thread.check_cancelled()
        whole = self._whole
        whole.given.fill(0)
        load = inside(whole.given)
        for part in self._parts:
            image = (slice(None), *part.box.image)
            load[image] += part.view(rest)
        moved = whole.correction(steps, coarsest)
        for part in self._parts:
            view = part.view(self.correction)
            view += moved[(slice(None), *part.box.image)] * part.free

    def pull(self, d: Planes, out: Planes) -> None:
        """Write the forces of tissue and coupling, -A d, to `out`, in double precision."""
        out.fill(0)
        for part in self._parts:
            part.exact.fill(0)
            inside(part.exact)[...] = part.view(d)
            part.view(out)[...] = part.scale * inside(part.model.pull(part.exact))
        self.couple(d, out, -1.0)

    def steepness(self, out: Planes) -> None:
        """Write the diagonal of A to `out`."""
        for part in self._parts:
            part.view(out)[...] = part.scale * inside(part.model.steepness)


class SlidingModel(HostModel):
    """`LinearModel` of sliding parts.

    Parameters
    ----------
    material : ElasticMaterial
        Material on the unfolded grid, with its coupling.
    """

    def __init__(self, material: ElasticMaterial) -> None:
        coupling = material.coupling
        assert coupling is not None
        self.material = material
        self.bounds = smoother_bounds(material)
        self.iterates = not coupling.nearly_free
        self._held = None
        self._sites = bodies_of(material.m) if material.rigid else None
        most, grid = stiffest(material.m), material.m.shape
        tensors = coupling.tensors() / material.unit
        data = _packed(tensors)
        if material.data is not None:
            data += inside(material.data.weights)
        parts = []
        for box in coupling.boxes:
            compute_thread.check_cancelled()
            m = _without_bodies(material.m[box.unfolded], coupling.own[box.unfolded], most)
            scale = stiffest(m) / most
            weights = data[(slice(None), *box.unfolded)] / scale
            points = points_of_part(material, box, scale)
            of_part = _material(material, m, material.poisson, box.unfolded, weights, points)
            parts.append(PartComponent(CpuElasticModel(of_part), of_part, scale, box))
        image = np.zeros((len(packed_axes(len(grid))), *coupling.stiffness.shape))
        if material.data is not None:
            own = np.moveaxis(inside(material.data.weights), 0, -1)
            image = np.moveaxis(coupling.folded(own), -1, 0)
        nu = material.poisson
        if isinstance(nu, np.ndarray):
            nu = loops.only_read(coupling.folded(nu))
        m = coupling.stiffness
        m = _without_bodies(m, np.isfinite(m), most)
        scale = stiffest(m) / most
        points = _points_of_image(material, coupling, scale)
        connected = _material(material, m, nu, (), image / scale, points)
        self._whole = Component(CpuElasticModel(connected), connected, scale)
        self._level = SlidingLevel(grid, parts, self._whole, coupling, material.unit)
        self.levels = (self._level,)
        self._rest = self._level.vector()
        self._pull: Planes = np.zeros(self._rest.shape)

    @property
    def mild(self) -> bool:
        """True if the connected tissue is mild; the iteration watches for slow motions."""
        return bool(self._whole.model.mild)

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        rest = self.pull(d)
        if load is not None:
            rest += load
        rest *= self._level.inverse
        np.copyto(self._rest, rest / unit, casting="same_kind")
        most, square = self._level.weigh(self._rest, self._rest)
        return most, math.sqrt(square)

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d at all components, in double precision; valid until the next call."""
        self._level.pull(d if low is None else d + low, self._pull)
        return self._pull

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the energy and the norm of the forces."""
        forces = self.pull(d)
        return -float((forces * d).sum()) / 2, float(np.linalg.norm(forces))

    @property
    def steepness(self) -> Planes:
        """Diagonal of the matrix, as planes."""
        out: Planes = np.zeros(self._rest.shape)
        self._level.steepness(out)
        return out

    def clear_cache(self) -> None:
        """Forget the model, because vectors of the model may contain non-finite values."""
        _model.clear()


def _packed(tensors: Planes) -> Planes:
    """Return tensors, shape (..., axes, axes), as packed values, without a border."""
    pairs = packed_axes(tensors.shape[-1])
    return np.stack([tensors[..., i, j] for i, j in pairs])


def _without_bodies(m: Values, own: npt.NDArray[np.bool_], stiffest_of_all: float) -> Values:
    """Return a stiffness in which a finite stiffness represents rigid tissue.

    The iteration of the composed model moves the bodies, so cycles need not know them.
    """
    rigid = np.isinf(m)
    if not rigid.any():
        return loops.only_read(m)
    most = float(m.max(where=own & ~rigid, initial=0.0)) or stiffest_of_all
    return loops.only_read(np.where(rigid, np.float32(_STAND_IN * most), m))


def points_of_part(material: ElasticMaterial, box: Box, scale: float) -> PointTerm | None:
    """Return the landmarks of a part on the grid of its box."""
    points = None if material.data is None else material.data.points
    if points is None:
        return None
    starts, stops = np.array([(side.start, side.stop) for side in box.unfolded]).T
    inside_box = ((points.elements >= starts) & (points.elements < stops)).all(axis=1)
    return points.on_grid(inside_box, -starts, tuple(stops - starts), scale)


def _points_of_image(
    material: ElasticMaterial, coupling: Coupling, scale: float
) -> PointTerm | None:
    """Return all landmarks on the grid of the image."""
    points = None if material.data is None else material.data.points
    if points is None:
        return None
    elements = np.ravel_multi_index(tuple(points.elements.T), coupling.own.shape)
    shape = coupling.stiffness.shape
    places = np.stack(np.unravel_index(coupling.places()[elements], shape), axis=1)
    every = np.ones(len(places), np.bool_)
    return points.on_grid(every, places - points.elements, shape, scale)


def _material(
    material: ElasticMaterial,
    m: Values,
    poisson: Any,
    at: tuple[slice, ...],
    weights: Planes,
    points: PointTerm | None,
) -> ElasticMaterial:
    """Return an ordinary material with the given stiffness and weights of the data term."""
    if isinstance(poisson, np.ndarray) and at:
        poisson = loops.only_read(poisson[at])
    data = DataTerm(planes(np.moveaxis(weights, 0, -1)), points)
    return ElasticMaterial(m, poisson, material.strain, material.shape, data)


def bordered(held: Values) -> HeldPlanes:
    """Return a mask with a border of False, two sites wide."""
    return np.pad(held, ((0, 0), *((2, 2),) * (held.ndim - 1)))


_model: Kept[SlidingModel] = Kept(is_large=True)


def the_model(material: ElasticMaterial) -> SlidingModel:
    """Return the model of a material, reusing the last model if possible.

    Call this function only on the compute thread, because all solves share the model.
    """
    return _model.get(lambda last: last.material == material, lambda: SlidingModel(material))
