"""Whether what is observed determines how elastic tissue moves.

A piece of tissue can move as a rigid body in three ways (along rows, along columns, and turning) at
no cost. What is observed of it must stop all three, or there is no one answer. Two pieces that meet
in a single site are hinged there: each may still turn by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.problem import Problem

# Below this fraction of the largest, what holds a rigid motion is rounding.
_NOTHING = 1e-9
# Of a motion that costs nothing: pieces that take so small a part in it are at rest.
_REST = 1e-6
_MOTIONS = ("along rows", "along columns", "by turning")

Labels = npt.NDArray[np.int32]
Motions = npt.NDArray[np.float64]


class Firm(NamedTuple):
    """Tissue that was found to be held, and where: to find that takes as long as a few cycles."""

    tissue: npt.NDArray[np.bool_]
    held: npt.NDArray[np.bool_]

    def covers(self, tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]) -> bool:
        """Whether that is held, too: to hold more of the same tissue, as a brush does, frees none.

        Parameters
        ----------
        tissue : ndarray of bool, shape (H, W)
        held : ndarray of bool, shape (H, W, 2)
        """
        return np.array_equal(self.tissue, tissue) and not (self.held > held).any()


# The last that was found.
_firm: list[Firm] = []


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """A way in which some tissue can move at no cost.

    Attributes
    ----------
    piece : ndarray of bool, shape (H, W)
        The tissue that moves most.
    how : str
        In words.
    motion : ndarray, shape (H, W, 2)
        The displacement, of all tissue and in pixels; its scale means nothing.
    """

    piece: npt.NDArray[np.bool_]
    how: str
    motion: npt.NDArray[np.float64]


def check_held(problem: Problem) -> None:
    """Refuse a problem with a piece of tissue that could still move freely.

    Raises
    ------
    ProblemError
        Naming the piece by its size and centre, and how it could move.
    """
    held = problem.known
    if any(known.covers(problem.tissue, held) for known in _firm):
        return
    free = free_motion(problem, held)
    if free is not None:
        raise refusal(free)
    _firm[:] = [Firm(problem.tissue, held)]


def refusal(free: FreeMotion) -> ProblemError:
    """Return an error that names the piece that could move, and how."""
    centre = tuple(int(np.mean(at)) for at in np.nonzero(free.piece))
    return ProblemError(
        "confidence",
        f"leaves a piece of tissue free: the one of {int(free.piece.sum())} pixels around "
        f"{centre} {free.how}. Fix some of it in place, or give it no stiffness.",
    )


def free_motion(problem: Problem, held: npt.NDArray[np.bool_]) -> FreeMotion | None:
    """Find a way in which some tissue could still move, if there is one.

    Parameters
    ----------
    problem : Problem
    held : ndarray of bool, shape (H, W, 2)
        Which components are held.

    Raises
    ------
    ProblemError
        If no tissue is two pixels wide.
    """
    pieces, count = _pieces(problem.stiffness)
    if count == 0:
        raise ProblemError(
            "stiffness", "has tissue nowhere two pixels wide: nothing there could be stretched."
        )
    for cluster, strength, modes in _free_modes(pieces, count, held):
        mode = modes[0]
        worst = int(np.argmax((mode**2).sum(axis=1)))
        nothing = np.trace(strength[3 * worst : 3 * worst + 3, 3 * worst : 3 * worst + 3]) == 0
        how = f"could still move {_MOTIONS[int(np.argmax(np.abs(mode[worst])))]}"
        piece_modes = np.zeros((count + 1, 3))
        piece_modes[cluster + 1] = mode
        return FreeMotion(
            _sites(np.where(pieces == cluster[worst] + 1, pieces, 0)) > 0,
            "is not held anywhere" if nothing else how,
            _field(piece_modes[_sites(pieces)], problem.spacing),
        )
    return None


def free_motions(
    problem: Problem, held: npt.NDArray[np.bool_]
) -> Iterator[npt.NDArray[np.float64]]:
    """Find all ways in which tissue could still move.

    Parameters
    ----------
    problem : Problem
    held : ndarray of bool, shape (H, W, 2)
        Which components are held.

    Yields
    ------
    ndarray, shape (ways, H, W, 2)
        Independent motions of pieces that hang together, at no cost; those of different items have
        no site in common.
    """
    pieces, count = _pieces(problem.stiffness)
    for cluster, _, modes in _free_modes(pieces, count, held):
        piece_modes = np.zeros((count + 1, 3))
        ways = []
        for mode in modes:
            piece_modes[cluster + 1] = mode
            ways.append(_field(piece_modes[_sites(pieces)], problem.spacing))
        yield np.stack(ways)


def free_pieces(
    tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]
) -> tuple[Labels, npt.NDArray[np.intp]]:
    """Find all tissue that could still move.

    Parameters
    ----------
    tissue : ndarray of bool, shape (H, W)
    held : ndarray of bool, shape (H, W, 2)
        Which components are held.

    Returns
    -------
    pieces : ndarray of int, shape (H, W)
        Numbers of the pieces of tissue that could move, 0 elsewhere; a site in which one of them
        meets tissue that cannot move is the latter's.
    free : ndarray of int
        Those numbers.
    """
    pieces, count = _pieces(tissue)
    if count == 0:
        return np.zeros(tissue.shape, dtype=np.int32), np.zeros(0, dtype=np.intp)
    loose = np.zeros(count + 1, dtype=bool)
    for cluster, _, modes in _free_modes(pieces, count, held):
        size = np.abs(modes).max(axis=(0, 2))
        loose[cluster[size > _REST * size.max()] + 1] = True
    firm = ~loose
    firm[0] = False
    found = _sites(np.where(loose[pieces], pieces, 0))
    found[_sites(np.where(firm[pieces], pieces, 0)) > 0] = 0
    return found, np.flatnonzero(loose)


def _pieces(m: npt.NDArray[Any]) -> tuple[Labels, int]:
    """Number the pieces of elements, from 1; an element has its first site's index."""
    rows = np.minimum(m[:-1], m[1:])
    pieces, count = scipy.ndimage.label(np.minimum(rows[:, :-1], rows[:, 1:]) > 0)
    return pieces, int(count)


def _free_modes(
    pieces: Labels, count: int, held: npt.NDArray[np.bool_]
) -> Iterator[tuple[npt.NDArray[np.int64], Motions, Motions]]:
    """Find how each cluster of pieces that hang together could move."""
    # Yields ------ cluster : ndarray of int The pieces, from 0. strength : ndarray What it costs
    # them to move. modes : ndarray, shape (ways, pieces, 3) The motions that cost nothing.
    shape = held.shape[:2]
    # What holds a piece: a row for each held component, and for each of a hinge's (- and +).
    around = np.pad(pieces, 1)
    i, j, component = np.nonzero(held)
    corners = around[i, j], around[i, j + 1], around[i + 1, j], around[i + 1, j + 1]
    piece = np.max(corners, axis=0)
    of, ways = piece - 1, _motions(i, j, component, shape)
    hinged = _hinges(around) if count > 1 else np.zeros((0, 4), dtype=int)
    for cluster in _clusters(hinged, count):
        place = np.full(count, -1)
        place[cluster] = np.arange(len(cluster))
        here = (piece > 0) & (place[of] >= 0)
        strength = np.zeros((3 * len(cluster), 3 * len(cluster)))
        _tie(strength, place[of[here]], ways[here])
        mine = hinged[place[hinged[:, 2]] >= 0] if len(hinged) else hinged
        for along in (0, 1):
            way = _motions(mine[:, 0], mine[:, 1], np.full(len(mine), along), shape)
            _tie(strength, place[mine[:, 2]], way, place[mine[:, 3]])
        stops, modes = np.linalg.eigh(strength)
        free = stops <= _NOTHING * max(stops[-1], 1.0)
        if free.any():
            yield cluster, strength, modes[:, free].T.reshape(int(free.sum()), -1, 3)


def _sites(pieces: Labels) -> Labels:
    """The piece of each site, of the elements around it; 0 if it is in none."""
    around = np.pad(pieces, 1)
    rows = np.maximum(around[:-1], around[1:])
    both: Labels = np.maximum(rows[:, :-1], rows[:, 1:])
    return both


def _field(modes: Motions, spacing: tuple[float, ...]) -> Motions:
    """The displacement (H, W, 2) of sites whose pieces move so (H, W, 3)."""
    # A turn moves sites by as much as they are apart the other way.
    i, j = (np.asarray(index) for index in np.indices(modes.shape[:2]))
    each = [_motions(i, j, np.full_like(i, along), i.shape) for along in (0, 1)]
    field = np.stack([(way * modes).sum(axis=-1) for way in each], axis=-1)
    return np.asarray(field * np.array(spacing[::-1]) / max(spacing))


def _motions(
    i: npt.NDArray[Any], j: npt.NDArray[Any], along: npt.NDArray[Any], shape: tuple[int, ...]
) -> Motions:
    """How far sites move along an axis in each of the three rigid motions."""
    turn = np.where(along == 0, shape[1] / 2 - j, i - shape[0] / 2) / max(shape)
    return np.stack([along == 0, along == 1, turn], axis=-1).astype(np.float64)


def _tie(
    strength: Motions,
    piece: npt.NDArray[Any],
    way: Motions,
    other: npt.NDArray[Any] | None = None,
) -> None:
    """Add what it costs pieces to move as `way` says, or to move so against others, in place."""
    blocks = strength.reshape(len(strength) // 3, 3, -1, 3).swapaxes(1, 2)
    squares = way[:, :, None] * way[:, None, :]
    np.add.at(blocks, (piece, piece), squares)
    if other is not None:
        np.add.at(blocks, (other, other), squares)
        np.add.at(blocks, (piece, other), -squares)
        np.add.at(blocks, (other, piece), -squares)


def _hinges(around: Labels) -> npt.NDArray[np.int64]:
    """Sites where two pieces meet in a corner: (row, col, piece, other piece), from 0."""
    found = []
    falling = around[:-1, :-1], around[1:, 1:]
    for one, other in (falling, (around[:-1, 1:], around[1:, :-1])):
        i, j = np.nonzero((one > 0) & (other > 0) & (one != other))
        found.append(np.stack([i, j, one[i, j] - 1, other[i, j] - 1], axis=-1))
    return np.concatenate(found)


def _clusters(hinged: npt.NDArray[np.int64], count: int) -> list[npt.NDArray[np.int64]]:
    """Pieces that hang together by hinges."""
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(hinged)), (hinged[:, 2], hinged[:, 3])), shape=(count, count)
    )
    number, cluster = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(cluster, kind="stable")
    return np.split(order, np.searchsorted(cluster[order], np.arange(1, number)))
