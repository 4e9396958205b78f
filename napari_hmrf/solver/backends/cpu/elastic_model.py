"""Model of elastic tissue on the processor: multigrid levels, and forces in double precision."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import (
    assembly,
    elastic,
    elastic_exact,
    forces,
    small,
    vectors,
)
from napari_hmrf.solver.backends.cpu.deflation_setup import build_deflation
from napari_hmrf.solver.backends.cpu.level import Vector, paces_of
from napari_hmrf.solver.backends.cpu.small_levels import SmallLevel, SmallLevels, divided
from napari_hmrf.solver.backends.cpu.transfer import padded
from napari_hmrf.solver.backends.host_model import HostModel
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.rigid.bodies import Bodies, BodySites, bodies_of, can_deflate
from napari_hmrf.solver.backends.rigid.deflation import Deflation
from napari_hmrf.solver.backends.thread import in_child_of_fork
from napari_hmrf.solver.coarse_levels import grids, smoother_bounds
from napari_hmrf.solver.priors.elements import (
    CYCLE_STAND_IN,
    HELD_STAND_IN,
    ElasticMaterial,
    stiffest,
)

# Coefficients (scale, ahead, back) of a Chebyshev step that changes nothing.
_NO_STEP = np.zeros(3, dtype=np.float32)


class CpuElasticLevel(SmallLevel):
    """Level of elastic tissue with its elements and springs.

    Attributes
    ----------
    lame : ndarray, shape (2, H + 4, W + 4)
        Lame parameters of the elements; 0 in void.
    moving, reach : ndarray
        Variants of `inverse` and `spans` in which the bodies constrained by cycles are free.
    """

    def __init__(
        self,
        grid: tuple[int, ...],
        shape: Vector,
        finest: bool,
        spans: npt.NDArray[np.int64],
        memory: Iterator[Vector] | None = None,
        has_data: bool = False,
    ) -> None:
        super().__init__(grid, memory)
        self.shape, self.spans = shape, spans
        self.pins = self.vector()
        self.weight = None if finest else self.vector()
        if memory is not None:
            next(memory)  # skip the array for the residual, which is used only by the cycle
        self.lame = self.vector()
        if memory is not None and has_data:
            self.lame, self.mixed = self.lame[:2], self.lame[2:]
        self.moving, self.reach = self.inverse, spans
        self._memory = None
        if has_data:
            self.data = padded(3, grid)
            self.weight = self.vector() if self.weight is None else self.weight
            self.mixed = self.vector() if self.mixed is None else self.mixed
        #: Number of threads among which the rows are divided.
        self.parts = forces.parts(grid[0])

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components of the finest level, and constrain deflated bodies."""
        before = self.spans.copy()
        self.moving, self.reach = self.inverse, self.spans
        if self.bodies is not None and self.bodies.is_deflated:
            self.moving, self.reach = self._with_bodies
            assembly.diagonal(self.lame, self.shape, self.moving)
            vectors.hold(self.moving, held, self.pins, self.reach)
            held = self.bodies.hold(held)
        assembly.diagonal(self.lame, self.shape, self.inverse)
        vectors.hold(self.inverse, held, self.pins, self.spans)
        self._hold_data()
        # Deflation also changes the correction at bodies, so the next cycle must reset it there.
        self.spans[:] = self.reach
        self._clear_vectors(before)

    @cached_property
    def _with_bodies(self) -> tuple[Vector, npt.NDArray[np.int64]]:
        """Arrays for `moving` and `reach`, allocated only for rigid tissue."""
        return self.vector(), np.zeros_like(self.spans)

    def hold_as(self, finer: CpuElasticLevel) -> None:
        """Set the springs of sites near prescribed sites of the next finer level."""
        before = self.spans.copy()
        assembly.diagonal(self.lame, self.shape, self.inverse)
        self._set_springs(finer)
        self._clear_vectors(before)

    def _clear_vectors(self, before: npt.NDArray[np.int64]) -> None:
        """Clear the corrections if spans have shrunk, because kernels write only within spans."""
        if (self.spans[:, 0] > before[:, 0]).any() or (self.spans[:, 1] < before[:, 1]).any():
            for vector in (self.correction, self._other):
                vector.fill(0)

    def holding(self) -> CpuElasticLevel:
        """Return a copy of this level with all pinned sites prescribed, and without springs."""
        assert self.together is not None
        made: CpuElasticLevel = self.together.copy().levels[0]
        assert made.weight is not None
        made.weight.fill(0)
        made.hold(self.pins > 0)
        return made

    def relax(self, steps: Steps, from_zero: bool) -> None:
        """Run Chebyshev-Jacobi steps on `correction` for `load`."""
        if self.point_smoother is not None:
            self._relax_with_points(steps, from_zero)
            return
        paces = paces_of(steps, from_zero)
        about = self._about
        if from_zero:
            # `begin` does not store the displacement after step 1, which step 3 would require.
            second = paces[1] if len(paces) == 2 else _NO_STEP
            elastic.begin(*about, self.correction, paces[0, 0], *second, self.parts)
            paces = paces[2 if len(paces) == 2 else 1 :]
        for pace in paces:
            elastic.smooth(self.correction, *about, self._other, *pace, self.parts)
            self.correction, self._other = self._other, self.correction

    def _step_simply(self, pace: Vector) -> None:
        elastic.smooth(self.correction, *self._about, self._other, *pace, self.parts)

    def _restrict_residual(self, coarse: CpuElasticLevel) -> None:
        if self.point_smoother is not None:
            self._restrict_with_points(coarse)
            return
        elastic.leave(self.correction, *self._about, coarse.load, self.parts)

    @property
    def _about(self) -> tuple[Any, ...]:
        """Arguments of the smoothing loops."""
        weights = self.inverse, *self._springs, self.mixed
        return self.load, self.lame, *weights, self.shape, self.spans

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        about = self.lame, self.moving, self.exact_data, self.shape, self.reach, image, self._rows
        if self.together is None:
            elastic.apply(direction, *about, self.parts)
        else:  # on a small level, waking other threads takes longer than the loop
            elastic.apply_part(direction, *about, 0, len(self.reach))
        return float(self._rows.sum()) + self.add_points(direction, self.moving, image)

    def coarsen_data(self, coarse: CpuElasticLevel) -> None:
        """Compute the tensors of the data term on the next coarser level."""
        assembly.diagonal(self.lame, self.shape, self.inverse)
        self._restrict_data(coarse)


def _cycle(shape: Vector, values: Vector, table: npt.NDArray[np.int64], *paces: Vector) -> None:
    small.cycle(values, table, shape, *paces)


def _data_cycle(
    shape: Vector, values: Vector, table: npt.NDArray[np.int64], *paces: Vector
) -> None:
    small.data_cycle(values, table, shape, *paces)


class CpuElasticModel(HostModel):
    """`LinearModel` of elastic tissue; other backends build their levels from this model.

    Parameters
    ----------
    material : ElasticMaterial
        Material on the finest grid.
    """

    def __init__(self, material: ElasticMaterial) -> None:
        self._shape = np.array(material.shape, dtype=np.float32)
        large, little = divided(grids(material.m.shape))
        has_data = material.data is not None
        self.levels = [
            CpuElasticLevel(
                grid,
                self._shape,
                number == 0,
                np.zeros((grid[0], 2), dtype=np.int64),
                has_data=has_data,
            )
            for number, grid in enumerate(large)
        ]
        if little:
            self.levels += self._small(little, has_data)
        self._rest = self.levels[0].vector()
        self._exact_lame: Planes = np.zeros(self._rest.shape)
        self._deflation = np.zeros((0, *self._rest.shape), dtype=np.float32)
        self._rows: npt.NDArray[np.float64] = np.zeros((2, self.levels[0].grid[0]))
        self.assemble(material)

    def _small(self, grids: Sequence[tuple[int, ...]], has_data: bool) -> list[CpuElasticLevel]:
        """Return the small levels, which share memory and a single-call V-cycle."""
        shape = self._shape

        def level(grid: tuple[int, ...], memory: Iterator[Vector]) -> CpuElasticLevel:
            spans = np.zeros((grid[0], 2), dtype=np.int64)
            return CpuElasticLevel(grid, shape, False, spans, memory, has_data)

        planes = small.DATA_PLANES if has_data else small.PLANES
        cycle = partial(_data_cycle if has_data else _cycle, shape)
        return SmallLevels(grids, int(planes), level, cycle).levels

    def assemble(self, material: ElasticMaterial) -> None:
        """Replace the material with another material on the same grid."""
        self.material = material
        self.bounds = smoother_bounds(material)
        self._shape[:] = material.shape
        self._exact_shape = np.array(material.shape, dtype=np.float64)
        self._held = None
        m, most = material.m, stiffest(material.m)
        self._sites: list[BodySites] = []
        if material.rigid:
            self._sites = bodies_of(m)
            stand_in = HELD_STAND_IN if can_deflate(self._sites, m.shape) else CYCLE_STAND_IN
            m = np.where(np.isinf(m), np.float32(stand_in * most), m)
            m.setflags(write=False)  # numba would compile another version for writable arrays
        one = isinstance(material.poisson, float)
        assembly.elements(
            m,
            material.poisson if one else 0.0,
            m if one else material.poisson,
            one,
            material.strain,
            0.25 / most,
            self._exact_lame,
        )
        self.levels[0].lame[...] = self._exact_lame
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            assembly.coarsen(fine.lame, coarse.lame)
        if material.data is not None:
            assembly.diagonal(self.levels[0].lame, self._shape, self.levels[0].inverse)
            self.levels[0].set_data(material.data)
            for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
                fine.coarsen_data(coarse)

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components on all levels."""
        if self._held is None or not np.array_equal(held, self._held):
            rigid = self.material.rigid
            self.bodies = Bodies(self._sites, self.material, held) if rigid else None
            self.levels[0].bodies = self.bodies
        super().hold(held)

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the unknown components of the finest level."""
        moves: HeldPlanes = self.levels[0].moving > 0
        return moves

    def deflation(self, steps: Steps, coarsest: Steps) -> Deflation | None:
        """Return the deflation by the fields of movable bodies, or None if no body can move."""
        if self.bodies is None or not self.bodies.is_deflated:
            return None
        number = next((k for k, level in enumerate(self.levels) if level.finishes_cycle), 0)
        small = self.levels[number].holding() if number > 0 else None
        # This method runs often while the user draws. Reuse the memory, because allocation is slow.
        shape = 2 * self.bodies.freedom, *self._rest.shape
        if self._deflation.shape[0] < shape[0]:
            self._deflation = np.zeros(shape, dtype=np.float32)
        memory = self._deflation[: shape[0]]
        return build_deflation(
            self.bodies, self.levels[: number + 1], small, steps, coarsest, memory
        )

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        finest, (most, squares) = self.levels[0], self._rows
        if finest.points is not None:
            load = np.zeros(d.shape) if load is None else load.copy()
            finest.add_points(d, None, load, -1.0)
        given = (d, 0.0) if load is None else (load, 1.0)
        elastic_exact.balance(
            d,
            *given,
            self._exact_lame,
            finest.moving,
            finest.exact_data,
            self._exact_shape,
            finest.reach,
            1 / unit,
            self._rest,
            most,
            squares,
            finest.parts,
        )
        return float(most.max()), math.sqrt(squares.sum())

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d at all components, in double precision; valid until the next call."""
        elastic_exact.pull(d, self._exact_lame, self._exact_shape, self._pull, self.levels[0].parts)
        self.levels[0].add_data(d, None, self._pull, -1.0)
        return self._pull if low is None else self._pull.copy() + self.pull(low)

    @cached_property
    def _pull(self) -> Planes:
        """Output of `pull`, allocated only for tissue that may slip."""
        return np.zeros(self._rest.shape)

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the elastic energy and the norm of the forces."""
        finest, (products, squares) = self.levels[0], self._rows
        about = self._exact_lame, finest.exact_data, self._exact_shape
        elastic_exact.work(d, *about, products, squares, finest.parts)
        if finest.points is not None:
            forces = self.pull(d)
            return -float((forces * d).sum()) / 2, float(np.linalg.norm(forces))
        return float(products.sum()) / 2, math.sqrt(squares.sum())

    @property
    def steepness(self) -> Planes:
        """Diagonal of the stiffness matrix, as planes."""
        out = np.zeros(self._rest.shape)
        assembly.diagonal(self._exact_lame, self._exact_shape, out)
        if self.material.data is not None:
            self.material.data.add_diagonal(out)
        return out

    def clear_cache(self) -> None:
        """Clear the model cache, because vectors of the model may contain non-finite values."""
        _last[:] = ()


_last: list[CpuElasticModel] = []
in_child_of_fork(_last.clear)  # the fork may have interrupted a solve that uses the model


def _layout(material: ElasticMaterial) -> tuple[tuple[int, ...], bool]:
    """Return the properties of a material that determine the arrays of its model."""
    return material.m.shape, material.data is not None


def the_model(material: ElasticMaterial) -> CpuElasticModel:
    """Return the model of a material, reusing the cached model if possible.

    Building a model takes as long as a few cycles, and users edit observations more often than
    tissue. Call this function only on the compute thread, because all solves share the model.
    """
    if not _last or _layout(_last[0].material) != _layout(material):
        _last[:] = ()  # free the old model before the new one is allocated
        _last.append(CpuElasticModel(material))
    elif _last[0].material != material:
        _last[0].assemble(material)
    return _last[0]
