"""The same model again, on ever coarser grids: what multigrid needs of elastic tissue.

Here coarse site i lies *on* fine site 2 i (the quadtree's sites lie between), so a level has
``size // 2 + 1`` sites along an axis. A coarse element has the mean Lame parameters of the four it
covers, void counted as 0. In two dimensions an element's energy does not depend on its size, so the
kernels need to know nothing else.

A prescribed site does not move on the finest level. A coarse site near it is held by a spring
instead: pinning every coarse site that touches a fine one would make the correction useless near
any boundary.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.priors.elastic import ElementShape, Lame, element_forces

Float64Array = npt.NDArray[np.float64]

#: A level this small (sites along its longer axis) is the last one.
COARSEST = 5
# Strength of the spring of a coarse site, in halves of its diagonal, at most.
_MOST_PINS = 4.0
_SPRING = 0.5


@dataclass(frozen=True, eq=False)
class ElasticLevel:
    """One level's model.

    Attributes
    ----------
    lame : Lame
        Of its elements, (H - 1, W - 1).
    inverse : ndarray, shape (H, W, 2)
        Of the diagonal of stiffness and springs; 0 where a component does not move.
    weight : ndarray, shape (H, W, 2), or None
        The springs; the finest level has none.
    """

    lame: Lame
    inverse: Float64Array
    weight: Float64Array | None

    @property
    def shape(self) -> tuple[int, ...]:
        """The grid of sites, (H, W)."""
        return tuple(self.inverse.shape[:2])


def elastic_levels(
    lame: Lame, shape: ElementShape, prescribed: npt.NDArray[np.bool_]
) -> tuple[ElasticLevel, ...]:
    """Build the levels, finest first.

    Parameters
    ----------
    lame : Lame
        Of the finest level.
    shape : ElementShape
    prescribed : ndarray, shape (H, W, 2)
        Which components are given and do not move.
    """
    made = []
    pins = prescribed.astype(np.float64)
    finest = True
    while True:
        diagonal = _diagonal(lame, shape)
        if finest:
            weight, moves = None, (diagonal > 0) & ~prescribed
            total = diagonal
        else:
            weight = pins * _SPRING * diagonal
            moves = diagonal > 0
            total = diagonal + weight
        inverse = np.divide(1.0, total, out=np.zeros_like(total), where=moves)
        made.append(ElasticLevel(lame, inverse, weight))
        if max(diagonal.shape[:2]) <= COARSEST:
            return tuple(made)
        coarse = tuple(size // 2 + 1 for size in diagonal.shape[:2])
        pins = np.minimum(_restricted(pins, coarse), _MOST_PINS)
        lame = Lame(*(_coarse_elements(values, coarse) for values in lame))
        finest = False


def _diagonal(lame: Lame, k: ElementShape) -> Float64Array:
    """The diagonal of the stiffness matrix, (H, W, 2)."""
    first, shear = lame
    both, own = first + 2 * shear, k.twist_volume * first + 2 * shear
    rows = k.rows * both + k.cols * shear + k.twist_rows * own + k.twist_cols * shear
    cols = k.cols * both + k.rows * shear + k.twist_cols * own + k.twist_rows * shear
    height, width = first.shape
    total = np.zeros((height + 1, width + 1, 2))
    for i in (0, 1):
        for j in (0, 1):
            total[i : height + i, j : width + j, 0] += rows
            total[i : height + i, j : width + j, 1] += cols
    return total


def _coarse_elements(values: Float64Array, coarse: tuple[int, ...]) -> Float64Array:
    """The mean of each 2 x 2 elements; beyond the border there is void."""
    padded = np.zeros(tuple(2 * (size - 1) for size in coarse))
    padded[: values.shape[0], : values.shape[1]] = values
    return (padded[::2, ::2] + padded[1::2, ::2] + padded[::2, 1::2] + padded[1::2, 1::2]) / 4


def _restricted(values: Float64Array, coarse: tuple[int, ...]) -> Float64Array:
    """The transpose of bilinear interpolation, per component."""
    height, width = values.shape[:2]
    padded = np.zeros((2 * coarse[0] + 1, 2 * coarse[1] + 1, 2))
    padded[1 : height + 1, 1 : width + 1] = values
    along = padded[1::2] + (padded[:-1:2] + padded[2::2]) / 2
    both: Float64Array = along[:, 1::2] + (along[:, :-1:2] + along[:, 2::2]) / 2
    return both


def smoother_bounds(lame: Lame, shape: ElementShape) -> tuple[float, float]:
    """Two upper bounds of the spectrum of D^-1 A: the usual one, and one for any material.

    The first is that of a uniform grid (its symbol), which mixtures hardly exceed; the second that
    of the worst single element, which no mixture can. Both grow with lambda / mu.
    """
    ratio = float(np.max(lame.first[lame.shear > 0] / lame.shear[lame.shear > 0], initial=0.0))
    grid = Lame(np.full((4, 4), ratio), np.ones((4, 4)))
    stencil = np.zeros((3, 3, 2, 2))
    for component in (0, 1):
        impulse = np.zeros((5, 5, 2))
        impulse[2, 2, component] = 1
        stencil[..., component] = element_forces(grid, shape, impulse)[3:0:-1, 3:0:-1]
    usual = 0.0
    at = np.arange(-1, 2)
    for row in np.linspace(0, np.pi, 9):
        for col in np.linspace(-np.pi, np.pi, 17):
            wave = np.exp(1j * (row * at[:, None] + col * at))
            usual = max(usual, _largest(np.einsum("ij,ijkl->kl", wave, stencil), stencil[1, 1]))
    one = Lame(grid.first[:1, :1], grid.shear[:1, :1])
    corners = np.eye(8).reshape(8, 2, 2, 2)
    element = np.array([element_forces(one, shape, corner).ravel() for corner in corners])
    return usual, _largest(element, element)


def _largest(matrix: npt.NDArray[Any], diagonal_of: Float64Array) -> float:
    scale = 1 / np.sqrt(np.diag(diagonal_of))
    return float(np.linalg.eigvalsh(matrix * scale[:, None] * scale)[-1])
