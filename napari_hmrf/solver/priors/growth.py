"""Forces of growth on each site, in NumPy and float64, for images and volumes.

An element with growth strain e_g has the energy of the strain e - e_g. With s_g = C : e_g, this is

    U = 1/2 integral of e : C : e  -  integral of e : s_g  +  1/2 integral of e_g : s_g

Within an element, e_g is constant (the mean over its sites), so the second integral depends only on
the mean of the strain e.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.field.neighbours import pairs
from napari_hmrf.real_arrays import FloatArray
from napari_hmrf.solver.priors.elements import Float64Array, Lame, of_elements

# Number of elements processed at once. Processing all elements of a volume together would
# require more memory than its solve.
_BLOCK_SIZE = 1 << 17


class Load(NamedTuple):
    """Contribution of loads to the energy, linear in the displacement.

    Attributes
    ----------
    forces : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Force on each site, in pixels.
    energy : float
        Energy at zero displacement, in pixels squared.
    """

    forces: Float64Array
    energy: float


def growth_load(
    growth: FloatArray,
    grid: tuple[int, ...],
    sides: tuple[float, ...],
    lame_of: Callable[[slice], Lame],
    across: bool,
) -> Load:
    """Return the load of growth.

    Parameters
    ----------
    growth : ndarray
        Growth strain, as in `Loads`: a number or a tensor for each site.
    grid : tuple of int
        Shape of the grid of sites.
    sides : tuple of float
        Lengths of the sides of an element, scaled to a product of 1.
    lame_of : callable
        Function that returns Lame parameters of the elements between the sites in a range along
        the first axis.
    across : bool
        True if growth perpendicular to the image exerts forces, as in plane strain.
    """
    axes = len(grid)
    forces, energy = np.zeros((*grid, axes)), 0.0
    for sites in slabs(grid):
        lame = lame_of(sites)
        strains, beyond = element_strains(growth[sites], axes)
        trace = sum(strains[along, along] for along in range(axes))
        if across:
            trace = trace + beyond
        stresses = 2 * lame.shear * strains
        for along in range(axes):
            stresses[along, along] += lame.first * trace
        energy += float((stresses * strains).sum()) / 2
        if across:
            energy += float(((lame.first * trace + 2 * lame.shear * beyond) * beyond).sum()) / 2
        forces[sites] += _pulls(stresses, sides)
    return Load(forces, energy)


def slabs(grid: tuple[int, ...], size: int = _BLOCK_SIZE) -> Iterator[slice]:
    """Yield ranges of about `size` sites, along the first axis.

    Each element is within exactly one range.
    """
    length, *others = grid
    step = max(1, size // math.prod(others))
    for begin in range(0, length - 1, step):
        compute_thread.check_cancelled()
        yield slice(begin, min(begin + step, length - 1) + 1)


def element_strains(growth: FloatArray, axes: int) -> tuple[Float64Array, Float64Array]:
    """Return the growth strain of each element, in the grid and perpendicular to an image.

    Parameters
    ----------
    growth : ndarray
        Growth strain, as in `Loads`.
    axes : int
        Number of axes of the grid, n.

    Returns
    -------
    strains : ndarray, shape (n, n, H - 1, W - 1) or (n, n, D - 1, H - 1, W - 1)
        Growth strain along the axes of the grid.
    across : ndarray, shape (H - 1, W - 1) or ()
        Growth strain perpendicular to the image; 0 in volumes.
    """
    if growth.ndim == axes:
        mean = of_elements(growth.astype(np.float64))
        strains = np.eye(axes).reshape(axes, axes, *(1,) * axes) * mean
        return strains, mean if axes == 2 else np.zeros(())
    count = growth.shape[-1]
    beyond = count - axes
    strains = np.stack(
        [
            [of_elements(growth[..., i, j].astype(np.float64)) for j in range(beyond, count)]
            for i in range(beyond, count)
        ]
    )
    return strains, of_elements(growth[..., 0, 0].astype(np.float64)) if beyond else np.zeros(())


def _pulls(stresses: Float64Array, sides: tuple[float, ...]) -> Float64Array:
    """Return the forces on the sites, given the stress tensor, (n, n), of each element."""
    axes = len(sides)
    total = np.zeros((*(size + 1 for size in stresses.shape[2:]), axes))
    for component in range(axes):
        for along, side in enumerate(sides):
            if not stresses[component, along].any():  # isotropic growth has no shear
                continue
            values = np.pad(stresses[component, along], 1)
            for axis, (first, last) in enumerate(pairs(axes)):
                behind, ahead = values[first], values[last]
                values = behind - ahead if axis == along else behind + ahead
            total[..., component] += values / (side * 2 ** (axes - 1))
    return total
