"""Whether what is observed determines the least energy of the paper's cliques (eq. 7).

The cliques resist the bending of each component only. Where tissue is uniform, a component that is
the same everywhere, or grows evenly in some direction, costs nothing; across tissues of different
stiffness only the first. What is observed of a piece must stop all of that, or there is no one
answer.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.priors.seiler import in_cliques
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.rigid_modes import FreeMotion, refusal

# Below this fraction of what a motion could be stopped by, it is free.
_NOTHING = 1e-9
_ALONG = ("along rows", "along columns")


def check_bent(problem: Problem) -> None:
    """Refuse a problem with a piece of tissue that could still move at no cost.

    Raises
    ------
    ProblemError
        Naming the piece by its size and centre, and how it could move.
    """
    free = free_bend(problem, problem.known)
    if free is not None:
        raise refusal(free)


def free_bend(problem: Problem, held: npt.NDArray[np.bool_]) -> FreeMotion | None:
    """Find a way in which some tissue could move at no cost, if there is one.

    Parameters
    ----------
    problem : Problem
    held : ndarray of bool, shape (H, W, 2)
        Which components are held.
    """
    for piece, component, ways in _free_pieces(problem, held):
        how = "could still grow" if held[piece, component].any() else "is not held anywhere"
        return FreeMotion(piece, f"{how} {_ALONG[component]}", ways[0])
    return None


def _free_pieces(
    problem: Problem, held: npt.NDArray[np.bool_]
) -> Iterator[tuple[npt.NDArray[np.bool_], int, npt.NDArray[np.float64]]]:
    """Find each piece that could move, its component, and how: (ways, H, W, 2)."""
    cliques = in_cliques(problem)
    i, j = np.indices(problem.shape)
    ways = np.stack([np.ones(problem.shape), i / max(problem.shape), j / max(problem.shape)], -1)
    for component in range(len(_ALONG)):
        pieces, _ = scipy.ndimage.label(cliques[..., component], structure=np.ones((3, 3)))
        for number, box in enumerate(scipy.ndimage.find_objects(pieces), start=1):
            inside = pieces[box] == number
            stopped = held[box][inside, component]
            m = problem.stiffness[box][inside]
            possible = ways[box][inside][:, : 3 if m.min() == m.max() else 1]
            modes = _free_modes(possible, stopped)
            if not modes.shape[1]:
                continue
            piece = pieces == number
            motions = np.zeros((modes.shape[1], *problem.shape, 2))
            motions[:, piece, component] = (possible @ modes).T
            yield piece, component, motions


def _free_modes(
    possible: npt.NDArray[np.float64], stopped: npt.NDArray[np.bool_]
) -> npt.NDArray[np.float64]:
    """Find the mixes of motions (sites, motions) that vanish where they would be stopped."""
    sizes, mixes = np.linalg.eigh(possible.T @ possible)
    real = sizes > _NOTHING * sizes[-1]
    basis = mixes[:, real] / np.sqrt(sizes[real])
    at = possible[stopped] @ basis
    stops, modes = np.linalg.eigh(at.T @ at)
    free: npt.NDArray[np.float64] = basis @ modes[:, stops <= _NOTHING]
    return free
