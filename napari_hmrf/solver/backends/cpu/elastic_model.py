"""Model of elastic tissue on the processor: multigrid levels, and forces in double precision."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.compile_cache import loops as compiled
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.cpu import small
from napari_hmrf.solver.backends.cpu.deflation_setup import build_deflation
from napari_hmrf.solver.backends.cpu.double_level import DoubleLevel
from napari_hmrf.solver.backends.cpu.layout import Layout, Table, flat, tissue_spans
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Spans, Vector, loops_of
from napari_hmrf.solver.backends.cpu.small_levels import SmallLevels, divided
from napari_hmrf.solver.backends.cpu.transfer import PAD, padded
from napari_hmrf.solver.backends.earlier_results import EarlierResults
from napari_hmrf.solver.backends.host_model import HostModel
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes, Review, Steps
from napari_hmrf.solver.backends.rigid.bodies import bodies_of, can_deflate
from napari_hmrf.solver.backends.rigid.deflation import Deflation
from napari_hmrf.solver.coarse_levels import grids, smoother_bounds
from napari_hmrf.solver.priors.elements import (
    CYCLE_STAND_IN,
    HELD_STAND_IN,
    ElasticMaterial,
    stiffest,
)


class CpuElasticLevel(CpuLevel):
    """Level of elastic tissue with its elements and springs.

    Attributes
    ----------
    lame : ndarray, shape (parameters, *layout.shape)
        Parameters of the elements: lambda and mu in an image, mu or mu and lambda in a volume;
        0 in void. The model sets those of large levels.
    share : float
        Ratio lambda / mu of all elements of a volume, or 1 if each element has its own lambda.
    shape : ndarray
        Constants of the loops for the shape of a site.
    system : tuple
        Elements, springs and data, for the loops.
    moving_inverse, moving_spans : ndarray
        Variants of `inverse` and `spans` in which the bodies constrained by cycles are free.
    """

    loops_apply_data = True
    lame: Vector
    share = np.float32(1)
    system: tuple[Any, ...]

    def __init__(
        self,
        grid: tuple[int, ...],
        shape: Vector,
        finest: bool = False,
        layout: Layout | None = None,
        memory: Mapping[str, Vector] | None = None,
        has_data: bool = False,
    ) -> None:
        super().__init__(grid, finest, layout, memory)
        self.shape = shape
        self.sums_up = self.is_volume
        if memory is not None:
            self.lame = memory["own"][:2]
            self.mixed = memory["own"][2:] if has_data else None
        if has_data:
            self.allow_data()
        self.moving_inverse, self.moving_spans = self.inverse, self.spans
        self.totals: npt.NDArray[np.float64] = np.zeros(grid[0])
        #: Number of threads among which the rows or planes are divided.
        self.parts = self.loops.parts(grid[0])

    @property
    def elements(self) -> tuple[Any, ...]:
        """Parameters of the elements, for the loops."""
        return (flat(self.lame), self.share) if self.is_volume else (flat(self.lame),)

    def start_cycles(self) -> None:
        """Clear the corrections as far as necessary, and collect the arguments of the loops."""
        super().start_cycles()
        weight, springs = self._springs
        mixed = None if self.mixed is None else flat(self.mixed)
        about = flat(self.inverse), flat(weight), springs, mixed, self.shape
        self.system = *self.elements, *about

    def write_diagonal(self, out: Vector) -> None:
        """Write the diagonal of the stiffness matrix to `out`."""
        self.loops.diagonal(self, out)

    def hold(self, held: HeldPlanes) -> None:
        """Set the prescribed components of the finest level, and constrain deflated bodies."""
        self.moving_inverse, self.moving_spans = self.inverse, self.spans
        if self.bodies is None or not self.bodies.is_deflated:
            super().hold(held)
            return
        self.moving_inverse, self.moving_spans = self._with_bodies
        self.write_diagonal(self.moving_inverse)
        self._hold(held, self.moving_inverse, self.moving_spans)
        super().hold(self.bodies.hold(held))
        # Deflation also changes the correction at bodies, so the next cycle must reset it there.
        self.spans[:] = self.moving_spans

    @cached_property
    def _with_bodies(self) -> tuple[Vector, Spans]:
        """Arrays for `moving_inverse` and `moving_spans`, allocated only for rigid tissue."""
        return self.vector(), np.zeros_like(self.spans)

    def _smooth(self, paces: Vector) -> None:
        self.loops.smooth(self, paces)

    def _leave(self, coarse: Any) -> None:
        self.loops.leave(self, coarse)

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction``; return ``direction . image``."""
        return float(self.loops.apply(self, direction, image))

    def advance_by(
        self, d: Any, share: float, rest: Vector, direction: Vector, image: Vector, length: float
    ) -> float:
        """Add ``share * direction`` to `d`, and subtract ``length * image`` from `rest`.

        Return ``rest . rest``. In a volume, `d` consists of planes in all layouts.
        """
        if not self.is_volume:
            return super().advance_by(d, share, rest, direction, image, length)
        return float(self.loops.advance(self, d, share, rest, direction, image, length))


def _cycle(shape: Vector, values: Vector, table: npt.NDArray[np.int64], *paces: Vector) -> None:
    small.cycle(values, table, shape, *paces)


def _responses(
    shape: Vector, values: Vector, table: npt.NDArray[np.int64], *others: npt.NDArray[Any]
) -> None:
    small.responses(values, table, shape, *others)


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
        shape = material.m.shape
        self._loops, self._whole = loops_of(len(shape)), whole
        self._large, little = divided(grids(shape))
        self.levels: list[CpuElasticLevel] = []
        self._shape: Vector = self._loops.constants(material.shape).astype(np.float32)
        self._small = self._small_levels(little, material.data is not None) if little else None
        self._exact_lame = self._loops.exact_elements(shape)
        self._rest: Vector = np.zeros(0, dtype=np.float32)
        self._fields: Vector = np.zeros((0, 0), dtype=np.float32)
        # Start and stop column of the tissue in each row, computed on first use.
        self._tissue: Table | None = None
        # Mask of the free components, with the object that identifies the prescribed ones.
        self._moves: tuple[EarlierResults, HeldPlanes] | None = None
        self.assemble(material)

    def _small_levels(self, little: Sequence[tuple[int, ...]], has_data: bool) -> SmallLevels:
        """Return the small levels, which share memory and a single-call V-cycle."""
        # Not `self`, which the levels would keep in memory until garbage collection.
        shape = self._shape

        def level(grid: tuple[int, ...], memory: Mapping[str, Vector]) -> CpuElasticLevel:
            return CpuElasticLevel(grid, shape, memory=memory, has_data=has_data)

        if has_data:
            cycle = partial(_data_cycle, shape)
            return SmallLevels(little, int(small.DATA_PLANES), level, cycle)
        loops = partial(_cycle, shape), partial(_responses, shape)
        return SmallLevels(little, int(small.PLANES), level, *loops)

    def fits(self, material: ElasticMaterial, whole: bool) -> bool:
        """Return whether `assemble` can reuse this model for a material and a layout."""
        return (
            material.m.shape == self.material.m.shape
            and whole == self._whole
            and (material.data is None) == (self.material.data is None)
            and self._loops.parameters(material) == len(self.levels[0].lame)
        )

    def assemble(self, material: ElasticMaterial) -> None:
        """Replace the material with another material that this model fits."""
        self.material = material
        self.bounds = smoother_bounds(material)
        self._held = self.bodies = self._sites = None
        self._tissue = None
        m, most = material.m, stiffest(material.m)
        if material.rigid:
            self._sites = bodies_of(m)
            stand_in = HELD_STAND_IN if can_deflate(self._sites, m.shape) else CYCLE_STAND_IN
            m = np.where(np.isinf(m), np.float32(stand_in * most), m)
        lame = self._planes(0, self._loops.parameters(material))
        exact = lame if self._exact_lame is None else self._exact_lame
        share = self._loops.write_elements(material, compiled.only_read(m), most, exact)
        if exact is not lame:
            np.copyto(lame, exact, casting="same_kind")
        compute_thread.check_cancelled()
        self._set_levels(lame)
        constants = self._loops.constants(material.shape)
        self._shape[:] = constants
        for level in self.levels:
            level.share = np.float32(share)
        finest = self.levels[0]
        finest.bodies = None
        if material.data is not None:
            finest.set_data(material.data)
            for fine, coarse in pairwise(self.levels):
                compute_thread.check_cancelled()
                fine.coarsen_data(coarse)
        #: Elements of the finest level, for the loops in double precision.
        self._exact = self._loops.exact(finest.lame if exact is lame else exact, share, constants)

    def _planes(self, number: int, parameters: int) -> Vector:
        """Return planes for the elements of a large level: its own, if it stores planes."""
        if number < len(self.levels) and self.levels[number].layout.is_whole:
            return self.levels[number].lame
        return padded(parameters, self._large[number])

    def _set_levels(self, lame: Vector) -> None:
        """Set the elements of all levels; replace the levels from the first with a new layout."""
        has_data = self.material.data is not None
        # The data term, its landmarks and rigid bodies find their sites in planes.
        whole = self._whole or has_data or self.material.rigid
        for number, grid in enumerate(self._large):
            if number > 0:
                fine, lame = lame, self._planes(number, len(lame))
                self._loops.coarsen(fine, lame)
            layout = Layout.of_tissue(lame[self._loops.SHEAR], whole)
            if number < len(self.levels) and not self.levels[number].layout.matches(layout):
                del self.levels[number:]  # free their memory before new levels are allocated
            if number == len(self.levels):
                about = number == 0, layout
                self.levels.append(CpuElasticLevel(grid, self._shape, *about, has_data=has_data))
            self.levels[number].lame = layout.packed(lame)
        little = [] if self._small is None else self._small.levels
        self.levels[len(self._large) :] = little
        for level in little:
            self._loops.coarsen(lame, level.lame)
            lame = level.lame
        if self._rest.shape != self.levels[0].inverse.shape:
            self._rest = self.levels[0].vector()

    @property
    def moves(self) -> HeldPlanes:
        """Mask of the unknown components of the finest level."""
        finest = self.levels[0]
        moves: HeldPlanes = finest.planes(finest.moving_inverse) > 0
        return moves

    def _start_cycles(self) -> None:
        for level in self.levels:
            level.start_cycles()

    def deflation(self, steps: Steps, coarsest: Steps) -> Deflation | None:
        """Return the deflation by the fields of movable bodies, or None if no body can move."""
        if self.bodies is None or not self.bodies.is_deflated:
            return None
        number = next((k for k, level in enumerate(self.levels) if level.finishes_cycle), 0)
        without_springs = None if self._small is None else self._all_pinned(self._small)
        # This method runs often while the user draws. Reuse the memory, because allocation is slow.
        fields = 2 * self.bodies.freedom
        if len(self._fields) < fields:
            self._fields = np.zeros((fields, *self.levels[0].inverse.shape), dtype=np.float32)
        levels, memory = self.levels[: number + 1], self._fields[:fields]
        return build_deflation(self.bodies, levels, without_springs, steps, coarsest, memory)

    def _all_pinned(self, small_levels: SmallLevels) -> CpuElasticLevel:
        """Return a copy of the small levels without springs, with all pinned sites prescribed."""
        finest: CpuElasticLevel = small_levels.copy().levels[0]
        assert finest.weight is not None
        finest.weight.fill(0)
        finest.hold(small_levels.levels[0].pins > 0)
        return finest

    def _balance(self, d: Planes, load: Planes | None, unit: float) -> tuple[float, float]:
        finest = self.levels[0]
        if finest.points is not None:
            load = np.zeros(d.shape) if load is None else load.copy()
            finest.add_points(d, None, load, -1.0)
        found: tuple[float, float] = self._loops.balance(
            finest, self._exact, d, load, 1 / unit, self._rest
        )
        return found

    @property
    def double_level(self) -> DoubleLevel | None:
        """Finest level for an iteration in double precision; None in images, which factorize."""
        finest = self.levels[0]
        return DoubleLevel(finest, self._exact) if finest.is_volume else None

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d at all components, in double precision."""
        finest, out = self.levels[0], np.zeros(d.shape)
        self._loops.pull(finest, self._exact, d, out)
        finest.add_data(d, None, out, -1.0)
        return out if low is None else out + self.pull(low)

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the elastic energy and the norm of the forces."""
        if self.levels[0].points is not None:
            forces = self.pull(d)
            return -float((forces * d).sum()) / 2, float(np.linalg.norm(forces))
        product, square = self._loops.work(self.levels[0], self._exact, d)
        return product / 2, math.sqrt(square)

    def review(self, values: Vector, load: Planes | None) -> Review:
        """Return what decides whether a displacement, shape (H, W, 2), is a solution."""
        finest = self.levels[0]
        is_plain = self.material.data is None and self.bodies is None
        if not (is_plain and finest.layout.is_whole and len(self.shape) == 2):
            return super().review(values, load)
        if self._tissue is None:
            self._tissue = tissue_spans(finest.lame[self._loops.SHEAR])[PAD:-PAD]
        if self._moves is None or self._moves[0] is not self.earlier:
            self._moves = self.earlier, self.moves
        masks = self._tissue, self._moves[1]
        found: Review = self._loops.review(finest, self._exact, *masks, values, load)
        return found

    @property
    def steepness(self) -> Planes:
        """Diagonal of the stiffness matrix, as planes."""
        out: Planes = self._loops.exact_diagonal(self.levels[0], self._exact)
        if self.material.data is not None:
            self.material.data.add_diagonal(out)
        return out

    def clear_cache(self) -> None:
        """Forget the model, because vectors of the model may contain non-finite values."""
        _model.clear()


_model: Kept[CpuElasticModel] = Kept(is_large=True)


def the_model(material: ElasticMaterial, whole: bool = True) -> CpuElasticModel:
    """Return the model of a material, reusing the last model if possible.

    Building a model takes as long as a few cycles, and users edit observations more often than
    tissue. Call this function only on the compute thread, because all solves share the model.
    """
    model = _model.get(
        lambda last: last.fits(material, whole), lambda: CpuElasticModel(material, whole)
    )
    if model.material != material:
        _model.clear()  # if the update is cancelled, the model is not kept
        model.assemble(material)
        _model.value = model
    return model
