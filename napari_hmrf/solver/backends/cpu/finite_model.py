"""Large-motion model on the processor: its energy, and its linearization.

Each Newton step requires a new linear model, with one tangent per element. The tangents of coarser
levels are averages. All linear models share the same memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu import finite_strain, finite_tangents, tangents
from napari_hmrf.solver.backends.cpu.finite_base import CALM, CpuFiniteModelBase
from napari_hmrf.solver.backends.cpu.forces import parts
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector
from napari_hmrf.solver.backends.cpu.small_levels import SmallLevels, divided
from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.backends.rigid.bodies import rigid_elements
from napari_hmrf.solver.coarse_levels import grids
from napari_hmrf.solver.priors.elements import CYCLE_STAND_IN, lame_parameters
from napari_hmrf.solver.priors.finite_strain import (
    BARRIER,
    BARRIER_BEGIN,
    FiniteMaterial,
    moduli_of,
)

# Numbers per element: tangent for cycles with its damping, full tangent, and elastic parameters
# (`finite_strain`).
_CYCLED, _ALL, _OF_SOLID = int(tangents.PLANES), 21, 7
# Relative stiffness added to rigid tissue in direct factorizations. The next Newton step corrects
# the error that this causes.
_FIRMER = 20.0


class TangentLevel(CpuLevel):
    """Level with tangents and springs; see `CpuLevel`.

    Attributes
    ----------
    tangent : ndarray, shape (14, H + 4, W + 4)
        Tangents for cycles, and their damping.
    solved : ndarray, shape (21, H + 4, W + 4), or None
        Tangents of the linear system; None on coarser levels.
    """

    def __init__(
        self,
        grid: tuple[int, ...],
        memory: Mapping[str, Vector] | None = None,
        *,
        finest: bool = False,
        has_data: bool = False,
    ) -> None:
        super().__init__(grid, finest, memory=memory)
        shape = self.inverse.shape[1:]
        if memory is None:
            self.tangent = _planes(_CYCLED, shape)
        else:
            self.tangent = memory["own"][:_CYCLED]
            self.mixed = memory["own"][_CYCLED:] if has_data else None
        if has_data:
            self.allow_data()
        self.solved = _planes(_ALL, shape) if finest else None
        self.parts = parts(grid[0])

    def write_diagonal(self, out: Vector) -> None:
        """Write the diagonal of the matrix for cycles to `out`."""
        tangents.diagonal(self.tangent, out)

    @property
    def _system(self) -> tuple[Any, ...]:
        """Load, tangents and springs, for the loops."""
        return self.load, self.tangent, self.inverse, *self._springs

    def _begin(self, paces: Vector) -> int:
        tangents.start(self.load, self.inverse, paces[0, 0], self.correction)
        return 1

    def _smooth(self, paces: Vector) -> None:
        (pace,) = paces
        tangents.smooth(self.correction, *self._system, self._other, *pace, self.parts)

    def _write_rest(self) -> Vector:
        tangents.rest(self.correction, *self._system, self._rest, self.parts)
        return self._rest

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction`` for the full system; return ``direction . image``."""
        about = direction, self.solved, self.inverse, *self._springs, image, self._rows
        tangents.apply(*about, self.parts)
        if self.data is not None:
            return self._add_data_image(direction, image)
        return float(self._rows.sum())


def _planes(count: int, shape: tuple[int, ...]) -> Vector:
    return np.zeros((count, *shape), dtype=np.float32)


class CpuFiniteModel(CpuFiniteModelBase):
    """`FiniteModel` of an image on the processor.

    Parameters
    ----------
    grid : tuple of int
        Grid, (H, W).
    has_data : bool
        True for a problem with a data term.
    """

    loops: ClassVar[Any] = finite_strain
    coarsen: ClassVar[Any] = staticmethod(tangents.coarsen)

    def __init__(self, grid: tuple[int, ...], has_data: bool = False) -> None:
        large, little = divided(grids(grid))
        levels = [
            TangentLevel(each, finest=number == 0, has_data=has_data)
            for number, each in enumerate(large)
        ]
        if little:
            level = partial(TangentLevel, has_data=has_data)
            cycle = tangents.data_cycle if has_data else tangents.cycle
            planes = int(tangents.DATA_PLANES if has_data else tangents.PLANES)
            levels += SmallLevels(little, planes, level, cycle).levels
        super().__init__(levels, has_data)
        self._solid: Planes = np.zeros((_OF_SOLID, *self._pull.shape[1:]))
        self._parts = (parts(grid[0]),)

    def _set_material(self, material: FiniteMaterial) -> None:
        moduli = material.moduli(CYCLE_STAND_IN)
        for plane, values in zip(self._solid, moduli.numbers, strict=True):
            plane[2:-3, 2:-3] = values
        self._stored = moduli.stored
        rows, cols = np.sqrt(material.shape.rows), np.sqrt(material.shape.cols)
        about = float(rows), float(cols), moduli.bulges, BARRIER, BARRIER_BEGIN
        self._elements = self._solid, about
        self._calm = CALM * self._spread(material)
        for level in self.levels:
            level.tangent.fill(0)
        self._solved.fill(0)
        self._rigid = rigid_elements(material.m, self.bodies)
        self._stiff = np.zeros((_ALL, 0), dtype=np.float32)

    @property
    def _solved(self) -> Vector:
        """Tangents of the linear system without border, shape (21, H - 1, W - 1)."""
        solved = self.levels[0].solved
        assert solved is not None
        elements: Vector = solved[:, 2:-3, 2:-3]
        return elements

    def _spread(self, material: FiniteMaterial) -> float:
        """Return the norm of the scaled matrix of an element at rest; see `finite_tangents`."""
        nu = material.largest_poisson
        one = lame_parameters(np.ones((2, 2)), nu, material.strain)
        solid = np.zeros((_OF_SOLID, 5, 5))
        for plane, values in zip(solid, moduli_of(one, material.shape).numbers, strict=True):
            plane[2:3, 2:3] = values
        solved, cycled = _planes(_ALL, (5, 5)), _planes(_CYCLED, (5, 5))
        still: Planes = np.zeros((2, 5, 5))
        finite_tangents.tangents(still, solid, self._elements[1], 0.0, 1.0, solved, cycled, 1)
        return float(finite_tangents.spread(cycled[:13, 2, 2].astype(np.float64)))

    def least_jacobian(self, d: Planes) -> float:
        """Return the smallest Jacobian at any element corner, including growth."""
        return self.energy(d)[1]

    def _write_tangents(self, d: Planes, positive: float) -> None:
        finest = self.levels[0]
        about = positive, self._calm, finest.solved, finest.tangent
        finite_tangents.tangents(d, *self._elements, *about, *self._parts)

    def _stiffen_bodies(self, d: Planes, forces: Planes, positive: float) -> None:
        """Add the rotational stiffness of bodies that results from the current forces on them."""
        rigid = self._rigid > 0
        # Remove the terms that make tangents positive definite: they resist rigid rotations.
        shear = self._solid[finite_strain.SHEAR, 2:-3, 2:-3]
        self._add_isotropic_stress(rigid, -positive * finite_tangents.LEAST * shear[rigid])
        self._stiff = self._solved[:, rigid]
        sides = self.material.shape.sides  # type: ignore[union-attr]
        for number, (row, col) in enumerate(self.bodies, 1):
            at = np.s_[:, row + 2, col + 2]
            places = np.stack([row, col]) * np.array(sides)[:, None] + d[at]
            places -= places.mean(axis=1, keepdims=True)
            here = self._rigid == number
            more = -float((forces[at] * places).sum()) / (2 * int(here.sum()))
            if more < 0:
                more *= 1 - positive
            self._add_isotropic_stress(here, more)

    def _add_isotropic_stress(self, elements: npt.NDArray[np.bool_], more: Any) -> None:
        """Add the geometric stiffness of an isotropic stress, which also resists rotations."""
        shape = self.material.shape  # type: ignore[union-attr]
        for numbers, share in (((0, 2), shape.rows), ((3, 5), shape.cols)):
            for number in numbers:
                self._solved[number][elements] += share * more

    @property
    def tangents(self) -> Tangents:
        """Linear model as an `Assembled` material, for direct factorizations."""
        assert self.material is not None
        if not self.bodies:
            return Tangents(self._solved, self.material)
        numbers = self._solved.copy()
        numbers[:, self._rigid > 0] += _FIRMER * self._stiff
        return Tangents(numbers, self.material)


class Tangents:
    """Tangents of the elements as an `Assembled` material.

    Parameters
    ----------
    numbers : ndarray, shape (21, H - 1, W - 1)
        Tangent of each element; see `finite_tangents`.
    material : FiniteMaterial
        Material, whose data term is added.
    """

    patch = 2
    margin = 0
    symmetric = True

    def __init__(self, numbers: npt.NDArray[np.float32], material: FiniteMaterial) -> None:
        self._numbers, self._material = numbers, material

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], Any], ...]:
        """The only part: both components, and the function that returns matrices (h, w, 8, 8)."""
        return (((0, 1), self._matrices),)

    def _matrices(self, rows: slice, cols: slice) -> npt.NDArray[np.float64]:
        numbers = self._numbers[:, rows, cols].astype(np.float64)
        tangent = np.moveaxis(numbers[_WHERE], (0, 1), (-2, -1))
        matrices = np.asarray(_DIFFERENCES.T @ tangent @ _DIFFERENCES)
        self._material.add_data(matrices, (rows, cols))
        return matrices


# Index into the 21 numbers of a tangent for each pair of D_r, D_c and D_x, two components each.
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
# Coefficients of the corners 00, 01, 10 and 11 in D_r, D_c and D_x, for one component.
_SIGNS = np.array([[-1, -1, 1, 1], [-1, 1, -1, 1], [1, -1, -1, 1]], dtype=np.float64)
_DIFFERENCES = np.kron(_SIGNS, np.eye(2))
