"""Volumes in large motion on the processor: their energy, and their linear model.

The solved system has the exact second derivatives of the energy, which are not stored: `apply`
computes them from the displacement. Multigrid preconditions it with a simpler model, which has one
deformation gradient for each element (`brick_tangents`).
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.solver.backends.cpu import (
    bernstein,
    brick_tangents,
    finite_bricks,
)
from napari_hmrf.solver.backends.cpu.finite_base import CALM, CpuFiniteModelBase
from napari_hmrf.solver.backends.cpu.layout import rows
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector
from napari_hmrf.solver.backends.cpu.transfer import PAD, padded
from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.coarse_levels import grids
from napari_hmrf.solver.priors.elements import CYCLE_STAND_IN, lame_ratio
from napari_hmrf.solver.priors.finite_bricks import brick_moduli
from napari_hmrf.solver.priors.finite_strain import BARRIER, BARRIER_BEGIN, FiniteMaterial

# Index of the elements in padded arrays.
_ELEMENTS = (slice(PAD, -PAD - 1),) * 3
# Components of the matrix G in the order of `finite_bricks`.
_UPPER = (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)
# Number of planes of elements whose moduli are computed together.
_SLAB = 16


class BrickLevel(CpuLevel):
    """Tangents and springs of one level; see `CpuLevel`.

    Parameters
    ----------
    grid : tuple of int
        Grid of the level, (D, H, W).
    finest : bool
        True for the finest level, whose `apply` uses the exact second derivatives.
    has_data : bool
        True for a problem with a data term.

    Attributes
    ----------
    tangent : ndarray, shape (13, D + 4, H + 4, W + 4)
        Numbers of each element; see `brick_tangents`.
    shape : ndarray
        Constants of the loops for the shape of a voxel.
    exact : SecondDerivatives or None
        Second derivatives of the solved system; None on coarser levels.
    """

    sums_up = True
    shape: Vector

    def __init__(self, grid: tuple[int, ...], finest: bool, has_data: bool) -> None:
        super().__init__(grid, finest)
        self.steps_at_once = 1
        self.tangent = padded(int(brick_tangents.PLANES), grid)
        self.exact: SecondDerivatives | None = None
        if has_data:
            self.allow_data()

    def write_diagonal(self, out: Vector) -> None:
        """Write the diagonal of the matrix for cycles to `out`."""
        brick_tangents.diagonal(self.tangent, self.shape, out)
        if self.exact is not None:
            bernstein.add_diagonals(self.exact.walled, self.exact.safe_walls, out)

    def _smooth(self, paces: Vector) -> None:
        (pace,) = paces
        weight, springs = self._springs
        self._apply_simply(self.correction, self._rest)
        arrays = map(rows, (self.correction, self.load, self._rest, self.inverse, weight))
        brick_tangents.smooth(*arrays, springs, rows(self._other), *pace)

    def _apply_simply(self, d: Vector, image: Vector) -> None:
        """Compute the product of the matrix for cycles, without springs, and a displacement."""
        brick_tangents.image(d, self.tangent, self.shape, image)
        if self.exact is not None:
            bernstein.add_images(d, self.exact.walled, self.exact.safe_walls, image)

    def _write_rest(self) -> Vector:
        weight, springs = self._springs
        self._apply_simply(self.correction, self._rest)
        about = map(rows, (self._rest, self.inverse, weight))
        arrays = rows(self.correction), rows(self.load), np.float32(1)
        brick_tangents.rest(*arrays, *about, springs, np.float32(1), rows(self._rest))
        return self._rest

    def apply(self, direction: Vector, image: Vector) -> float:
        """Compute ``image = A @ direction`` for the solved system; return their product."""
        assert self.exact is not None
        self.exact.apply(direction, image)
        weight, springs = self._springs
        about = map(rows, (image, self.inverse, weight))
        arrays = rows(direction), rows(direction), np.float32(0)
        brick_tangents.rest(*arrays, *about, springs, np.float32(-1), rows(image))
        if self.data is not None:
            return self._add_data_image(direction, image)
        return self.product(direction, image)


class SecondDerivatives:
    """Second derivatives of the energy of a volume at a displacement.

    Parameters
    ----------
    d : ndarray, planes
        Displacement, in voxels; read at each call, so it must not change.
    solid : ndarray, shape (2 or 8, D + 4, H + 4, W + 4)
        Moduli of the elements; see `finite_bricks`.
    shape : BrickShape
    low : ndarray, shape (D + 4, H + 4, W + 4)
        Bound below the Jacobian of each element, from `brick_tangents.tangents`.
    positive : float
        Part of the indefinite terms that is left out, from 0 to 1.
    """

    def __init__(
        self,
        d: Planes,
        solid: npt.NDArray[Any],
        shape: Any,
        low: npt.NDArray[np.float32],
        positive: float,
    ) -> None:
        self._d, self._solid, self._positive = d, solid, np.float32(positive)
        self._sides = np.array(shape, dtype=np.float32)
        sides = np.array(shape)
        #: Indices (z, y, x) of the elements whose barrier acts, in padded arrays.
        self.walled = np.ascontiguousarray(np.argwhere(low < BARRIER_BEGIN))
        at = tuple(self.walled.T)
        gains = _gains(solid, at)
        scales = BARRIER * solid[0][at].astype(np.float64)
        #: Second derivatives of the barrier of these elements.
        self.walls = np.zeros((len(self.walled), 24, 24), dtype=np.float32)
        about = d, self.walled, gains, scales, sides, BARRIER_BEGIN
        bernstein.barrier_matrices(*about, positive, self.walls)
        #: The same without their indefinite part, for cycles.
        self.safe_walls = self.walls.copy() if positive == 1 else np.zeros_like(self.walls)
        if positive < 1:
            bernstein.barrier_matrices(*about, 1.0, self.safe_walls)
        finite_bricks.add_element_matrices(d, self.walled, solid, sides, 1.0, self.safe_walls)

    def matrices(self, box: tuple[slice, ...]) -> npt.NDArray[np.float64]:
        """Return the second derivatives of the elements in a box, shape (d, h, w, 24, 24)."""
        sizes = (size - 2 * PAD - 1 for size in self._d.shape[1:])
        ranges = [side.indices(size) for side, size in zip(box, sizes, strict=True)]
        first = np.array([start for start, _, _ in ranges])
        inner = tuple(slice(start + PAD, stop + PAD) for start, stop, _ in ranges)
        shear = self._solid[0][inner]
        elements = np.ascontiguousarray(np.argwhere(shear > 0) + first + PAD)
        each = np.zeros((len(elements), 24, 24))
        sides, positive = self._sides.astype(np.float64), float(self._positive)
        about = self._d, elements, self._solid, sides, positive
        finite_bricks.add_element_matrices(*about, each)
        made = np.zeros((*shear.shape, 24, 24))
        made[tuple((elements - PAD - first).T)] = each
        at = self.walled - PAD - first
        is_here = np.all((at >= 0) & (at < shear.shape), axis=1)
        made[tuple(at[is_here].T)] += self.walls[is_here]
        return made

    def apply(self, direction: Vector, image: Vector) -> None:
        """Compute the product with a direction."""
        finite_bricks.image(self._d, direction, self._solid, self._sides, self._positive, image)
        compute_thread.check_cancelled()
        bernstein.add_images(direction, self.walled, self.walls, image)


def _gains(
    solid: npt.NDArray[np.float32], at: tuple[npt.NDArray[np.intp], ...]
) -> npt.NDArray[np.float64]:
    """Return the determinant of the matrix G of some elements."""
    undo = np.zeros((len(at[0]), 3, 3)) + np.eye(3)
    for plane, (i, j) in zip(solid[2:], _UPPER, strict=False):
        undo[:, i, j] = undo[:, j, i] = plane[at]
    return np.asarray(np.linalg.det(undo))


class CpuFiniteVolumeModel(CpuFiniteModelBase):
    """`FiniteModel` of a volume on the processor.

    Parameters
    ----------
    grid : tuple of int
        Grid, (D, H, W).
    has_data : bool
        True for a problem with a data term.
    """

    loops: ClassVar[Any] = finite_bricks
    coarsen: ClassVar[Any] = staticmethod(brick_tangents.coarsen)

    def __init__(self, grid: tuple[int, ...], has_data: bool = False) -> None:
        levels = [
            BrickLevel(each, number == 0, has_data) for number, each in enumerate(grids(grid))
        ]
        super().__init__(levels, has_data)

    def _set_material(self, material: FiniteMaterial) -> None:
        self._solid = padded(2 if material.growth is None else 8, self.shape)
        parts = [values[_ELEMENTS] for values in self._solid]
        # Slabs, because the moduli of a whole volume in double precision need much memory.
        for first in range(0, self.shape[0] - 1, _SLAB):
            slab = slice(first, first + _SLAB)
            moduli = brick_moduli(material, CYCLE_STAND_IN, slice(first, first + _SLAB + 1))
            parts[0][slab], parts[1][slab] = moduli.shear, moduli.first
            if moduli.undo is not None:
                for part, (i, j) in zip(parts[2:], _UPPER, strict=True):
                    part[slab] = moduli.undo[..., i, j]
        sides = np.array(material.shape)
        self._elements = self._solid, sides, (BARRIER, BARRIER_BEGIN)
        ratio = lame_ratio(material.largest_poisson, strain=True)
        self._calm = CALM * float(brick_tangents.norm_at_rest(1.0, ratio, sides))
        for level in self.levels:
            level.shape = sides.astype(np.float32)

    def least_jacobian(self, d: Planes) -> float:
        """Return a bound below the Jacobian of all elements, including growth."""
        # The first two planes are moduli; without the others, tissue has not grown.
        return self._energy(d, self._solid[:2], *self._elements[1:])[1]

    def _write_tangents(self, d: Planes, positive: float) -> None:
        finest = self.levels[0]
        low = np.full(d.shape[1:], np.inf, dtype=np.float32)
        brick_tangents.tangents(d, *self._elements, self._calm, finest.tangent, low)
        compute_thread.check_cancelled()
        solid, sides, _ = self._elements
        finest.exact = SecondDerivatives(d, solid, sides, low, positive)

    def _coarsen_tangents(self) -> None:
        super()._coarsen_tangents()
        # Cycles use the full matrices of these elements instead.
        finest = self.levels[0]
        at = tuple(finest.exact.walled.T)
        for plane in finest.tangent[9:12]:
            plane[at] = 0

    @property
    def tangents(self) -> BrickMatrices:
        """Linear model as an `Assembled` material, for direct factorizations."""
        exact = self.levels[0].exact
        assert exact is not None
        assert self.material is not None
        return BrickMatrices(exact, self.material)


class BrickMatrices:
    """Second derivatives of elements as an `Assembled` material.

    Parameters
    ----------
    exact : SecondDerivatives
    material : FiniteMaterial
        Material, whose data term is added.
    """

    patch = 2
    margin = 0
    symmetric = True

    def __init__(self, exact: SecondDerivatives, material: FiniteMaterial) -> None:
        self._exact, self._material = exact, material

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], Any], ...]:
        """The only part: all components, and the function that returns matrices."""
        return (((0, 1, 2), self._matrices),)

    def _matrices(self, *box: slice) -> npt.NDArray[np.float64]:
        matrices = self._exact.matrices(box)
        self._material.add_data(matrices, box)
        return matrices
