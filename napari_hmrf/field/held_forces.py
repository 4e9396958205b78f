"""What it takes to hold tissue and to pull it, part by part."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.priors import Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.reactions import reactions
from napari_hmrf.solver.solution import Solution


class HeldForce(NamedTuple):
    """A connected part of tissue that is held or moved, and the force that it takes.

    Attributes
    ----------
    moves : bool
        Whether any of it is to move.
    centre : tuple of float
        The mean of its pixels, in the order of the axes.
    sites : int
        How many pixels or voxels it has.
    force : tuple of float
        Which acts on the tissue there, in the order of the axes and the unit of `reactions`.
    """

    moves: bool
    centre: tuple[float, ...]
    sites: int
    force: tuple[float, ...]


def held_forces(problem: Problem, solution: Solution, prior: Prior) -> tuple[HeldForce, ...]:
    """Sum the forces that hold and move tissue over the parts that they act on.

    Parameters
    ----------
    problem, solution, prior
        As for `reactions`.

    Returns
    -------
    tuple of HeldForce
        What moves first, each by its place.

    Raises
    ------
    ArgumentError
        As of `reactions`.
    """
    forces = reactions(problem, solution, prior)
    moving = (problem.known & (problem.observed != 0)).any(axis=-1)
    still = problem.known.any(axis=-1) & ~moving
    return (*_parts(forces, moving, moves=True), *_parts(forces, still, moves=False))


def _parts(
    forces: npt.NDArray[np.float64], there: npt.NDArray[np.bool_], moves: bool
) -> list[HeldForce]:
    parts, count = scipy.ndimage.label(there, np.ones((3,) * there.ndim))
    numbers = range(1, count + 1)
    centres = scipy.ndimage.center_of_mass(there, parts, numbers)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)[1:]
    along = [
        np.bincount(parts.ravel(), forces[..., axis].ravel(), count + 1)[1:]
        for axis in range(there.ndim)
    ]
    return [
        HeldForce(moves, tuple(map(float, centre)), int(size), tuple(map(float, force)))
        for centre, size, force in zip(centres, sizes, np.stack(along, axis=-1), strict=True)
    ]
