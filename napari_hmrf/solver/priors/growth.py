"""What growth pulls with at each site, in NumPy and float64, in images and in volumes.

An element that grows by the strain e_g has the energy of the strain e - e_g. With s_g = C : e_g

    U = 1/2 integral of e : C : e  -  integral of e : s_g  +  1/2 integral of e_g : s_g

and as e_g is the mean of the element's sites, only its mean strain e counts in the second part.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.solver.neighbours import pairs
from napari_hmrf.solver.priors.elements import Float64Array, Lame, of_elements
from napari_hmrf.solver.real_arrays import FloatArray

# Elements that are looked at at once: all of a volume's would take more memory than its solve.
_AT_ONCE = 1 << 17


class Load(NamedTuple):
    """What loads add to the energy, which is linear in displacement.

    Attributes
    ----------
    forces : ndarray, shape (H, W, 2) or (D, H, W, 3)
        What pulls at each site, in pixels.
    energy : float
        Of the tissue where it does not move, in pixels squared.
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
    """The load of growth.

    Parameters
    ----------
    growth : ndarray
        One number a site, or a tensor, as `Loads` has it.
    grid : tuple of int
    sides : tuple of float
        Of an element, whose product is 1.
    lame_of : callable
        Gives the parameters of the elements between the sites in a range of the first axis.
    across : bool
        Whether growth across an image pushes.
    """
    axes = len(grid)
    forces, energy = np.zeros((*grid, axes)), 0.0
    for sites in slabs(grid):
        lame = lame_of(sites)
        strains, beyond = element_strains(growth[sites], axes)
        change = sum(strains[along, along] for along in range(axes))
        if across:
            change = change + beyond
        stresses = 2 * lame.shear * strains
        for along in range(axes):
            stresses[along, along] += lame.first * change
        energy += float((stresses * strains).sum()) / 2
        if across:
            energy += float(((lame.first * change + 2 * lame.shear * beyond) * beyond).sum()) / 2
        forces[sites] += _pulls(stresses, sides)
    return Load(forces, energy)


def slabs(grid: tuple[int, ...]) -> Iterator[slice]:
    """Ranges of sites along the first axis, between which lie all elements, each once."""
    length, *others = grid
    step = max(1, _AT_ONCE // math.prod(others))
    for begin in range(0, length - 1, step):
        compute_thread.look()
        yield slice(begin, min(begin + step, length - 1) + 1)


def element_strains(growth: FloatArray, axes: int) -> tuple[Float64Array, Float64Array]:
    """The strain of each element, its two axes first, and that across an image.

    Parameters
    ----------
    growth : ndarray
        As `Loads` has it.
    axes : int
        Of the grid.
    """
    if growth.ndim == axes:
        mean = of_elements(growth.astype(np.float64))
        made = np.eye(axes).reshape(axes, axes, *(1,) * axes) * mean
        return made, mean if axes == 2 else np.zeros(())
    count = growth.shape[-1]
    beyond = count - axes
    made = np.stack(
        [
            [of_elements(growth[..., i, j].astype(np.float64)) for j in range(beyond, count)]
            for i in range(beyond, count)
        ]
    )
    return made, of_elements(growth[..., 0, 0].astype(np.float64)) if beyond else np.zeros(())


def _pulls(stresses: Float64Array, sides: tuple[float, ...]) -> Float64Array:
    """What a stress, (n, n) of each element, pulls with at their sites."""
    axes = len(sides)
    total = np.zeros((*(size + 1 for size in stresses.shape[2:]), axes))
    for component in range(axes):
        for along, side in enumerate(sides):
            if not stresses[component, along].any():  # most growth is the same in all directions
                continue
            values = np.pad(stresses[component, along], 1)
            for axis, (first, last) in enumerate(pairs(axes)):
                behind, ahead = values[first], values[last]
                values = behind - ahead if axis == along else behind + ahead
            total[..., component] += values / (side * 2 ** (axes - 1))
    return total
