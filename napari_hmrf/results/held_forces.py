"""Reaction force of each connected region of constrained tissue."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.reactions import reactions
from napari_hmrf.solver.solution import Solution


class HeldForce(NamedTuple):
    """Connected region of tissue with prescribed displacement, and its reaction force.

    Attributes
    ----------
    moves : bool
        True if the prescribed displacement is not 0.
    centre : tuple of float
        Mean position of the pixels, in pixels, in the order of the axes.
    sites : int
        Number of pixels or voxels.
    force : tuple of float
        Sum of the forces on the tissue, in axis order, in the unit of `reactions`.
    """

    moves: bool
    centre: tuple[float, ...]
    sites: int
    force: tuple[float, ...]


def held_forces(problem: Problem, solution: Solution) -> tuple[HeldForce, ...]:
    """Sum the reaction forces over each connected region with prescribed displacement.

    Parameters
    ----------
    problem, solution
        As for `reactions`.

    Returns
    -------
    tuple of HeldForce
        Moving regions first, then fixed regions, each group in pixel order.

    Raises
    ------
    ArgumentError
        As for `reactions`.
    """
    forces = reactions(problem, solution)
    moving = (problem.known & (problem.observed != 0)).any(axis=-1)
    still = problem.known.any(axis=-1) & ~moving
    return (*_parts(forces, moving, moves=True), *_parts(forces, still, moves=False))


def _parts(
    forces: npt.NDArray[np.float64], mask: npt.NDArray[np.bool_], moves: bool
) -> list[HeldForce]:
    """Sum the forces over the connected regions of a mask."""
    parts, count = scipy.ndimage.label(mask, np.ones((3,) * mask.ndim))
    numbers = range(1, count + 1)
    centres = scipy.ndimage.center_of_mass(mask, parts, numbers)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
    along = [
        np.bincount(parts.ravel(), forces[..., axis].ravel(), count + 1)[1:]
        for axis in range(mask.ndim)
    ]
    return [
        HeldForce(moves, tuple(map(float, centre)), int(size), tuple(map(float, force)))
        for centre, size, force in zip(centres, sizes, np.stack(along, axis=-1), strict=True)
    ]
