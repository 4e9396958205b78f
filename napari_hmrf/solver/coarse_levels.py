"""The same model again, on ever coarser grids: how multigrid sees a prior.

Here coarse site i lies *on* fine site 2 i (the quadtree's sites lie between), so a level has
``size // 2 + 1`` sites along an axis. A coarse element has the mean Lame parameters of the four it
covers, void counted as 0. In two dimensions an element's energy does not depend on its size, so the
kernels need to know nothing else.

A site that is held does not move on the finest level. A coarse site near it is on a spring
instead: pinning every coarse site that touches a fine one would make the correction useless near
any boundary.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors.elements import ElasticMaterial, ElementShape, Lame, element_forces

#: A level this small (sites along its longer axis) is the last one.
COARSEST = 5
#: Held fine sites that count at a coarse site, at most.
MOST_PINS = 4.0
#: The spring of one of them, as a part of the site's diagonal.
SPRING = 0.6


def grids(shape: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The grids of sites, finest first."""
    made = [shape]
    while max(made[-1]) > COARSEST:
        made.append(tuple(size // 2 + 1 for size in made[-1]))
    return made


def smoother_bounds(material: ElasticMaterial) -> tuple[float, float]:
    """Two upper bounds of the spectrum of D^-1 A: the usual one, and one for any material.

    The first is that of a uniform grid (its symbol), which mixtures hardly exceed; the second that
    of the worst single element, which no mixture can. Both grow with lambda / mu.
    """
    nu = material.largest_poisson
    return _bounds(2 * nu / (1 - (2 * nu if material.strain else nu)), material.shape)


@lru_cache(maxsize=16)
def _bounds(ratio: float, shape: ElementShape) -> tuple[float, float]:
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


def _largest(matrix: npt.NDArray[Any], of_diagonal: npt.NDArray[Any]) -> float:
    """The largest eigenvalue of a Hermitian matrix in units of a diagonal."""
    scale = np.sqrt(np.diag(of_diagonal).real)
    return float(np.linalg.eigvalsh(matrix / np.outer(scale, scale))[-1])
