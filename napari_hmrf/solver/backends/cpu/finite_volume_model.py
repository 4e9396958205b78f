"""Volumes in large motion on the processor: their energy, and their linear model.

The solved system has the exact second derivatives of the energy, which are not stored: `apply`
computes them from the displacement. Multigrid preconditions it with a simpler model, which has one
deformation gradient for each element (`brick_tangents`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.cpu import (
    bernstein,
    brick_tangents,
    finite_bricks,
    volume,
)
from napari_hmrf.solver.backends.cpu.finite_base import CALM, CpuFiniteModelBase
from napari_hmrf.solver.backends.cpu.layout import rows
from napari_hmrf.solver.backends.cpu.level import CpuLevel, Vector
from napari_hmrf.solver.backends.cpu.transfer import PAD, padded
from napari_hmrf.solver.backends.linear import HeldPlanes, Planes
from napari_hmrf.solver.backends.rigid.bodies import Bodies
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

    def _begin(self, paces: Vector) -> int:
        load, inverse, correction = map(rows, (self.load, self.inverse, self.correction))
        volume.start(load, inverse, None, correction, paces[0, 0])
        return 1

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

    def matrices(self) -> npt.NDArray[np.float64]:
        """Return the second derivatives of each element, (D - 1, H - 1, W - 1, 24, 24)."""
        elements = np.ascontiguousarray(np.argwhere(self._solid[0] > 0))
        each = np.zeros((len(elements), 24, 24))
        sides, positive = self._sides.astype(np.float64), float(self._positive)
        about = self._d, elements, self._solid, sides, positive
        finite_bricks.add_element_matrices(*about, each)
        made = np.zeros((*(size - 2 * PAD - 1 for size in self._d.shape[1:]), 24, 24))
        made[tuple((elements - PAD).T)] = each
        made[tuple((self.walled - PAD).T)] += self.walls
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

    def __init__(self, grid: tuple[int, ...], has_data: bool = False) -> None:
        self.levels: list[BrickLevel] = [
            BrickLevel(each, number == 0, has_data) for number, each in enumerate(grids(grid))
        ]
        self.shape, self.has_data = grid, has_data
        self._pull: Planes = np.zeros((3, *(size + 2 * PAD for size in grid)))
        self._energies, self._least = np.zeros((2, grid[0]))
        self._no_elements: Planes = np.zeros((0, 0, 0))

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
        self._sides = np.array(material.shape)
        self._barrier = BARRIER, BARRIER_BEGIN
        ratio = lame_ratio(material.largest_poisson, strain=True)
        self._calm = CALM * float(brick_tangents.norm_at_rest(1.0, ratio, self._sides))
        for level in self.levels:
            level.shape = self._sides.astype(np.float32)

    def energy(self, d: Planes) -> tuple[float, float]:
        """Return the energy of a displacement, and a bound below the Jacobian of all elements.

        The Jacobian is that of the elastic deformation, without growth.
        """
        about = d, self._solid, self._sides, self._barrier
        finite_bricks.energy(*about, self._energies, self._least)
        return float(self._energies.sum()), float(self._least.min())

    def least_jacobian(self, d: Planes) -> float:
        """Return a bound below the Jacobian of all elements, including growth."""
        about = d, self._solid[:2], self._sides, self._barrier  # moduli only, as without growth
        finite_bricks.energy(*about, self._energies, self._least)
        return float(self._least.min())

    def forces(self, d: Planes) -> Planes:
        """Return the gradient of the elastic energy; valid until the next call."""
        finite_bricks.forces(d, self._solid, self._sides, self._barrier, self._pull)
        return self._pull

    def linearise(
        self,
        d: Planes,
        held: HeldPlanes,
        forces: Planes,
        positive: float = 0.0,
        springs: Planes | None = None,
    ) -> None:
        """Build the linear model of small motion around a displacement; see `FiniteModel`."""
        finest, self.springs = self.levels[0], springs
        about = d, self._solid, self._sides, self._barrier, self._calm
        low = np.full(d.shape[1:], np.inf, dtype=np.float32)
        brick_tangents.tangents(*about, finest.tangent, low)
        compute_thread.check_cancelled()
        finest.exact = SecondDerivatives(d, self._solid, self._sides, low, positive)
        if self.bodies:
            assert self.material is not None
            finest.bodies = Bodies(self.bodies, self.material, held, d)
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            brick_tangents.coarsen(fine.tangent, coarse.tangent)
        at = tuple(finest.exact.walled.T)
        # Cycles use the full matrices of these elements instead.
        for plane in finest.tangent[9:12]:
            plane[at] = 0
        self._hold(held, springs)

    def length(
        self, d: Planes, way: Planes, part: float, floor: float, each: bool = False
    ) -> tuple[float, npt.NDArray[np.float64]]:
        """Return the largest step along `way` that leaves no element folded; see `FiniteModel`."""
        lengths = np.full(self._solid.shape[1:], np.inf) if each else self._no_elements
        about = d, way, self._solid, self._sides, part, floor
        finite_bricks.length(*about, self._least, lengths)
        return float(self._least.min()), lengths[_ELEMENTS] if each else lengths

    @property
    def tangents(self) -> BrickMatrices:
        """Linear model as an `Assembled` material, for direct factorizations."""
        exact = self.levels[0].exact
        assert exact is not None
        assert self.material is not None
        matrices = exact.matrices()
        self.material.add_data(matrices, tuple(slice(0, size - 1) for size in self.shape))
        return BrickMatrices(matrices)


class BrickMatrices:
    """Second derivatives of elements as an `Assembled` material.

    Parameters
    ----------
    matrices : ndarray, shape (D - 1, H - 1, W - 1, 24, 24)
        Second derivatives of each element; 0 in void.
    """

    patch = 2
    margin = 0
    symmetric = True

    def __init__(self, matrices: npt.NDArray[np.float64]) -> None:
        self._matrices = matrices

    @property
    def parts(self) -> tuple[tuple[tuple[int, ...], Any], ...]:
        """Single part with all components, and the function that returns its matrices."""
        return (((0, 1, 2), lambda *elements: self._matrices[elements]),)


_model: Kept[CpuFiniteVolumeModel] = Kept(is_large=True)


def the_model(material: FiniteMaterial) -> CpuFiniteVolumeModel:
    """Return the model of a material, in the memory of the last model if the grid is the same."""
    grid, has_data = tuple(material.m.shape), material.data is not None
    model = _model.get(
        lambda last: last.fits(material), lambda: CpuFiniteVolumeModel(grid, has_data)
    )
    model.assemble(material)
    return model
