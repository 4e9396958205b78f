"""Model of elastic volumes on the processor: levels, and forces in double precision."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends import volume_caches
from napari_hmrf.solver.backends.base import BATCH_SECONDS, Checkpoint
from napari_hmrf.solver.backends.cpu import hexahedra, vectors, volume
from napari_hmrf.solver.backends.cpu.double_level import DoubleLevel
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector, paces_of, rows
from napari_hmrf.solver.backends.cpu.transfer import PAD, padded
from napari_hmrf.solver.backends.host_model import HostModel
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.rigid.bodies import Bodies, BodySites, bodies_of
from napari_hmrf.solver.backends.thread import in_child_of_fork
from napari_hmrf.solver.coarse_levels import grids, smoother_bounds
from napari_hmrf.solver.priors.elements import (
    CYCLE_STAND_IN,
    ElasticMaterial,
    lame_ratio,
    stiffest,
)

# Approximate time of a smoothing step for one site on one thread, in seconds.
_SITE_SECONDS = 20e-9


def _never_cancel() -> None:
    """Do nothing, for levels that cannot be cancelled."""


class VolumeLevel(CpuLevel):
    """Base class of the levels of a volume, which use little memory.

    Parameters
    ----------
    grid : tuple of int
        Grid of the level, (D, H, W).
    finest : bool
        True for the finest level, which has no springs at first.

    Attributes
    ----------
    reach : ndarray, shape (D + 4, H + 4, 2)
        Start and stop column of the moving sites in each padded row.
    shape : ndarray
        Constants of the kernels for the shape of a voxel.
    """

    sums_up = True

    def __init__(self, grid: tuple[int, ...], finest: bool) -> None:
        super().__init__(grid)
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

    @staticmethod
    def _restrict(fine: Vector, coarse: Vector) -> None:
        volume.restrict(fine, coarse)

    @staticmethod
    def _interpolate(coarse: Vector, fine: Vector, inverse: Vector) -> None:
        volume.interpolate(coarse, fine, inverse)

    @staticmethod
    def _add_relaxed(
        coarse: Vector, inverse: Vector, weight: Vector, mixed: Vector, out: Vector
    ) -> None:
        volume.add_relaxed(coarse, inverse, weight, mixed, out)


class CpuVolumeLevel(VolumeLevel):
    """Level of an elastic volume with its elements and springs.

    Attributes
    ----------
    lame : ndarray, shape (1 or 2, D + 4, H + 4, W + 4)
        Parameters mu, or mu and lambda, of the elements; 0 in void.
    share : float
        Ratio lambda / mu of all elements, or 1 if each element has its own lambda.
    checkpoint : callable
        Function called several times a second; it raises an exception to cancel the work.
    """

    def __init__(
        self, grid: tuple[int, ...], parameters: int, finest: bool, has_data: bool
    ) -> None:
        super().__init__(grid, finest)
        self.lame = padded(parameters, grid)
        if has_data:
            self.data, self.mixed = padded(6, grid), padded(6, grid)
            self.weight = self.vector() if self.weight is None else self.weight
        #: Number of threads among which the planes are divided.
        self.parts = volume.parts(grid[0])
        #: Number of smoothing steps between two checks for cancellation.
        self._at_once = max(1, int(BATCH_SECONDS / (_SITE_SECONDS * math.prod(grid))))
        self.checkpoint: Checkpoint = _never_cancel
        self.share = np.float32(1)

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components of the finest level."""
        # The operating system allocates new memory at the first write, which is slow. Fill the
        # arrays one by one first, so that the solve can be cancelled between two arrays.
        self.clear()
        for component in self.inverse:
            component.fill(0)
            self.checkpoint()
        volume.diagonal(self.lame, self.share, self.shape, self.inverse)
        self.checkpoint()
        vectors.hold(rows(self.inverse), rows(held), rows(self.pins), self.spans)
        self._hold_data()

    def hold_as(self, finer: CpuVolumeLevel) -> None:
        """Set the springs of sites near prescribed sites of the next finer level."""
        volume.diagonal(self.lame, self.share, self.shape, self.inverse)
        self._set_springs(finer)

    def relax(self, steps: Steps, from_zero: bool) -> None:
        """Run Chebyshev-Jacobi steps on `correction` for `load`."""
        if self.point_smoother is not None:
            self._relax_with_points(steps, from_zero)
            return
        paces = paces_of(steps, from_zero)
        if from_zero:
            load, inverse, correction = map(rows, (self.load, self.inverse, self.correction))
            mixed = None if self.mixed is None else rows(self.mixed)
            volume.start(load, inverse, mixed, correction, paces[0, 0])
            paces = paces[1:]
        about = self._about
        for begin in range(0, len(paces), self._at_once):
            some = paces[begin : begin + self._at_once]
            volume.smooth(self.correction, self._other, *about, some, self.parts)
            if len(some) % 2 == 1:
                self.correction, self._other = self._other, self.correction
            self.checkpoint()

    @property
    def _about(self) -> tuple[Any, ...]:
        """Arguments of the smoothing loop."""
        weights = self.inverse, *self._springs, self.mixed
        return self.load, self.lame, self.share, *weights, self.shape, self.reach

    def _step_simply(self, pace: Vector) -> None:
        volume.smooth(self.correction, self._other, *self._about, pace[None], self.parts)

    def _restrict_residual(self, coarse: CpuVolumeLevel) -> None:
        if self.point_smoother is not None:
            self._restrict_with_points(coarse)
            return
        # `_other` can store the residual: the next step has no momentum and does not read `_other`.
        if self.mixed is None:
            self._rest_of(self.correction, self.load, np.float32(1), np.float32(1), self._other)
        else:
            tissue, weights = (self.lame, self.share), (self.inverse, self.weight, self.mixed)
            about = *tissue, *weights, self.shape, self.reach
            volume.filtered_rest(self.correction, self.load, *about, self._other, self.parts)
        self._restrict(self._other, coarse.load)

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        self._rest_of(direction, direction, np.float32(0), np.float32(-1), image)
        self.add_points(direction, self.inverse, image)  # the loop has added the precision
        return self.product(direction, image)

    def _rest_of(
        self, d: Vector, load: Vector, given: np.float32, scale: np.float32, out: Vector
    ) -> None:
        weights = self.inverse, *self._springs, self.mixed
        about = self.lame, self.share, *weights, self.shape, self.reach
        volume.rest(d, load, given, *about, scale, out, self.parts)

    def coarsen_data(self, coarse: CpuVolumeLevel) -> None:
        """Compute the tensors of the data term on the next coarser level."""
        volume.diagonal(self.lame, self.share, self.shape, self.inverse)
        self._restrict_data(coarse)


class CpuVolumeModel(HostModel):
    """`LinearModel` of an elastic volume.

    Parameters
    ----------
    material : ElasticMaterial
        Material on the finest grid.
    checkpoint : callable
        Function called several times a second; it raises an exception to cancel the work.
    """

    def __init__(self, material: ElasticMaterial, checkpoint: Checkpoint = _never_cancel) -> None:
        count = 1 if isinstance(material.poisson, float) else 2
        self.levels = [
            CpuVolumeLevel(grid, count, number == 0, material.data is not None)
            for number, grid in enumerate(grids(material.m.shape))
        ]
        self._rest = self.levels[0].vector()
        self.set_checkpoint(checkpoint)
        self.assemble(material)

    def set_checkpoint(self, checkpoint: Checkpoint) -> None:
        """Replace the checkpoint of all levels."""
        for level in self.levels:
            level.checkpoint = checkpoint

    def assemble(self, material: ElasticMaterial) -> None:
        """Replace the material with one that has the same grid and number of parameters."""
        self.material = material
        self.bounds = smoother_bounds(material)
        self._held = self.bodies = self.levels[0].bodies = None
        constants = hexahedra.constants(material.shape)
        m, nu, most = material.m, material.poisson, stiffest(material.m)
        self._sites: list[BodySites] = bodies_of(m) if material.rigid else []
        if material.rigid:
            m = np.where(np.isinf(m), np.float32(CYCLE_STAND_IN * most), m)
            m.setflags(write=False)  # numba would compile another version for writable arrays
        lame, scale, share = self.levels[0].lame, 0.125 / most, 1.0
        if isinstance(nu, float):
            share = lame_ratio(nu, strain=True)
            volume.elements(m, m, True, scale / (2 + 2 * nu), lame)
        else:
            volume.elements(m, nu, False, scale, lame)
        self.levels[0].checkpoint()
        for level in self.levels:
            level.shape, level.share = constants.astype(np.float32), np.float32(share)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            volume.coarsen(fine.lame, coarse.lame)
        if material.data is not None:
            finest = self.levels[0]
            volume.diagonal(lame, finest.share, finest.shape, finest.inverse)
            finest.set_data(material.data)
            for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
                self.levels[0].checkpoint()
                fine.coarsen_data(coarse)
        self._exact: tuple[Any, ...] = np.float64(share), constants

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components on all levels."""
        before = self._held
        if self.material.rigid and (before is None or not np.array_equal(held, before)):
            self.bodies = self.levels[0].bodies = Bodies(self._sites, self.material, held)
        self.levels[0].checkpoint()
        super().hold(held)

    def _begin(self) -> None:
        self.clear()

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        finest, (share, shape) = self.levels[0], self._exact
        if finest.points is not None:
            load = np.zeros(d.shape) if load is None else load.copy()
            finest.add_points(d, None, load, -1.0)
        given = (d, 0.0) if load is None else (load, 1.0)
        data, weights = finest.exact_data, (finest.inverse, 0.0, None)
        if data is not None:
            weights = data[:3], 1.0, data[3:]
        about = finest.lame, share, finest.inverse, *weights, shape, finest.reach
        volume.rest(d, *given, *about, 1 / unit, self._rest, finest.parts)
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
        volume.pull(exactly, finest.lame, *self._exact, out, finest.parts)
        finest.add_data(exactly, None, out, -1.0)
        return out

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the elastic energy and the norm of the forces."""
        finest, (share, shape) = self.levels[0], self._exact
        products, squares = np.zeros((2, self.shape[0]))
        about = finest.lame, share, finest.exact_data, shape
        volume.work(d, *about, products, squares, finest.parts)
        if finest.points is not None:
            forces = self.pull(d)
            return -float((forces * d).sum()) / 2, float(np.linalg.norm(forces))
        return float(products.sum()) / 2, math.sqrt(squares.sum())

    @property
    def steepness(self) -> Planes:
        """Diagonal of the stiffness matrix, as planes."""
        finest = self.levels[0]
        out = finest.vector()
        volume.diagonal(finest.lame, finest.share, finest.shape, out)
        steepness = np.asarray(out, dtype=np.float64)
        if self.material.data is not None:
            self.material.data.add_diagonal(steepness)
        return steepness

    def clear_cache(self) -> None:
        """Clear the model cache, because vectors of the model may contain non-finite values."""
        _last[:] = ()


_last: list[CpuVolumeModel] = []
in_child_of_fork(_last.clear)
volume_caches.register(_last.clear)


def the_model(material: ElasticMaterial, checkpoint: Checkpoint = _never_cancel) -> CpuVolumeModel:
    """Return the model of a material, reusing the cached model if possible.

    Call this function only on the compute thread, because all solves share the model.
    """

    def layout(each: ElasticMaterial) -> tuple[Any, ...]:
        return each.m.shape, isinstance(each.poisson, float), each.data is not None

    if not _last or layout(_last[0].material) != layout(material):
        _last[:] = ()  # free the old model before the new one is allocated
        _last.append(CpuVolumeModel(material, checkpoint))
    elif _last[0].material != material:
        model = _last.pop()  # if the update is cancelled, the model is not cached
        model.set_checkpoint(checkpoint)
        model.assemble(material)
        _last.append(model)
    _last[0].set_checkpoint(checkpoint)
    return _last[0]
