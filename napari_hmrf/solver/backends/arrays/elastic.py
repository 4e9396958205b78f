"""Elastic tissue as arrays: its levels and its forces in double precision."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.solver.backends.arrays.level import ArrayLevel, Vector
from napari_hmrf.solver.backends.arrays.model import ArrayModel
from napari_hmrf.solver.backends.linear import Planes
from napari_hmrf.solver.backends.rigid.bodies import bodies_of
from napari_hmrf.solver.coarse_levels import grids, smoother_bounds
from napari_hmrf.solver.priors.elements import (
    CYCLE_STAND_IN,
    ElasticMaterial,
    ElementShape,
    Lame,
    element_forces,
    lame_parameters,
)

Float64Array = npt.NDArray[np.float64]


class ArrayElasticLevel(ArrayLevel):
    """Elements and springs of one level.

    Parameters
    ----------
    grid : tuple of int
        Grid of the level, (H, W).
    lame : ndarray, shape (2, H + 4, W + 4)
        Lame parameters of the elements, in double precision; 0 in void.
    shape : ElementShape
    finest : bool
        True for the finest level.
    """

    def __init__(
        self, grid: tuple[int, ...], lame: Float64Array, shape: ElementShape, finest: bool
    ) -> None:
        super().__init__(grid, finest)
        self.lame: Vector = lame.astype(np.float32)
        self.steep = self.diagonal = diagonal(lame, shape).astype(np.float32)


class ArrayElasticModel(ArrayModel):
    """NumPy implementation of the host's part of `LinearModel` for elastic tissue.

    Parameters
    ----------
    material : ElasticMaterial
    """

    def __init__(self, material: ElasticMaterial) -> None:
        super().__init__(material)
        self.bounds = smoother_bounds(material)
        self._sites = bodies_of(material.m) if material.rigid else None
        m = material.relative(CYCLE_STAND_IN)
        self._elements = lame_parameters(m, material.poisson, material.strain)
        lame = np.zeros((2, *(size + 4 for size in m.shape)))
        lame[:, 2:-3, 2:-3] = self._elements
        self.levels = []
        for number, grid in enumerate(grids(m.shape)):
            if number > 0:
                lame = _coarser(lame, grid)
            self.levels.append(ArrayElasticLevel(grid, lame, material.shape, number == 0))
        self._rest = self.levels[0].vector()

    def pull(self, d: Planes, low: Planes | None = None) -> Planes:
        """Return -A d at all components, in double precision."""
        inner = np.moveaxis(d[:, 2:-2, 2:-2], 0, -1)
        made: Planes = np.zeros(d.shape)
        forces = element_forces(Lame(*self._elements), self.material.shape, inner)
        made[:, 2:-2, 2:-2] = -np.moveaxis(forces, -1, 0)
        return made if low is None else made + self.pull(low)

    def work(self, d: Planes) -> tuple[float, float]:
        """Return the elastic energy, and the norm of the forces."""
        pulls = self.pull(d)
        return -float((d * pulls).sum()) / 2, float(np.linalg.norm(pulls))

    @property
    def steepness(self) -> Planes:
        """Diagonal of the stiffness matrix, planes."""
        lame = np.zeros((2, *(size + 4 for size in self.shape)))
        lame[:, 2:-3, 2:-3] = self._elements
        return diagonal(lame, self.material.shape)

    def clear_cache(self) -> None:
        """Clear the model cache."""
        _model.clear()


def diagonal(lame: Float64Array, shape: ElementShape) -> Float64Array:
    """Return the diagonal of the stiffness matrix, as planes, from the Lame parameters."""
    total = np.zeros_like(lame)
    total[:, 1:, 1:] = lame[:, 1:, 1:] + lame[:, 1:, :-1] + lame[:, :-1, 1:] + lame[:, :-1, :-1]
    first, shear = total
    both, own = first + 2 * shear, shape.twist_volume * first + 2 * shear
    row = shape.rows * both + shape.cols * shear + shape.twist_rows * own + shape.twist_cols * shear
    col = shape.cols * both + shape.rows * shear + shape.twist_cols * own + shape.twist_rows * shear
    return np.stack([row, col])


def _coarser(fine: Float64Array, grid: tuple[int, ...]) -> Float64Array:
    """Return the parameters of coarse elements: the mean of four fine elements, 0 in void."""
    height, width = grid
    made = np.zeros((2, height + 4, width + 4))
    padded = np.pad(fine, ((0, 0), (0, 2), (0, 2)))[:, 2:, 2:]
    even_rows, odd_rows = padded[:, 0 : 2 * height : 2], padded[:, 1 : 2 * height + 1 : 2]
    total = even_rows + odd_rows
    made[:, 2:-2, 2:-2] = (total[..., 0 : 2 * width : 2] + total[..., 1 : 2 * width + 1 : 2]) / 4
    return made


_model: Kept[ArrayElasticModel] = Kept()


def the_model(material: ElasticMaterial) -> ArrayElasticModel:
    """Return the model of a material, reusing the last one if possible."""
    return _model.get(lambda last: last.material == material, lambda: ArrayElasticModel(material))
