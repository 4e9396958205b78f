"""Model of elastic volumes on the processor: levels, and forces in double precision."""

from __future__ import annotations

import math
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.base import BATCH_SECONDS
from napari_hmrf.solver.backends.cpu import hexahedra, volume, volume_transfer
from napari_hmrf.solver.backends.cpu.double_level import DoubleLevel
from napari_hmrf.solver.backends.cpu.layout import (
    Layout,
    Table,
    Values,
    flat,
    whole_starts,
)
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector, paces_of, rows
from napari_hmrf.solver.backends.cpu.transfer import PAD, padded
from napari_hmrf.solver.backends.host_model import HostModel
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.rigid.bodies import bodies_of
from napari_hmrf.solver.coarse_levels import grids, smoother_bounds
from napari_hmrf.solver.priors.elements import (
    CYCLE_STAND_IN,
    ElasticMaterial,
    lame_ratio,
    stiffest,
)

# Approximate time of a smoothing step for one site on one thread, in seconds.
_SITE_SECONDS = 20e-9


class VolumeLevel(CpuLevel):
    """Base class of the levels of a volume, which use little memory.

    Parameters
    ----------
    grid : tuple of int
        Grid of the level, (D, H, W).
    finest : bool
        True for the finest level, which has no springs at first.
    layout : Layout, optional
        Layout of all vectors of the level; by default, that of planes.

    Attributes
    ----------
    reach : ndarray, shape (D + 4, H + 4, 2)
        Start and stop column of the moving sites in each padded row.
    shape : ndarray
        Constants of the kernels for the shape of a voxel.
    """

    sums_up = True

    def __init__(self, grid: tuple[int, ...], finest: bool, layout: Layout | None = None) -> None:
        super().__init__(grid, layout=layout)
        self.weight = None if finest else self.vector()
        depth, height = (size + 2 * PAD for size in grid[:2])
        self.reach: npt.NDArray[np.int64] = np.zeros((depth, height, 2), dtype=np.int64)
        self.spans = self.reach.reshape(-1, 2)[PAD:-PAD]
        self.shape: Vector = np.zeros(0, dtype=np.float32)

    @property
    def pins(self) -> Vector:  # type: ignore[override]
        """Pins for the next coarser level, which reads them only once.

        The pins share memory with a correction, so `clear` must be called afterwards.
        """
        return self._other

    def scratch_vector(self) -> Vector:
        """Return a vector that is in use only during cycles, to save memory."""
        return self._other

    def free(self, *vectors: Vector) -> None:
        """Discard the vectors instead of reusing them, because memory is scarce in volumes."""

    def _restrict(self, forces: Vector, coarse: Self, out: Vector) -> None:
        volume_transfer.restrict_planes(forces, out)

    def _interpolate(self, coarse: Self) -> None:
        volume_transfer.interpolate_planes(coarse.correction, self.correction, self.inverse)

    def _add_relaxed(self, coarse: Self, out: Vector) -> None:
        assert self.weight is not None
        assert self.mixed is not None
        springs = map(flat, (self.inverse, self.weight, self.mixed))
        vectors = self._with_tables(coarse.correction, coarse, out)
        volume.add_relaxed(*vectors, *springs, self.reach)

    def _with_tables(self, of_coarse: Vector, coarse: Self, of_fine: Vector) -> tuple[Values, ...]:
        """Return vectors of the next coarser level and of this level, each with its table."""
        return flat(of_coarse), coarse.layout.starts, flat(of_fine), self.layout.starts


class CpuVolumeLevel(VolumeLevel):
    """Level of an elastic volume with its elements and springs.

    Parameters
    ----------
    grid : tuple of int
        Grid of the level, (D, H, W).
    layout : Layout
        Layout of all vectors of the level.
    finest : bool
        True for the finest level.
    has_data : bool
        True if the problem has a data term; the layout must then be that of planes.

    Attributes
    ----------
    lame : ndarray, shape (1 or 2, *layout.shape)
        Parameters mu, or mu and lambda, of the elements; 0 in void.
    share : float
        Ratio lambda / mu of all elements, or 1 if each element has its own lambda.
    """

    lame: Vector

    def __init__(self, grid: tuple[int, ...], layout: Layout, finest: bool, has_data: bool) -> None:
        super().__init__(grid, finest, layout)
        self._totals: npt.NDArray[np.float64] = np.zeros(grid[0])
        if has_data:
            self.data, self.mixed = padded(6, grid), padded(6, grid)
            self.weight = self.vector() if self.weight is None else self.weight
        #: Number of threads among which the planes are divided.
        self.parts = volume.parts(grid[0])
        #: Number of smoothing steps between two checks for cancellation.
        self._at_once = max(1, int(BATCH_SECONDS / (_SITE_SECONDS * math.prod(grid))))
        self.share = np.float32(1)

    @property
    def places(self) -> tuple[Table, Table, int]:
        """Table of rows, spans of the tissue and width of a padded plane, for the kernels."""
        return self.layout.starts, self.layout.tissue, self.layout.planes[2]

    @property
    def moving(self) -> tuple[Table, Table, int]:
        """The same with the spans of the sites that move."""
        return self.layout.starts, self.reach, self.layout.planes[2]

    def write_diagonal(self) -> None:
        """Write the diagonal of the stiffness matrix to `inverse`."""
        volume.diagonal(
            flat(self.lame), self.share, self.shape, *self.places[:2], flat(self.inverse)
        )

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components of the finest level."""
        # The operating system allocates new memory at the first write, which is slow. Fill the
        # arrays one by one first, so that the solve can be cancelled between two arrays.
        self.clear()
        for component in self.inverse:
            component.fill(0)
            compute_thread.check_cancelled()
        self.write_diagonal()
        compute_thread.check_cancelled()
        self._hold(held, self.inverse, self.spans)
        self._hold_data()

    def hold_as(self, finer: CpuVolumeLevel) -> None:
        """Set the springs of sites near prescribed sites of the next finer level."""
        self.write_diagonal()
        self._set_springs(finer)

    def relax(self, steps: Steps, from_zero: bool) -> None:
        """Run Chebyshev-Jacobi steps on `correction` for `load`."""
        if self.point_smoother is not None:
            self._relax_with_data(steps, from_zero)
            return
        paces = paces_of(steps, from_zero)
        if from_zero:
            load, inverse, correction = map(rows, (self.load, self.inverse, self.correction))
            mixed = None if self.mixed is None else rows(self.mixed)
            volume.start(load, inverse, mixed, correction, paces[0, 0])
            paces = paces[1:]
        for begin in range(0, len(paces), self._at_once):
            some = paces[begin : begin + self._at_once]
            self._smooth_by(some)
            if len(some) % 2 == 1:
                self.correction, self._other = self._other, self.correction
            compute_thread.check_cancelled()

    def _smooth_by(self, paces: Vector) -> None:
        """Run Chebyshev steps from `correction`, alternating between it and `_other`."""
        d, other, load = map(flat, (self.correction, self._other, self.load))
        volume.smooth.in_turns(
            len(paces), d, other, load, *self._about, self.moving, paces, self.parts
        )

    @property
    def _about(self) -> tuple[Any, ...]:
        """Tissue and springs, for the kernels."""
        weight, springs = self._springs
        mixed = None if self.mixed is None else flat(self.mixed)
        tissue = flat(self.lame), self.share, flat(self.inverse)
        return *tissue, flat(weight), springs, mixed, self.shape

    def _step_simply(self, pace: Vector) -> None:
        self._smooth_by(pace[None])

    def _restrict_residual(self, coarse: CpuVolumeLevel) -> None:
        if self.point_smoother is not None:
            self._restrict_with_data(coarse)
            return
        # `_other` can store the residual: the next step has no momentum and does not read `_other`.
        if self.mixed is None:
            self._rest_of(self.correction, self.load, np.float32(1), np.float32(1), self._other)
        else:
            lame, share, inverse, weight, _, mixed, shape = self._about
            about = lame, share, inverse, weight, mixed, shape, self.moving
            d, load, out = map(flat, (self.correction, self.load, self._other))
            volume.filtered_rest(d, load, *about, out, self.parts)
        self._restrict(self._other, coarse, coarse.load)

    def _restrict(self, forces: Vector, coarse: Self, out: Vector) -> None:
        volume_transfer.restrict(forces, self.layout, out, coarse.layout)

    def _interpolate(self, coarse: Self) -> None:
        vectors = self._with_tables(coarse.correction, coarse, self.correction)
        volume.interpolate(*vectors, flat(self.inverse), self.reach)

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        self._rest_of(direction, direction, np.float32(0), np.float32(-1), image)
        self.add_points(direction, self.inverse, image)  # the loop has added the precision
        return self.product(direction, image)

    def _rest_of(
        self, d: Vector, load: Vector, given: np.float32, scale: np.float32, out: Vector
    ) -> None:
        vectors = flat(d), flat(load), given, self.layout.starts
        volume.rest(*vectors, *self._about, self.moving, scale, flat(out), self.parts)

    def advance_by(
        self, d: Any, share: float, rest: Vector, direction: Vector, image: Vector, length: float
    ) -> float:
        """Add ``share * direction`` to `d`, and subtract ``length * image`` from `rest`.

        Return ``rest . rest``. In all layouts, `d` consists of planes.
        """
        starts, tissue, _ = self.places
        of_d, *others = map(flat, (d, rest, direction, image))
        shares = d.dtype.type(share), rest.dtype.type(length)
        table = whole_starts(self.layout.planes)
        about = *others, shares[1], starts, tissue, self._totals
        volume.advance(of_d, table, shares[0], *about)
        return float(self._totals.sum())

    def coarsen_data(self, coarse: CpuVolumeLevel) -> None:
        """Compute the tensors of the data term on the next coarser level."""
        self.write_diagonal()
        self._restrict_data(coarse)


class CpuVolumeModel(HostModel):
    """`LinearModel` of an elastic volume.

    Parameters
    ----------
    material : ElasticMaterial
        Material on the finest grid.
    """

    def __init__(self, material: ElasticMaterial) -> None:
        self.levels: list[CpuVolumeLevel] = []
        self._rest: Vector = np.zeros(0, dtype=np.float32)
        self.assemble(material)

    def assemble(self, material: ElasticMaterial) -> None:
        """Replace the material with one that has the same grid and number of parameters."""
        self.material = material
        self.bounds = smoother_bounds(material)
        self._held = self.bodies = None
        constants = hexahedra.constants(material.shape)
        m, nu, most = material.m, material.poisson, stiffest(material.m)
        self._sites = bodies_of(m) if material.rigid else None
        if material.rigid:
            m = np.where(np.isinf(m), np.float32(CYCLE_STAND_IN * most), m)
        m, scale, share = loops.only_read(m), 0.125 / most, 1.0
        lame = padded(1 if isinstance(nu, float) else 2, m.shape)
        if isinstance(nu, float):
            share = lame_ratio(nu, strain=True)
            volume.elements(m, m, True, scale / (2 + 2 * nu), lame)
        else:
            volume.elements(m, loops.only_read(nu), False, scale, lame)
        compute_thread.check_cancelled()
        self._set_levels(lame)
        for level in self.levels:
            level.shape, level.share = constants.astype(np.float32), np.float32(share)
        finest = self.levels[0]
        finest.bodies = None
        if material.data is not None:
            finest.write_diagonal()
            finest.set_data(material.data)
            for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
                compute_thread.check_cancelled()
                fine.coarsen_data(coarse)
        self._exact: tuple[Any, ...] = np.float64(share), constants

    def _set_levels(self, lame: Vector) -> None:
        """Set the elements of all levels; reuse the memory of levels with the same layout."""
        has_data = self.material.data is not None
        # The data term, its landmarks and rigid bodies find their sites in planes.
        whole = has_data or self.material.rigid
        for number, grid in enumerate(grids(self.material.m.shape)):
            if number > 0:
                fine, lame = lame, padded(len(lame), grid)
                volume.coarsen(fine, lame)
            layout = Layout.of_tissue(lame[0], whole)
            if number < len(self.levels) and not self.levels[number].layout.matches(layout):
                del self.levels[number:]  # free their memory before new levels are allocated
            if number == len(self.levels):
                self.levels.append(CpuVolumeLevel(grid, layout, number == 0, has_data))
            level = self.levels[number]
            level.lame = layout.packed(lame)
        if self._rest.shape != self.levels[0].inverse.shape:
            self._rest = self.levels[0].vector()

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the free components of the finest level."""
        moves: HeldPlanes = self.levels[0].planes(self.levels[0].inverse) > 0
        return moves

    def _begin(self) -> None:
        self.clear()

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        finest, (share, shape) = self.levels[0], self._exact
        if finest.points is not None:
            load = np.zeros(d.shape) if load is None else load.copy()
            finest.add_points(d, None, load, -1.0)
        given = (flat(d), 0.0) if load is None else (flat(load), 1.0)
        data, inverse = finest.exact_data, flat(finest.inverse)
        weights = (inverse, 0.0, None) if data is None else (flat(data[:3]), 1.0, flat(data[3:]))
        about = flat(finest.lame), share, inverse, *weights, shape, finest.moving
        vectors = flat(d), *given, whole_starts(d.shape[1:])
        volume.rest(*vectors, *about, 1 / unit, flat(self._rest), finest.parts)
        most, square = finest.weigh(self._rest, self._rest)
        return most, math.sqrt(square)

    @property
    def double_level(self) -> DoubleLevel:
        """Finest level for an iteration in double precision."""
        return DoubleLevel(self.levels[0], *self._exact)

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d at all components, in double precision."""
        finest, out = self.levels[0], np.zeros(d.shape)
        exactly = d if low is None else d + low
        about = whole_starts(d.shape[1:]), flat(finest.lame), *self._exact, finest.places
        volume.pull(flat(exactly), *about, flat(out), finest.parts)
        finest.add_data(exactly, None, out, -1.0)
        return out

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the elastic energy and the norm of the forces."""
        finest, (share, shape) = self.levels[0], self._exact
        products, squares = np.zeros((2, self.shape[0]))
        data = None if finest.exact_data is None else flat(finest.exact_data)
        about = whole_starts(d.shape[1:]), flat(finest.lame), share, data, shape, finest.places
        volume.work(flat(d), *about, products, squares, finest.parts)
        if finest.points is not None:
            forces = self.pull(d)
            return -float((forces * d).sum()) / 2, float(np.linalg.norm(forces))
        return float(products.sum()) / 2, math.sqrt(squares.sum())

    @property
    def steepness(self) -> Planes:
        """Diagonal of the stiffness matrix, as planes."""
        finest = self.levels[0]
        out, (starts, tissue, _) = finest.vector(), finest.places
        volume.diagonal(flat(finest.lame), finest.share, finest.shape, starts, tissue, flat(out))
        steepness = finest.planes(out).astype(np.float64)
        if self.material.data is not None:
            self.material.data.add_diagonal(steepness)
        return steepness

    def clear_cache(self) -> None:
        """Forget the model, because vectors of the model may contain non-finite values."""
        _model.clear()


_model: Kept[CpuVolumeModel] = Kept(is_large=True)


def the_model(material: ElasticMaterial) -> CpuVolumeModel:
    """Return the model of a material, reusing the last model if possible.

    Call this function only on the compute thread, because all solves share the model.
    """

    def layout(each: ElasticMaterial) -> tuple[Any, ...]:
        return each.m.shape, isinstance(each.poisson, float), each.data is not None

    model = _model.get(
        lambda last: layout(last.material) == layout(material),
        lambda: CpuVolumeModel(material),
    )
    if model.material != material:
        _model.clear()  # if the update is cancelled, the model is not kept
        model.assemble(material)
        _model.value = model
    return model
