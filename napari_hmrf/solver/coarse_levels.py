"""Coarse levels of multigrid: grids, springs near constrained sites, and bounds on the spectrum.

Coarse site i *coincides* with fine site 2 i (unlike sites of the quadtree, which lie between fine
sites), so a coarse level has ``size // 2 + 1`` sites along an axis. A coarse element has the mean
Lame parameters of its four fine elements, where void counts as 0. In two dimensions the energy of
an element does not depend on its size, so the kernels need no other data. In three dimensions the
energy is proportional to the side of the element, so a coarse element has twice the mean of its
eight fine elements.

Constrained sites do not move on the finest level. On coarse levels, springs act on the sites near
them. If every coarse site next to a constrained fine site were fixed instead, the correction would
be useless near any boundary.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors.elements import ElasticMaterial, Lame, lame_ratio

#: Largest number of sites along any axis of the coarsest level.
COARSEST = 5
#: Largest number of constrained fine sites that are counted for the spring of a coarse site.
MOST_PINS = 4.0
#: Stiffness of the spring for each constrained fine site, relative to the coarse diagonal.
SPRING = 0.6


def grids(shape: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Return the shapes of the grids of sites, finest first."""
    shapes = [shape]
    while max(shapes[-1]) > COARSEST:
        shapes.append(tuple(size // 2 + 1 for size in shapes[-1]))
    return shapes


def smoother_bounds(material: ElasticMaterial) -> tuple[float, float]:
    """Return upper bounds on the spectrum of D^-1 A, for usual materials and for all materials.

    The first bound is computed from the symbol of a uniform grid; mixtures of materials hardly
    exceed this bound. The second bound is the largest eigenvalue for a single element, which no
    mixture exceeds. Both bounds increase with lambda / mu.
    """
    return _bounds(lame_ratio(material.largest_poisson, material.strain), material.shape)


@lru_cache(maxsize=16)
def _bounds(ratio: float, shape: Any) -> tuple[float, float]:
    ndim = shape.axes
    grid = Lame(np.full((4,) * ndim, ratio), np.ones((4,) * ndim))
    stencil = np.zeros((*(3,) * ndim, ndim, ndim))
    around = (slice(3, 0, -1),) * ndim
    for component in range(ndim):
        impulse = np.zeros((*(5,) * ndim, ndim))
        impulse[(*(2,) * ndim, component)] = 1
        stencil[..., component] = shape.forces(grid, impulse)[around]
    # Opposite wave vectors have the same spectrum, so half of the first axis is enough.
    half, whole = np.linspace(0, np.pi, 9), np.linspace(-np.pi, np.pi, 17)
    numbers = np.stack(np.meshgrid(half, *[whole] * (ndim - 1)), axis=-1)
    waves = np.exp(1j * np.tensordot(numbers, np.indices((3,) * ndim) - 1, 1))
    symbols = np.tensordot(waves, stencil, ndim)
    usual = _largest(symbols, stencil[(1,) * ndim])
    one = Lame(*(each[(slice(1),) * ndim] for each in grid))
    size = ndim * 2**ndim
    corners = np.eye(size).reshape(size, *(2,) * ndim, ndim)
    element = np.array([shape.forces(one, corner).ravel() for corner in corners])
    return usual, _largest(element, element)


def _largest(matrices: npt.NDArray[Any], of_diagonal: npt.NDArray[Any]) -> float:
    """Return the largest eigenvalue of D^-1/2 A D^-1/2 over all given Hermitian matrices A.

    D is the diagonal of the matrix `of_diagonal`.
    """
    scale = np.sqrt(np.diag(of_diagonal).real)
    return float(np.linalg.eigvalsh(matrices / np.outer(scale, scale)).max())
