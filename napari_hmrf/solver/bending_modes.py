"""Check that the observations determine the motion in the paper's model (eq. 7).

The cliques resist only the bending of each component. A constant displacement component has no
energy. In a piece of uniform stiffness, a component that varies linearly has no energy either. The
observations of each piece must prevent these motions; otherwise the solution is not unique.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.priors.seiler import in_cliques
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.rigid_modes import FreeMotion, refusal

# Largest sum of squared displacements over the constrained sites, as a fraction of the sum over all
# sites, for which a motion counts as free.
_FREE_SHARE = 1e-9
_DIRECTIONS = ("along the row axis", "along the column axis")


def check_bending(problem: Problem) -> None:
    """Raise an error if a piece of tissue has a zero-energy motion.

    Raises
    ------
    ProblemError
        If a piece can move; the message gives its size, its centre and its motion.
    """
    held = problem.known
    for piece, component, motions in free_bends(problem, held):
        clause = "could still grow" if held[piece, component].any() else "is not held anywhere"
        raise refusal(FreeMotion(piece, f"{clause} {_DIRECTIONS[component]}", motions[0]))


def free_bends(
    problem: Problem, held: npt.NDArray[np.bool_]
) -> Iterator[tuple[npt.NDArray[np.bool_], int, npt.NDArray[np.float64]]]:
    """Yield each piece with zero-energy motions, the component that moves, and these motions.

    Parameters
    ----------
    problem : Problem
    held : ndarray of bool, shape (H, W, 2)
        Mask of the constrained components.

    Yields
    ------
    piece : ndarray of bool, shape (H, W)
    component : int
    motions : ndarray, shape (n, H, W, 2)
    """
    cliques = in_cliques(problem.tissue, problem.spacing)
    i, j = np.indices(problem.shape)
    # Motions of one component of a piece that may have no energy: constant and linear.
    basis = np.stack([np.ones(problem.shape), i / max(problem.shape), j / max(problem.shape)], -1)
    for component in range(len(_DIRECTIONS)):
        pieces, _ = scipy.ndimage.label(cliques[component], structure=np.ones((3, 3)))
        for number, box in enumerate(scipy.ndimage.find_objects(pieces), start=1):
            inside = pieces[box] == number
            held_sites = held[box][inside, component]
            m = problem.stiffness[box][inside]
            possible = basis[box][inside][:, : 3 if m.min() == m.max() else 1]
            modes = _free_modes(possible, held_sites)
            if not modes.shape[1]:
                continue
            piece = pieces == number
            motions = np.zeros((modes.shape[1], *problem.shape, 2))
            motions[:, piece, component] = (possible @ modes).T
            yield piece, component, motions


def _free_modes(
    possible: npt.NDArray[np.float64], held_sites: npt.NDArray[np.bool_]
) -> npt.NDArray[np.float64]:
    """Return the combinations of motions that vanish at the constrained sites.

    `possible` has shape (sites, motions). The result contains the coefficients, one column for each
    combination.
    """
    sizes, combinations = np.linalg.eigh(possible.T @ possible)
    is_independent = sizes > _FREE_SHARE * sizes[-1]
    basis = combinations[:, is_independent] / np.sqrt(sizes[is_independent])
    at_held = possible[held_sites] @ basis
    shares, modes = np.linalg.eigh(at_held.T @ at_held)
    free: npt.NDArray[np.float64] = basis @ modes[:, shares <= _FREE_SHARE]
    return free
