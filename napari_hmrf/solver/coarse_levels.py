"""The same model again, on ever coarser grids: how multigrid sees a prior.

Here coarse site i lies *on* fine site 2 i (the quadtree's sites lie between), so a level has
``size // 2 + 1`` sites along an axis. A coarse element has the mean Lame parameters of the four it
covers, void counted as 0. In two dimensions an element's energy does not depend on its size, so the
kernels need to know nothing else. In three it grows with its side: there it has twice the mean of
the eight.

A site that is held does not move on the finest level. A coarse site near it is on a spring
instead: pinning every coarse site that touches a fine one would make the correction useless near
any boundary.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors.elements import ElasticMaterial, Lame, lame_ratio

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
    # A wave and its opposite have the same spectrum: along the first axis half of them will do.
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
    """The largest eigenvalue of Hermitian matrices in units of a diagonal."""
    scale = np.sqrt(np.diag(of_diagonal).real)
    return float(np.linalg.eigvalsh(matrices / np.outer(scale, scale)).max())
