"""Check that the observations determine the motion of elastic tissue.

A piece of tissue has three rigid motions without energy in an image (two translations and a
rotation), and six in a volume. The observations of each piece must prevent all of these motions;
otherwise the solution is not unique. Two pieces that share only a single site, or in a volume only
an edge, are hinged there: each piece can still rotate by itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import around_sites, in_elements
from napari_hmrf.solver.precision import are_equal
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.uncertain_landmarks import Landmarks, corners_of

# Largest strength of a constraint, relative to the strongest one, that counts as rounding error.
_ROUNDING = 1e-9
# Largest motion of a piece, relative to the largest motion of any piece, for which the piece counts
# as at rest.
_REST = 1e-6
_STEPS = ("along the plane axis", "along the row axis", "along the column axis")

Labels = npt.NDArray[np.int32]
Motions = npt.NDArray[np.float64]
#: Displacement of sites along an axis in each rigid motion, keyed by the number of the motion.
Ways = dict[int, Motions]
# Cluster of pieces, its cost matrix, the costs of its motions in ascending order, and the motions.
_Ways = tuple[npt.NDArray[np.int64], Motions, Motions, Motions]


class HeldTissue(NamedTuple):
    """Tissue without free motions, cached because the check takes as long as a few cycles.

    Attributes
    ----------
    tissue : ndarray of bool, shape (H, W) or (D, H, W)
        Mask of tissue without free motions.
    held : ndarray of bool, shape (H, W, 2) or (D, H, W, 3)
        Mask of the constrained components.
    strength : float
        Result of `holding_strength`.
    precision : ndarray, shape (H, W, 2, 2) or (D, H, W, 3, 3), or None
        Precision of the data term.
    landmarks : Landmarks or None
    """

    tissue: npt.NDArray[np.bool_]
    held: npt.NDArray[np.bool_]
    strength: float = 0.0
    precision: Motions | None = None
    landmarks: Landmarks | None = None

    def covers_problem(self, problem: Problem) -> bool:
        """Return whether the problem has the same tissue and data, and all checked constraints."""
        if self.landmarks is not problem.landmarks:
            return False
        if not self.covers(problem.tissue, problem.known):
            return False
        return are_equal(self.precision, problem.precision)

    def covers(self, tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]) -> bool:
        """Return whether the tissue is the same, and `held` includes all checked constraints.

        Parameters
        ----------
        tissue : ndarray of bool, shape (H, W) or (D, H, W)
        held : ndarray of bool, shape (H, W, 2) or (D, H, W, 3)
        """
        return np.array_equal(self.tissue, tissue) and not (self.held > held).any()


_firm: Kept[HeldTissue] = Kept()
# Number of data that are checked first. If they hold the tissue, so do all data.
_FEW_DATA = 10_000


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """Zero-energy motion of some tissue.

    Attributes
    ----------
    piece : ndarray of bool, shape (H, W)
        Mask of the tissue that moves most.
    description : str
        Description of the motion, as a clause.
    motion : ndarray, shape (H, W, 2)
        Displacement of all tissue, in pixels, with an arbitrary scale.
    """

    piece: npt.NDArray[np.bool_]
    description: str
    motion: npt.NDArray[np.float64]

    @property
    def centre(self) -> tuple[int, ...]:
        """Site at the centre of the piece."""
        return tuple(int(np.mean(at)) for at in np.nonzero(self.piece))


def check_held(problem: Problem) -> None:
    """Raise an error if a piece of tissue can move freely.

    Raises
    ------
    ProblemError
        If a piece can move; the message gives its size, its centre and its motion.
    """
    holding_strength(problem)


def holding_strength(problem: Problem) -> float:
    """Return how strongly the least constrained rigid motion of the tissue is constrained.

    The motion is scaled so that the farthest point of the tissue moves by about 1. The strength is
    the sum of the squared displacements of all constrained components, divided by the approximate
    size of the tissue's surface.

    Raises
    ------
    ProblemError
        As for `check_held`.
    """
    if problem.coupling is not None:
        return 1.0  # `sliding_solve` has checked all parts together
    held = problem.known
    # The last check comes first, because every frame of a drag needs the result.
    firm = _firm.valid(lambda last: last.covers_problem(problem))
    if firm is not None:
        return firm.strength
    if held[problem.tissue].all():
        return 1.0  # no site is free to move
    pieces, count = _some_pieces(problem)
    ways = list(_modes(pieces, count, held, problem, _FEW_DATA))
    free = _first_motion(problem, pieces, count, ways)
    if free is not None and problem.precision is not None:
        ways = list(_modes(pieces, count, held, problem))
        free = _first_motion(problem, pieces, count, ways)
    if free is not None:
        raise refusal(free)
    sizes, share = np.bincount(pieces.ravel(), minlength=count + 1)[1:], 1 - 1 / pieces.ndim
    value = min(float(stops[0] / sizes[cluster].sum() ** share) for cluster, _, stops, _ in ways)
    if problem.precision is not None:
        value *= _mean_grip(problem)
    data = problem.precision, problem.landmarks
    _firm.value = HeldTissue(problem.tissue, held, value, *data)
    return value


def _mean_grip(problem: Problem) -> float:
    """Return the mean part of a site's motion that the precision prevents, from 0 to 1."""
    assert problem.precision is not None
    traces = np.trace(problem.precision, axis1=-2, axis2=-1)
    at = np.flatnonzero(traces)
    at = at[:: max(1, len(at) // _FEW_DATA)]
    strength = traces.ravel()[at]
    unit = problem.unit ** (problem.tissue.ndim - 2)
    stiffness = problem.stiffness.ravel()[at].astype(np.float64) * unit
    return float((strength / (strength + stiffness)).mean())


def refusal(free: FreeMotion) -> ProblemError:
    """Return an error that describes the piece that can move and its motion."""
    return ProblemError(
        "confidence",
        f"leaves a piece of tissue free: the piece of {int(free.piece.sum())} pixels around "
        f"{free.centre} {free.description}. Fix part of it in place, or set its stiffness to 0.",
    )


def free_motion(problem: Problem, held: npt.NDArray[np.bool_]) -> FreeMotion | None:
    """Return a free motion of some tissue, or None if there is none.

    Parameters
    ----------
    problem : Problem
    held : ndarray of bool, shape (H, W, 2)
        Mask of the constrained components.
    """
    pieces, count = _pieces(problem.stiffness)
    ways = _modes(pieces, count, held, problem)
    return _first_motion(problem, pieces, count, ways)


def _some_pieces(problem: Problem) -> tuple[Labels, int]:
    """Return the labelled pieces of tissue; raise an error if there is no element of tissue."""
    pieces, count = _pieces(problem.stiffness)
    if count == 0:
        raise ProblemError(
            "stiffness",
            "has no tissue that is two pixels wide, so no tissue can deform. Make the tissue "
            "wider.",
        )
    return pieces, count


def _first_motion(
    problem: Problem, pieces: Labels, count: int, ways: Iterable[_Ways]
) -> FreeMotion | None:
    """Return the first free motion of any cluster of pieces, or None."""
    for cluster, strength, modes in _free(ways):
        mode = modes[0]
        worst, freedom = int(np.argmax((mode**2).sum(axis=1))), mode.shape[1]
        own = slice(freedom * worst, freedom * worst + freedom)
        unconstrained = np.trace(strength[own, own]) == 0
        names = (*_STEPS[-pieces.ndim :], *["by turning"] * freedom)
        clause = f"could still move {names[int(np.argmax(np.abs(mode[worst])))]}"
        piece_modes = np.zeros((count + 1, freedom))
        piece_modes[cluster + 1] = mode
        return FreeMotion(
            _sites(np.where(pieces == cluster[worst] + 1, pieces, 0)) > 0,
            "is not held anywhere" if unconstrained else clause,
            _field(piece_modes[_sites(pieces)], problem.spacing),
        )
    return None


def free_motions(
    problem: Problem, held: npt.NDArray[np.bool_]
) -> Iterator[npt.NDArray[np.float64]]:
    """Find all free motions of tissue.

    Parameters
    ----------
    problem : Problem
    held : ndarray of bool, shape (H, W, 2)
        Mask of the constrained components.

    Yields
    ------
    ndarray, shape (n, H, W, 2)
        Independent free motions of a cluster of connected pieces; different clusters have no common
        sites.
    """
    pieces, count = _pieces(problem.stiffness)
    for cluster, _, modes in _free(_modes(pieces, count, held, problem)):
        piece_modes = np.zeros((count + 1, modes.shape[2]))
        ways = []
        for mode in modes:
            piece_modes[cluster + 1] = mode
            ways.append(_field(piece_modes[_sites(pieces)], problem.spacing))
        yield np.stack(ways)


def free_pieces(
    tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]
) -> tuple[Labels, npt.NDArray[np.intp]]:
    """Find all pieces of tissue that can move freely.

    Parameters
    ----------
    tissue : ndarray of bool, shape (H, W)
        Mask of tissue.
    held : ndarray of bool, shape (H, W, 2)
        Mask of the constrained components.

    Returns
    -------
    pieces : ndarray of int, shape (H, W)
        Numbers of the free pieces, 0 elsewhere. A site that a free piece shares with a constrained
        piece belongs to the constrained piece.
    free : ndarray of int
        Numbers of the free pieces.
    """
    pieces, count = _pieces(tissue)
    if count == 0:
        return np.zeros(tissue.shape, dtype=np.int32), np.zeros(0, dtype=np.intp)
    loose = np.zeros(count + 1, dtype=bool)
    for cluster, _, modes in _free(_modes(pieces, count, held)):
        size = np.abs(modes).max(axis=(0, 2))
        loose[cluster[size > _REST * size.max()] + 1] = True
    held_pieces = ~loose
    held_pieces[0] = False
    numbers = _sites(np.where(loose[pieces], pieces, 0))
    numbers[_sites(np.where(held_pieces[pieces], pieces, 0)) > 0] = 0
    return numbers, np.flatnonzero(loose)


def _pieces(m: npt.NDArray[Any]) -> tuple[Labels, int]:
    """Label the connected pieces of elements, from 1, at the first site of each element."""
    elements = in_elements(m)
    compute_thread.check_cancelled()
    pieces, count = scipy.ndimage.label(elements)
    compute_thread.check_cancelled()
    return pieces, int(count)


def _free(ways: Iterable[_Ways]) -> Iterator[tuple[npt.NDArray[np.int64], Motions, Motions]]:
    """Yield the free motions of each cluster of connected pieces."""
    # Yields the numbers of the pieces, from 0; the cost matrix of the cluster; and its free
    # motions, shape (n, pieces, rigid motions).
    for cluster, strength, stops, modes in ways:
        free = stops <= _ROUNDING * max(stops[-1], 1.0)
        if free.any():
            yield cluster, strength, modes[:, free].T.reshape(int(free.sum()), len(cluster), -1)


def _modes(
    pieces: Labels,
    count: int,
    held: npt.NDArray[np.bool_],
    problem: Problem | None = None,
    most: int | None = None,
) -> Iterator[_Ways]:
    """Compute the motions of each cluster and their costs, in ascending order of cost."""
    # The cost of a motion is the sum of its squared displacements at all constraints. A site of the
    # data term counts like a constraint in the directions of its tensor, however weak it is.
    if count == 0:
        return
    shape = held.shape[:-1]
    axes, freedom = len(shape), len(_turns(len(shape))) + len(shape)
    # Each constrained component is a constraint on its piece. Each component of a hinge is a
    # constraint on the difference between the motions of two pieces.
    of_sites = _sites(pieces)
    holds = []
    for along in range(axes):
        compute_thread.check_cancelled()
        holds.append(np.nonzero(held[..., along] & (of_sites > 0)))
    held_of = [of_sites[sites] - 1 for sites in holds]
    hinged = _hinges(pieces) if count > 1 else np.zeros((0, axes + 2), dtype=int)
    data = None if problem is None else _data_costs(problem, pieces, count, freedom, most)
    for cluster in _clusters(hinged, count):
        place = np.full(count, -1)
        place[cluster] = np.arange(len(cluster))
        costs = np.zeros((len(cluster), freedom) * 2)
        own = hinged[place[hinged[:, -2]] >= 0]
        for along, (sites, of) in enumerate(zip(holds, held_of, strict=True)):
            inside = place[of] >= 0
            ways = _motions(tuple(index[inside] for index in sites), along, shape)
            _tie(costs, place[of[inside]], ways)
            ways = _motions(tuple(own.T[:axes]), along, shape)
            _tie(costs, place[own[:, -2]], ways, place[own[:, -1]])
        if data is not None:
            within = np.arange(len(cluster))
            costs[within, :, within] += data[cluster]
        strength = costs.reshape(freedom * len(cluster), -1)
        yield cluster, strength, *np.linalg.eigh(strength)


def _data_costs(
    problem: Problem, pieces: Labels, count: int, freedom: int, most: int | None
) -> Motions:
    """Return the costs of the motions of each piece due to the data term, without its strength.

    If `most` is given, only about this number of tensors is included. The result has shape (pieces,
    motions, motions).
    """
    costs = np.zeros((count, freedom, freedom))
    precision, landmarks = problem.precision, problem.landmarks
    if precision is not None:
        of_sites = _sites(pieces)
        there = np.flatnonzero((precision.reshape(*of_sites.shape, -1) != 0).any(axis=-1))
        there = there[of_sites.ravel()[there] > 0]
        step = 1 if most is None else max(1, len(there) // most)
        sites = np.unravel_index(there[::step], of_sites.shape)
        tensors = precision[sites]
        tensors *= step / np.trace(tensors, axis1=-2, axis2=-1)[:, None, None]
        _add_data(costs, tensors, sites, of_sites[sites] - 1, problem.shape)
    if landmarks is not None:
        elements, _ = corners_of(landmarks.points, problem.shape)
        points = tuple(landmarks.points.T)
        tensors = np.broadcast_to(np.eye(len(points)), (len(landmarks), len(points), len(points)))
        _add_data(costs, tensors, points, pieces[tuple(elements.T)] - 1, problem.shape)
    return costs


def _add_data(
    costs: Motions,
    tensors: Motions,
    sites: tuple[npt.NDArray[Any], ...],
    piece: npt.NDArray[Any],
    shape: tuple[int, ...],
) -> None:
    """Add the costs of data with given tensors, at sites or points of given pieces, in place."""
    ways = [_motions(sites, along, shape) for along in range(len(shape))]
    for (i, of_i), (j, of_j) in product(enumerate(ways), repeat=2):
        for (row, one), (col, two) in product(of_i.items(), of_j.items()):
            work = tensors[:, i, j] * one * two
            costs[:, row, col] += np.bincount(piece, work, minlength=len(costs))


def _sites(pieces: Labels) -> Labels:
    """Return the number of each site's piece, from the elements around it; 0 if there are none."""
    return around_sites(pieces, np.maximum)


def _field(modes: Motions, spacing: tuple[float, ...]) -> Motions:
    """Return the displacement, shape (H, W, 2), of sites in given rigid motions.

    `modes`, shape (H, W, motions), contains the coefficients of the rigid motions of each site.
    """
    # A rotation moves sites in proportion to their distance along the other axis.
    sites = tuple(map(np.asarray, np.indices(modes.shape[:-1])))
    field = np.zeros((*modes.shape[:-1], len(sites)))
    for along in range(len(sites)):
        for number, way in _motions(sites, along, modes.shape[:-1]).items():
            field[..., along] += way * modes[..., number]
    return np.asarray(field * min(spacing) / np.array(spacing))


def _turns(axes: int) -> list[tuple[int, int]]:
    """Return the planes of rotation: pairs of axes, from the first axis to the second."""
    return list(combinations(range(axes), 2))


def _motions(sites: tuple[npt.NDArray[Any], ...], along: int, shape: tuple[int, ...]) -> Ways:
    """Return the displacement of sites along an axis, for each rigid motion that has one."""
    from_middle = [index - size / 2 for index, size in zip(sites, shape, strict=True)]
    motions = {along: np.ones(np.shape(sites[0]))}
    for number, (first, second) in enumerate(_turns(len(shape)), start=len(shape)):
        if along == first:
            motions[number] = -from_middle[second] / max(shape)
        elif along == second:
            motions[number] = from_middle[first] / max(shape)
    return motions


def _tie(
    costs: Motions,
    piece: npt.NDArray[Any],
    ways: Ways,
    other: npt.NDArray[Any] | None = None,
) -> None:
    """Add the costs of motions of pieces or of relative motions of two pieces, in place."""
    count = len(costs)
    pairs = [(piece, piece, 1.0)]
    if other is not None:
        pairs += [(other, other, 1.0), (piece, other, -1.0), (other, piece, -1.0)]
    for (row, one), (col, two) in product(ways.items(), repeat=2):
        for first, second, sign in pairs:
            cost = np.bincount(first * count + second, one * two, minlength=count**2)
            costs[:, row, :, col] += sign * cost.reshape(count, count)


def _hinges(pieces: Labels) -> npt.NDArray[np.int64]:
    """Return the hinges between pieces: the indices of the site and the two pieces, from 0."""
    largest, axes = _sites(pieces), pieces.ndim
    # The numbers are reversed so that a maximum finds the smallest number.
    smallest = _sites(np.where(pieces > 0, largest.max() + 1 - pieces, 0))
    sites = np.nonzero((largest > 0) & (largest + smallest != largest.max() + 1))
    around, hinges = np.pad(pieces, 1), []
    corners = [
        around[tuple(index + step for index, step in zip(sites, corner, strict=True))]
        for corner in product((0, 1), repeat=axes)
    ]
    for one, other in combinations(corners, 2):
        meet = (one > 0) & (other > 0) & (one != other)
        places = [index[meet] for index in sites]
        hinges.append(np.stack([*places, one[meet] - 1, other[meet] - 1], axis=-1))
    return np.concatenate(hinges)


def _clusters(hinged: npt.NDArray[np.int64], count: int) -> list[npt.NDArray[np.int64]]:
    """Return the clusters of pieces that are connected by hinges."""
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(hinged)), (hinged[:, -2], hinged[:, -1])), shape=(count, count)
    )
    number, cluster = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(cluster, kind="stable")
    return np.split(order, np.searchsorted(cluster[order], np.arange(1, number)))
