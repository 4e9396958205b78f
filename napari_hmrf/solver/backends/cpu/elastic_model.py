"""Model of elastic tissue on the processor: multigrid levels, and forces in double precision."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loops
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.cpu import (
    assembly,
    elastic,
    elastic_exact,
    forces,
    small,
    vectors,
)
from napari_hmrf.solver.backends.cpu.deflation_setup import build_deflation
from napari_hmrf.solver.backends.cpu.layout import Layout, Table, Values, flat, whole_rows
from napari_hmrf.solver.backends.cpu.level import Vector, paces_of
from napari_hmrf.solver.backends.cpu.small_levels import SmallLevel, SmallLevels, divided
from napari_hmrf.solver.backends.cpu.transfer import PAD, padded
from napari_hmrf.solver.backends.host_model import HostModel
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.rigid.bodies import bodies_of, can_deflate
from napari_hmrf.solver.backends.rigid.deflation import Deflation
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
    lame : ndarray, shape (2, *layout.shape)
        Lame parameters of the elements; 0 in void. The model sets those of large levels.
    pins : ndarray, shape (2, H + 4, W + 4)
        Prescribed components, always as planes.
    moving, reach : ndarray
        Variants of `inverse` and `spans` in which the bodies constrained by cycles are free.
    """

    lame: Vector

    def __init__(
        self,
        grid: tuple[int, ...],
        shape: Vector,
        finest: bool,
        spans: npt.NDArray[np.int64],
        memory: Iterator[Vector] | None = None,
        has_data: bool = False,
        layout: Layout | None = None,
    ) -> None:
        super().__init__(grid, memory, layout)
        self.shape, self.spans = shape, spans
        self._totals: npt.NDArray[np.float64] = np.zeros(grid[0])
        self.pins = self.vector() if self.layout.is_whole else padded(2, grid)
        self.weight = None if finest else self.vector()
        if memory is not None:
            next(memory)  # skip the array for the residual, which is used only by the cycle
            self.lame = self.vector()
            if has_data:
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
            self.write_diagonal(self.moving)
            self._hold(held, self.moving, self.reach)
            held = self.bodies.hold(held)
        self.write_diagonal(self.inverse)
        self._hold(held, self.inverse, self.spans)
        self._hold_data()
        # Deflation also changes the correction at bodies, so the next cycle must reset it there.
        self.spans[:] = self.reach
        self._clear_vectors(before)

    def write_diagonal(self, out: Vector) -> None:
        """Write the diagonal of the stiffness matrix to `out`."""
        starts, _, tissue = self.layout.rows
        assembly.diagonal(flat(self.lame), starts, tissue, self.shape, flat(out))

    @cached_property
    def _with_bodies(self) -> tuple[Vector, npt.NDArray[np.int64]]:
        """Arrays for `moving` and `reach`, allocated only for rigid tissue."""
        return self.vector(), np.zeros_like(self.spans)

    def hold_as(self, finer: CpuElasticLevel) -> None:
        """Set the springs of sites near prescribed sites of the next finer level."""
        before = self.spans.copy()
        self.write_diagonal(self.inverse)
        self._set_springs(finer)
        self._clear_vectors(before)

    def _restrict_pins(self, finer: CpuElasticLevel) -> None:
        vectors.restrict(finer.pins, self.pins)

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
            self._relax_with_data(steps, from_zero)
            return
        paces = paces_of(steps, from_zero)
        if from_zero:
            # `begin` does not store the displacement after step 1, which step 3 would require.
            second = paces[1] if len(paces) == 2 else _NO_STEP
            out = flat(self.correction)
            elastic.begin(*self._about, out, paces[0, 0], *second, self.parts)
            paces = paces[2 if len(paces) == 2 else 1 :]
        for pace in paces:
            self._step_simply(pace)
            self.correction, self._other = self._other, self.correction

    def _step_simply(self, pace: Vector) -> None:
        d, out = flat(self.correction), flat(self._other)
        elastic.smooth(d, *self._about, out, *pace, self.parts)

    def _restrict_residual(self, coarse: CpuElasticLevel) -> None:
        if self.point_smoother is not None:
            self._restrict_with_data(coarse)
            return
        starts, _, tissue = coarse.layout.rows
        about = *self._about, flat(coarse.load), starts, tissue, self.parts
        elastic.leave(flat(self.correction), *about)

    def _interpolate(self, coarse: CpuElasticLevel) -> None:
        vectors = flat(coarse.correction), coarse.layout.rows[0], flat(self.correction)
        elastic.interpolate(*vectors, flat(self.inverse), self._where(self.spans))

    @property
    def _about(self) -> tuple[Any, ...]:
        """Arguments of the smoothing loops."""
        weight, springs = self._springs
        mixed = None if self.mixed is None else flat(self.mixed)
        vectors = flat(self.load), flat(self.lame), flat(self.inverse), flat(weight)
        return *vectors, springs, mixed, self.shape, self._where(self.spans)

    def _where(self, spans: Table) -> tuple[Table, Table, int]:
        """Table of rows, spans, and width of a padded row, for the kernels."""
        return self.layout.rows[0], spans, self.layout.planes[1]

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        data = None if self.exact_data is None else flat(self.exact_data)
        where, out = self._where(self.reach), (flat(image), self._totals)
        about = flat(self.lame), flat(self.moving), data, self.shape, where, *out
        if self.together is None:
            elastic.apply(flat(direction), *about, self.parts)
        else:  # on a small level, waking other threads takes longer than the loop
            elastic.apply_part(flat(direction), *about, 0, len(self.reach))
        return float(self._totals.sum()) + self.add_points(direction, self.moving, image)

    def coarsen_data(self, coarse: CpuElasticLevel) -> None:
        """Compute the tensors of the data term on the next coarser level."""
        self.write_diagonal(self.inverse)
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
    whole : bool
        True to store the vectors of all levels as planes; False to store only tissue on large
        levels with much void.
    """

    def __init__(self, material: ElasticMaterial, whole: bool = True) -> None:
        self._shape = np.array(material.shape, dtype=np.float32)
        large, little = divided(grids(material.m.shape))
        self._whole = whole
        #: Lame parameters on each large level, as planes.
        self._planes = [padded(2, grid) for grid in large]
        self.levels: list[CpuElasticLevel] = []
        self._little = self._small(little, material.data is not None) if little else []
        self._exact_lame: Planes = np.zeros(self._planes[0].shape)
        self._rest: Vector = np.zeros(0, dtype=np.float32)
        self._deflation = np.zeros((0, *self._exact_lame.shape), dtype=np.float32)
        self._rows: npt.NDArray[np.float64] = np.zeros((2, large[0][0]))
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

    def fits(self, material: ElasticMaterial, whole: bool) -> bool:
        """Return whether `assemble` can reuse this model for a material and a layout."""
        same = material.m.shape == self.material.m.shape and whole == self._whole
        return same and (material.data is None) == (self.material.data is None)

    def assemble(self, material: ElasticMaterial) -> None:
        """Replace the material with another material on the same grid."""
        self.material = material
        self.bounds = smoother_bounds(material)
        self._shape[:] = material.shape
        self._exact_shape = np.array(material.shape, dtype=np.float64)
        self._held = None
        m, most = material.m, stiffest(material.m)
        self.bodies = self._sites = None
        if material.rigid:
            self._sites = bodies_of(m)
            stand_in = HELD_STAND_IN if can_deflate(self._sites, m.shape) else CYCLE_STAND_IN
            m = np.where(np.isinf(m), np.float32(stand_in * most), m)
        m, nu = loops.only_read(m), material.poisson
        one, each = (nu, m) if isinstance(nu, float) else (0.0, loops.only_read(nu))
        assembly.elements(
            m,
            one,
            each,
            isinstance(nu, float),
            material.strain,
            0.25 / most,
            self._exact_lame,
        )
        self._set_levels()
        self.levels[0].bodies = None
        if material.data is not None:
            self.levels[0].write_diagonal(self.levels[0].inverse)
            self.levels[0].set_data(material.data)
            for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
                fine.coarsen_data(coarse)

    def _set_levels(self) -> None:
        """Set the elements of all levels; replace each level if its layout has changed."""
        # The data term, its landmarks and rigid bodies find their sites in planes.
        whole = self._whole or self.material.data is not None or self.material.rigid
        self._planes[0][...] = self._exact_lame
        for fine, coarse in pairwise([*self._planes, *(level.lame for level in self._little)]):
            assembly.coarsen(fine, coarse)
        large = [
            self._level(number, Layout.of_tissue(lame[1], whole))
            for number, lame in enumerate(self._planes)
        ]
        for level, lame in zip(large, self._planes, strict=True):
            level.lame = level.layout.packed(lame)
        self.levels = large + self._little
        if self._rest.shape != self.levels[0].inverse.shape:
            self._rest = self.levels[0].vector()

    def _level(self, number: int, layout: Layout) -> CpuElasticLevel:
        """Return the large level with this number, or a new one if its layout has changed."""
        if self.levels and self.levels[number].layout.matches(layout):
            return self.levels[number]
        grid = tuple(size - 2 * PAD for size in layout.planes)
        about = self._shape, number == 0, np.zeros((grid[0], 2), dtype=np.int64)
        has_data = self.material.data is not None
        return CpuElasticLevel(grid, *about, has_data=has_data, layout=layout)

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the unknown components of the finest level."""
        finest = self.levels[0]
        moves: HeldPlanes = finest.planes(finest.moving) > 0
        return moves

    def deflation(self, steps: Steps, coarsest: Steps) -> Deflation | None:
        """Return the deflation by the fields of movable bodies, or None if no body can move."""
        if self.bodies is None or not self.bodies.is_deflated:
            return None
        number = next((k for k, level in enumerate(self.levels) if level.finishes_cycle), 0)
        small = self.levels[number].holding() if number > 0 else None
        # This method runs often while the user draws. Reuse the memory, because allocation is slow.
        shape = 2 * self.bodies.freedom, *self._exact_lame.shape
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
        given = (flat(d), 0.0) if load is None else (flat(load), 1.0)
        elastic_exact.balance(
            flat(d),
            *given,
            *self._exact,
            self._where(finest.reach),
            flat(finest.moving),
            finest.layout.rows[0],
            self._exact_shape,
            1 / unit,
            flat(self._rest),
            most,
            squares,
            finest.parts,
        )
        return float(most.max()), math.sqrt(squares.sum())

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d at all components, in double precision; valid until the next call."""
        about = self._exact[0], self._exact_shape, self._where(), flat(self._pull)
        elastic_exact.pull(flat(d), *about, self.levels[0].parts)
        self.levels[0].add_data(d, None, self._pull, -1.0)
        return self._pull if low is None else self._pull.copy() + self.pull(low)

    @cached_property
    def _pull(self) -> Planes:
        """Output of `pull`, allocated only for tissue that may slip."""
        return np.zeros(self._exact_lame.shape)

    @property
    def _exact(self) -> tuple[Values, Values | None]:
        """Lame parameters and data term in double precision, for the kernels."""
        data = self.levels[0].exact_data
        return flat(self._exact_lame), None if data is None else flat(data)

    def _where(self, spans: Table | None = None) -> tuple[Table, Table, int]:
        """Table of rows of planes, spans or all columns, and width of a padded row."""
        starts, _, columns = whole_rows(self._exact_lame.shape[1:])
        return starts, columns[PAD:-PAD] if spans is None else spans, self._exact_lame.shape[2]

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the elastic energy and the norm of the forces."""
        finest, (products, squares) = self.levels[0], self._rows
        about = *self._exact, self._exact_shape, self._where()
        elastic_exact.work(flat(d), *about, products, squares, finest.parts)
        if finest.points is not None:
            forces = self.pull(d)
            return -float((forces * d).sum()) / 2, float(np.linalg.norm(forces))
        return float(products.sum()) / 2, math.sqrt(squares.sum())

    @property
    def steepness(self) -> Planes:
        """Diagonal of the stiffness matrix, as planes."""
        out = np.zeros(self._exact_lame.shape)
        starts, _, columns = whole_rows(out.shape[1:])
        assembly.diagonal(self._exact[0], starts, columns, self._exact_shape, flat(out))
        if self.material.data is not None:
            self.material.data.add_diagonal(out)
        return out

    def clear_cache(self) -> None:
        """Forget the model, because vectors of the model may contain non-finite values."""
        _model.clear()


_model: Kept[CpuElasticModel] = Kept()


def the_model(material: ElasticMaterial, whole: bool = True) -> CpuElasticModel:
    """Return the model of a material, reusing the last model if possible.

    Building a model takes as long as a few cycles, and users edit observations more often than
    tissue. Call this function only on the compute thread, because all solves share the model.
    """
    model = _model.get(
        lambda last: last.fits(material, whole), lambda: CpuElasticModel(material, whole)
    )
    if model.material != material:
        model.assemble(material)
    return model
