"""What a prior and an optimizer make of a problem that its owner may not expect."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.quadtree import levels, nearest_pixels
from napari_hmrf.study.models import converges

# How much of a boundary the first three coarse levels see: of one a pixel wide 0.16 to 0.29, of one
# of 3 pixels 0.41 or more. Images of up to 32 pixels have no coarse levels to speak of.
_ENOUGH = 0.32
_SMALLEST_TREE = 6


def caveats(problem: Problem, prior: Prior, optimizer: Optimizer) -> tuple[str, ...]:
    """Say what may surprise, as clauses for people; nothing that is refused anyway.

    Parameters
    ----------
    problem : Problem
    prior : SeilerPrior or ElasticPrior
    optimizer : ICM or Multigrid
    """
    if isinstance(prior, ElasticPrior):
        return _held_exactly(problem) if prior.penalty == math.inf else ()
    thin = () if converges(optimizer) else _thin_boundary(problem)
    return (*thin, *_loose_pieces(problem))


def lacks(
    problem: Problem, painted: npt.NDArray[np.floating[Any]], tissue: npt.NDArray[np.bool_]
) -> tuple[str, ...]:
    """Say what a painted boundary lacks: something that moves, or that holds the rest.

    Parameters
    ----------
    problem : Problem
    painted : ndarray, shape (H, W, 2)
        How what was painted should move, however sure that is.
    tissue : ndarray of bool, shape (H, W)
        What is tissue, be it held or not.
    """
    return _at_rest(problem, painted != 0, tissue[..., None]) or _adrift(problem)


def _at_rest(
    problem: Problem, moves: npt.NDArray[np.bool_], tissue: npt.NDArray[np.bool_]
) -> tuple[str, ...]:
    """Say so, and why, where all that was observed stays where it is."""
    note = ""
    if not moves.any():
        note = (
            "nothing that is painted moves: have something move or expand, by a distance other "
            "than 0"
        )
    elif not (moves & tissue).any():
        note = (
            "nothing moves: all that is to move is painted where there is no tissue (stiffness 0). "
            "Paint it on tissue, or give that place a stiffness"
        )
    elif not (moves & tissue & (problem.confidence > 0)).any():
        note = (
            "nothing moves: all that is to move has a confidence of 0, with which it does not "
            "count. Give it one above 0, up to 1 for certain"
        )
    return (note,) if note else ()


def _adrift(problem: Problem) -> tuple[str, ...]:
    """Say so where something moves within tissue whose rim nothing holds or moves."""
    seen = problem.known.any(axis=-1)
    rim = problem.tissue & ~scipy.ndimage.binary_erosion(problem.tissue)
    if (seen & rim).any() or (seen & ~problem.observed.any(axis=-1)).any():
        return ()
    note = (
        "nothing holds the tissue, so that all of it gives way: paint what stays where it is, such "
        "as bone, as 'fixed'"
    )
    return (note,)


def _held_exactly(problem: Problem) -> tuple[str, ...]:
    """Say so where a doubt about the boundary does not count."""
    doubted = problem.known & (problem.confidence < 1)
    count = int(doubted.any(axis=-1).sum())
    if not count:
        return ()
    what = "1 boundary pixel was" if count == 1 else f"{count} boundary pixels were"
    note = (
        f"{what} held exactly, though of a confidence below 1, as beside rigid tissue nothing may "
        "slip"
    )
    return (note,)


def _thin_boundary(problem: Problem) -> tuple[str, ...]:
    """Say so where the coarse levels, which take every second pixel and fewer, miss a boundary."""
    # There its motion begins; what they miss, the sweeps on the finest level do not make up for.
    tree = levels(problem.shape)
    if len(tree) <= _SMALLEST_TREE:
        return ()
    seen = np.asarray(problem.known.any(axis=-1))
    shares = []
    for level in tree[1:4]:
        rows, cols = nearest_pixels(level, problem.shape)
        size = 2**level.number
        whole = np.zeros([sites * size for sites in level.shape], dtype=bool)
        whole[: seen.shape[0], : seen.shape[1]] = seen
        there = whole.reshape(len(rows), size, len(cols), size).any(axis=(1, 3))
        sampled = seen.take(rows, axis=0).take(cols, axis=1)
        shares.append(float(sampled.sum()) / max(1.0, float(there.sum())))
    if np.mean(shares) > _ENOUGH:
        return ()
    note = (
        "most of the boundary is so thin that the coarse levels miss it, and the motion falls "
        "short: make it at least 3 pixels wide"
    )
    return (note,)


def _loose_pieces(problem: Problem) -> tuple[str, ...]:
    """Say so where tissue hangs on nothing that was observed."""
    pieces, count = scipy.ndimage.label(problem.tissue, structure=np.ones((3, 3)))
    held = np.unique(pieces[problem.known.any(axis=-1)])
    loose = count - int((held > 0).sum())
    if not loose:
        return ()
    pixels = int((problem.tissue & ~np.isin(pieces, held)).sum())
    what = "a piece of tissue touches" if loose == 1 else f"{loose} pieces of tissue touch"
    return (f"{what} no boundary ({pixels} pixels): how it moves is not determined",)
