"""Tissue that moves far on the processor: its energy, and the linear model of where it is.

Every Newton step has a linear model of its own, with a tangent for each element; its levels are the
same model again, of tangents averaged. The levels' memory stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import finite_strain, tangents, vectors
from napari_hmrf.solver.backends.cpu.forces import parts
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector, paces_of
from napari_hmrf.solver.backends.linear import Balance, HeldPlanes, Planes, Steps
from napari_hmrf.solver.backends.thread import in_child_of_fork
from napari_hmrf.solver.coarse_levels import grids, smoother_bounds
from napari_hmrf.solver.priors.elements import ElasticMaterial, lame_parameters
from napari_hmrf.solver.priors.finite_strain import BARRIER, BARRIER_BEGIN, moduli_of

# A level of fewer sites is visited by one thread, with all below, but for the first two.
_SMALL, _LARGE = 8000, 2
# How far the spectrum of strained tissue exceeds that of tissue at rest: usually, and at most.
_STRAINED, _WORST = 1.3, 2.0
_CYCLED, _ALL = 14, 21
# How much of its spread counts, where an element shares its sites with others.
_CALM = 0.75


class TangentLevel(CpuLevel):
    """One level's tangents and springs; see `CpuLevel`.

    Attributes
    ----------
    cycled : ndarray, shape (14, H + 4, W + 4)
        The tangents that cycles go by, and their damping.
    solved : ndarray, shape (21, H + 4, W + 4), or None
        Those that are solved for, on the finest level.
    coupled : bool
        Whether any twist is coupled to a stretch.
    """

    def __init__(self, grid: tuple[int, ...], finest: bool, memory: Any = None) -> None:
        super().__init__(grid, None if memory is None else iter(memory.vectors))
        self.pins = self.vector()
        self.weight = None if finest else self.vector()
        if memory is None:
            self._left = self.vector()
            self.cycled = np.zeros((_CYCLED, *self.inverse.shape[1:]), dtype=np.float32)
        else:
            self._left, self.cycled = memory.rest, memory.cycled
        self._memory = None
        self.solved = np.zeros((_ALL, *self.inverse.shape[1:]), np.float32) if finest else None
        self.spans = np.zeros((grid[0], 2), dtype=np.int64)
        self.parts = parts(grid[0])
        self.together: _SmallLevels | None = None

    def hold(self, held: HeldPlanes) -> None:
        """Hold components on the finest level."""
        tangents.diagonal(self.cycled, self.inverse)
        vectors.hold(self.inverse, held, self.pins, self.spans)

    def hold_as(self, finer: TangentLevel) -> None:
        """Put the sites near those that the finer level holds on springs."""
        tangents.diagonal(self.cycled, self.inverse)
        self._spring(finer)

    def relax(self, steps: Steps, from_zero: bool) -> None:
        """Chebyshev-Jacobi steps on `correction` for `load`."""
        paces = paces_of(steps, from_zero)
        if from_zero:
            tangents.start(self.load, self.inverse, paces[0, 0], self.correction)
            paces = paces[1:]
        about = self.load, self.cycled, self.inverse, *self._springs
        for pace in paces:
            tangents.smooth(self.correction, *about, self._other, *pace, self.parts)
            self.correction, self._other = self._other, self.correction

    def _hand_down(self, coarse: TangentLevel) -> None:
        about = self.load, self.cycled, self.inverse, *self._springs
        tangents.rest(self.correction, *about, self._left, self.parts)
        self._restrict(self._left, coarse.load)

    def finish(self, steps: Steps, coarsest: Steps) -> None:
        """Find the correction with all coarser levels, or as the coarsest."""
        if self.together is None:
            super().finish(steps, coarsest)
        else:
            self.correction = self.together.cycle(steps, coarsest)

    @property
    def spare_correction(self) -> Vector:
        """Where `relax` writes, in turn with `correction`."""
        return self._other

    def apply(self, direction: Vector, image: Vector) -> float:
        """Image = A direction, of what is solved; their scalar product."""
        about = direction, self.solved, self.inverse, True, image, self._rows
        tangents.apply(*about, self.parts)
        return float(self._rows.sum())


class _Memory:
    """Where a small level lies."""

    def __init__(self, values: npt.NDArray[np.float32], grid: tuple[int, ...]) -> None:
        planes = values.reshape(tangents.PLANES, grid[0] + 4, grid[1] + 4)
        arrays = [planes[2 * number : 2 * number + 2] for number in range(7)]
        inverse, load, correction, other, pins, weight, self.rest = arrays
        self.vectors = [inverse, load, correction, other, pins, weight]
        self.cycled = planes[14:]


class _SmallLevels:
    """The memory of levels that are visited in one go, and that visit."""

    def __init__(self, every: Sequence[tuple[int, ...]]) -> None:
        sizes = [tangents.PLANES * (height + 4) * (width + 4) for height, width in every]
        starts = np.cumsum([0, *sizes])
        self._values = np.zeros(starts[-1], dtype=np.float32)
        self._table = np.array([(*grid, start) for grid, start in zip(every, starts, strict=False)])
        self.levels = []
        for grid, start, size in zip(every, starts, sizes, strict=False):
            memory = _Memory(self._values[start : start + size], grid)
            self.levels.append(TangentLevel(grid, False, memory))
        first = self.levels[0]
        self._pair = first.correction, first.spare_correction
        first.together, first.takes_rest = self, True

    def cycle(self, steps: Steps, coarsest: Steps) -> Vector:
        """Return the first level's correction for its load."""
        tangents.cycle(
            self._values,
            self._table,
            paces_of(steps, from_zero=True),
            paces_of(steps, from_zero=False),
            paces_of(coarsest, from_zero=True),
        )
        number = len(coarsest) if len(self.levels) == 1 else 2 * len(steps)
        return self._pair[0 if number % 2 == 1 else 1]


class CpuFiniteModel:
    """`FiniteModel` on the processor.

    Parameters
    ----------
    grid : tuple of int
    """

    def __init__(self, grid: tuple[int, ...]) -> None:
        every = grids(grid)
        few = next((k for k, (height, width) in enumerate(every) if height * width < _SMALL), 0)
        large, little = every[: max(few, _LARGE)], every[max(few, _LARGE) :]
        self.levels = [TangentLevel(each, number == 0) for number, each in enumerate(large)]
        if little:
            self.levels += _SmallLevels(little).levels
        self.shape = grid
        size = tuple(side + 4 for side in grid)
        self._moduli: Planes = np.zeros((3, *size))
        self._pull: Planes = np.zeros((2, *size))
        self._energies, self._least = np.zeros((2, grid[0]))
        self._none: Planes = np.zeros((0, 0))
        self._parts = parts(grid[0])
        self.material: ElasticMaterial | None = None

    def assemble(self, material: ElasticMaterial) -> None:
        """Take a material of the same grid."""
        self.material = material
        lame = lame_parameters(material.relative(1.0), material.poisson, material.strain)
        shear, first, twist, bulges = moduli_of(lame, material.shape)
        for plane, values in zip(self._moduli, (shear, first, twist), strict=True):
            plane[2:-3, 2:-3] = values
        rows, cols = np.sqrt(material.shape.rows), np.sqrt(material.shape.cols)
        self._about = float(rows), float(cols), bulges, BARRIER, BARRIER_BEGIN
        usual, _ = smoother_bounds(material)
        self._calm = _CALM * self._spread(material)
        self.bounds = _STRAINED * usual, _WORST * usual
        for level in self.levels:
            level.cycled.fill(0)
        self.levels[0].solved.fill(0)  # type: ignore[union-attr]

    def _spread(self, material: ElasticMaterial) -> float:
        """How wide the spectrum of an element at rest is."""
        nu = material.largest_poisson
        one = lame_parameters(np.ones((2, 2)), nu, material.strain)
        shear, first, twist, bulges = moduli_of(one, material.shape)
        about = *self._about[:2], bulges, *self._about[3:]
        size = np.zeros((5, 5))
        moduli = [size.copy() for _ in range(3)]
        for plane, value in zip(moduli, (shear, first, twist), strict=True):
            plane[2, 2] = value[0, 0]
        solved, cycled = np.zeros((21, 5, 5), np.float32), np.zeros((14, 5, 5), np.float32)
        finite_strain.tangents(np.zeros((2, 5, 5)), *moduli, about, False, 1.0, solved, cycled, 1)
        return float(finite_strain.spread(cycled[:13, 2, 2].astype(np.float64)))

    def energy(self, d: Planes) -> tuple[float, float]:
        """The energy of a displacement, and the least Jacobian of any corner."""
        self._work(finite_strain.energy, d, self._energies, self._least)
        return float(self._energies.sum()), float(self._least.min())

    def forces(self, d: Planes) -> Planes:
        """The derivative of the energy by all components; valid until the next call."""
        self._work(finite_strain.forces, d, self._pull)
        return self._pull

    def linearise(self, d: Planes, held: HeldPlanes, positive: bool = False) -> None:
        """Make the levels those of small motion around a displacement, with what is held."""
        finest = self.levels[0]
        self._work(finite_strain.tangents, d, positive, self._calm, finest.solved, finest.cycled)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            tangents.coarsen(fine.cycled, coarse.cycled)
        finest.hold(held)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            coarse.hold_as(fine)

    def balance(self, rest: Planes) -> Balance:
        """A load, as iterations take it, 0 where nothing moves."""
        rest = np.where(self.levels[0].inverse > 0, rest, 0.0)
        most = float(np.abs(rest).max())
        unit = most if most > 0 else 1.0
        scaled = (rest / unit).astype(np.float32)
        square = float(np.square(scaled, dtype=np.float64).sum())
        return Balance(scaled, unit, most, unit * math.sqrt(square))

    def image(self, way: Planes) -> Planes:
        """What the linear model pulls with along a way, where components move."""
        finest = self.levels[0]
        image = finest.vector()
        finest.apply(way.astype(np.float32), image)
        made = image.astype(np.float64)
        finest.free(image)
        return made

    def length(
        self, d: Planes, way: Planes, part: float, floor: float, each: bool = False
    ) -> tuple[float, npt.NDArray[np.float64]]:
        """How far along a way all corners keep a part of their Jacobian, and stay above a floor."""
        lengths = np.full(self._moduli.shape[1:], np.inf) if each else self._none
        about = d, way, self._moduli[0], self._about, part, floor
        finite_strain.length(*about, self._least, lengths, self._parts)
        return float(self._least.min()), lengths[2:-3, 2:-3] if each else lengths

    @property
    def moves(self) -> HeldPlanes:
        """Which components are unknown in the linear model."""
        moves: HeldPlanes = self.levels[0].inverse > 0
        return moves

    @property
    def tangents(self) -> Tangents:
        """The linear model as factors take it."""
        solved = self.levels[0].solved
        assert solved is not None
        return Tangents(solved[:, 2:-3, 2:-3])

    def clear(self) -> None:
        """Make all corrections zero: numbers may have overflowed."""
        for level in self.levels:
            level.clear()

    def _work(self, kernel: Any, d: Planes, *others: Any) -> None:
        kernel(d, *self._moduli, self._about, *others, self._parts)


class Tangents:
    """The tangents of elements as an `Assembled` material.

    Parameters
    ----------
    numbers : ndarray, shape (21, H - 1, W - 1)
    """

    patch = 2
    margin = 0
    symmetric = True

    def __init__(self, numbers: npt.NDArray[np.float32]) -> None:
        self._numbers = numbers

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], Any], ...]:
        """Both components at once, and what gives the matrices of elements, (h, w, 8, 8)."""
        return (((0, 1), self._matrices),)

    def _matrices(self, rows: slice, cols: slice) -> npt.NDArray[np.float64]:
        numbers = self._numbers[:, rows, cols].astype(np.float64)
        tangent = np.moveaxis(numbers[_WHERE], (0, 1), (-2, -1))
        return np.asarray(_DIFFERENCES.T @ tangent @ _DIFFERENCES)


# Of the tangent's 21 numbers, which stands where among D_r, D_c and D_x, two components each.
_WHERE = np.array(
    [
        [0, 1, 6, 7, 13, 14],
        [1, 2, 8, 9, 15, 16],
        [6, 8, 3, 4, 17, 18],
        [7, 9, 4, 5, 19, 20],
        [13, 15, 17, 19, 10, 11],
        [14, 16, 18, 20, 11, 12],
    ]
)
# D_r, D_c and D_x of the corners 00, 01, 10 and 11, for each component.
_SIGNS = np.array([[-1, -1, 1, 1], [-1, 1, -1, 1], [1, -1, -1, 1]], dtype=np.float64)
_DIFFERENCES = np.kron(_SIGNS, np.eye(2))


_last: list[CpuFiniteModel] = []
in_child_of_fork(_last.clear)


def the_model(material: ElasticMaterial) -> CpuFiniteModel:
    """Return the model of a material: the last one, if it is the same tissue again."""
    if not _last or _last[0].shape != material.m.shape:
        _last[:] = ()  # its memory, first
        _last.append(CpuFiniteModel(tuple(material.m.shape)))
    if _last[0].material != material:
        _last[0].assemble(material)
    return _last[0]
