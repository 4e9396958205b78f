"""Check that the observations determine the motion of elastic tissue.

A piece of tissue has three rigid motions without energy in an image (two translations and a
rotation), and six in a volume. The observations of each piece must prevent all of these motions;
otherwise the solution is not unique. Two pieces that share only a single site, or in a volume only
an edge, are hinged there: each piece can still rotate by itself. Pieces with tissue of the same
rigid body move together.
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
from napari_hmrf.field.neighbours import around_sites, in_elements, of_corners
from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.coupling import Coupling
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
Places = tuple[npt.NDArray[Any], ...]
#: Displacement of sites along an axis in each rigid motion, keyed by the number of the motion.
Ways = dict[int, Motions]
# Cluster of pieces, its cost matrix, the costs of its motions in ascending order, and the motions.
_Ways = tuple[npt.NDArray[np.int64], Motions, Motions, Motions]


class Ties(NamedTuple):
    """Constraints on the rigid motions of pieces, or on the relative motions of two pieces.

    Attributes
    ----------
    places : tuple of ndarray, each of shape (n,)
        Position along each axis, in pixels.
    pieces : ndarray of int, shape (n,)
        Number of the piece, from 0.
    tensors : dict
        Components (i, j) of the tensor that resists the motion, or one number for all ties; other
        components are 0.
    others : ndarray of int, shape (n,), optional
        Number of the second piece, whose motion is subtracted.
    other_places : tuple of ndarray, optional
        Position in the second piece; by default the same.
    """

    places: Places
    pieces: npt.NDArray[np.integer]
    tensors: dict[tuple[int, int], Any]
    others: npt.NDArray[np.integer] | None = None
    other_places: Places | None = None

    def in_all_directions(self) -> Ties:
        """Return ties that resist every motion of the same places equally."""
        return self._replace(tensors=_every_direction(len(self.places)))

    def some(self, at: npt.NDArray[np.intp], numbers: npt.NDArray[np.intp]) -> Ties:
        """Return some of the ties, with other numbers of the pieces."""
        far = self.other_places
        return Ties(
            tuple(along[at] for along in self.places),
            numbers[self.pieces[at]],
            {pair: each[at] if np.ndim(each) else each for pair, each in self.tensors.items()},
            None if self.others is None else numbers[self.others[at]],
            None if far is None else tuple(along[at] for along in far),
        )


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
    rigid : ndarray of bool, shape (H, W) or (D, H, W), or None
        Mask of rigid tissue.
    """

    tissue: npt.NDArray[np.bool_]
    held: npt.NDArray[np.bool_]
    strength: float = 0.0
    precision: npt.NDArray[np.floating] | None = None
    landmarks: Landmarks | None = None
    rigid: npt.NDArray[np.bool_] | None = None

    def covers_problem(self, problem: Problem) -> bool:
        """Return whether the problem has the same tissue and data, and all checked constraints."""
        if self.landmarks is not problem.landmarks:
            return False
        if not self.covers(problem.tissue, problem.known):
            return False
        same_rigid = are_equal(self.rigid, problem.rigid if problem.has_rigid else None)
        return same_rigid and are_equal(self.precision, problem.precision)

    def covers(self, tissue: npt.NDArray[np.bool_], held: npt.NDArray[np.bool_]) -> bool:
        """Return whether the tissue is the same, and `held` includes all checked constraints.

        Parameters
        ----------
        tissue : ndarray of bool, shape (H, W) or (D, H, W)
        held : ndarray of bool, shape (H, W, 2) or (D, H, W, 3)
        """
        if not are_equal(self.tissue, tissue):
            return False
        return are_equal(self.held, held) or not (self.held > held).any()


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
    rigid = problem.rigid if problem.has_rigid else None
    data = problem.precision, problem.landmarks, rigid
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


def _some_pieces(problem: Problem) -> tuple[Labels, int]:
    """Return the labelled pieces of tissue; raise an error if there is no element of tissue."""
    pieces, count = pieces_of(problem.stiffness)
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
        worst, motions = int(np.argmax((mode**2).sum(axis=1))), mode.shape[1]
        own = slice(motions * worst, motions * worst + motions)
        unconstrained = np.trace(strength[own, own]) == 0
        names = (*_STEPS[-pieces.ndim :], *["by turning"] * motions)
        clause = f"could still move {names[int(np.argmax(np.abs(mode[worst])))]}"
        piece_modes = np.zeros((count + 1, motions))
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
    pieces, count = pieces_of(problem.stiffness)
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
    pieces, count = pieces_of(tissue)
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


def pieces_of(m: npt.NDArray[Any]) -> tuple[Labels, int]:
    """Label the connected pieces of elements, from 1, at the first site of each element."""
    elements = in_elements(m)
    compute_thread.check_cancelled()
    pieces, count = scipy.ndimage.label(elements)
    compute_thread.check_cancelled()
    is_rigid = np.isinf(m)
    if is_rigid.any():
        return _joined(pieces, int(count), elements & of_corners(is_rigid, np.logical_or))
    return pieces, int(count)


def _joined(pieces: Labels, count: int, rigid: npt.NDArray[np.bool_]) -> tuple[Labels, int]:
    """Give pieces with elements of the same rigid body the same label."""
    sites = around_sites(rigid, np.logical_or)
    bodies, more = scipy.ndimage.label(sites, structure=np.ones((3,) * sites.ndim))
    of = bodies[(slice(None, -1),) * sites.ndim][rigid] + count
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(of)), (pieces[rigid], of)), shape=(count + more + 1,) * 2
    )
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    numbers, labels = np.unique(label[1 : count + 1], return_inverse=True)
    joined = np.concatenate([[0], labels + 1])[pieces].astype(pieces.dtype)
    return joined, len(numbers)


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
    # The cost of a motion is the sum of its squared displacements at all constraints.
    for cluster, ties in clusters(ties_of(pieces, count, held, problem, most), count):
        strength = costs_of(ties, len(cluster), held.shape[:-1])
        yield cluster, strength, *np.linalg.eigh(strength)


def ties_of(
    pieces: Labels,
    count: int,
    held: npt.NDArray[np.bool_],
    problem: Problem | None = None,
    most: int | None = None,
) -> list[Ties]:
    """Return the ties of pieces of tissue: constraints, hinges, data, and then sliding parts.

    A site or landmark of the data term counts like a constraint in the directions of its tensor,
    however weak it is. If `most` is given, only about this number of tensors is included.
    """
    axes, of_sites = pieces.ndim, _sites(pieces)
    ties = []
    for along in range(axes):
        compute_thread.check_cancelled()
        sites = np.nonzero(held[..., along] & (of_sites > 0))
        ties.append(Ties(sites, of_sites[sites] - 1, {(along, along): 1.0}))
    if count > 1:
        *at, one, other = _hinges(pieces).T
        ties.append(Ties(tuple(at), one, _every_direction(axes), other))
    if problem is None:
        return ties
    if problem.precision is not None:
        flat = problem.precision.reshape(*of_sites.shape, -1)
        there = np.flatnonzero((flat != 0).any(axis=-1))
        there = there[of_sites.ravel()[there] > 0]
        step = 1 if most is None else max(1, len(there) // most)
        sites = np.unravel_index(there[::step], of_sites.shape)
        tensors = problem.precision[sites]
        tensors *= step / np.trace(tensors, axis1=-2, axis2=-1)[:, None, None]
        components = {(i, j): tensors[:, i, j] for i, j in product(range(axes), repeat=2)}
        ties.append(Ties(sites, of_sites[sites] - 1, components))
    if problem.landmarks is not None:
        points = problem.landmarks.points
        elements, _ = corners_of(points, problem.shape)
        of_points = pieces[tuple(elements.T)] - 1
        ties.append(Ties(tuple(points.T), of_points, _every_direction(axes)))
    if problem.coupling is not None:
        ties.append(_gaps_of(problem.coupling, pieces))
    return ties


def _gaps_of(between: Coupling, pieces: npt.NDArray[Any]) -> Ties:
    """Return the ties of sliding parts along the normals of their interfaces."""
    of_sites = _sites(pieces).ravel()
    coupled = (of_sites[between.first] > 0) & (of_sites[between.second] > 0)
    first, second = between.first[coupled], between.second[coupled]
    normals = between.normals[coupled].T
    pairs = product(range(len(normals)), repeat=2)
    return Ties(
        np.unravel_index(first, between.own.shape),
        of_sites[first] - 1,
        {(i, j): normals[i] * normals[j] for i, j in pairs},
        of_sites[second] - 1,
        np.unravel_index(second, between.own.shape),
    )


def _every_direction(axes: int) -> dict[tuple[int, int], Any]:
    """Return the components of the unit tensor."""
    return {(along, along): 1.0 for along in range(axes)}


def clusters(ties: list[Ties], count: int) -> Iterator[tuple[npt.NDArray[np.intp], list[Ties]]]:
    """Yield the pieces of each cluster that ties connect, and the ties within it.

    The ties of a cluster number its pieces from 0.
    """
    if count == 0:
        return
    pairs = [(tie.pieces, tie.others) for tie in ties if tie.others is not None]
    rows = np.concatenate([np.zeros(0, np.intp), *(one for one, _ in pairs)])
    columns = np.concatenate([np.zeros(0, np.intp), *(other for _, other in pairs)])
    graph = scipy.sparse.coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    number, cluster = scipy.sparse.csgraph.connected_components(graph, directed=False)
    if number == 1:
        yield np.arange(count), ties
        return
    order = np.argsort(cluster, kind="stable")
    bounds = np.searchsorted(cluster[order], np.arange(number + 1))
    place = np.empty(count, np.intp)
    place[order] = np.arange(count) - bounds[cluster[order]]
    orders = [np.argsort(cluster[tie.pieces], kind="stable") for tie in ties]
    ends = [
        np.searchsorted(cluster[tie.pieces[each]], np.arange(number + 1))
        for tie, each in zip(ties, orders, strict=True)
    ]
    for each in range(number):
        within = [
            tie.some(of_tie[end[each] : end[each + 1]], place)
            for tie, of_tie, end in zip(ties, orders, ends, strict=True)
        ]
        yield order[bounds[each] : bounds[each + 1]], within


def costs_of(ties: Iterable[Ties], count: int, shape: tuple[int, ...]) -> Motions:
    """Return the quadratic form of the costs of the rigid motions of pieces.

    Parameters
    ----------
    ties : iterable of Ties
    count : int
        Number of pieces; each has `freedom(axes)` consecutive rows.
    shape : tuple of int
        Shape of the grid.
    """
    axes = len(shape)
    costs = np.zeros((count, freedom(axes)) * 2)
    for tie in ties:
        directions = sorted({along for pair in tie.tensors for along in pair})

        def ways(places: Places, directions: list[int] = directions) -> dict[int, Ways]:
            return {along: _motions(places, along, shape) for along in directions}

        ends = [(tie.pieces, ways(tie.places), 1.0)]
        if tie.others is not None:
            there = tie.places if tie.other_places is None else tie.other_places
            ends.append((tie.others, ways(there), -1.0))
        for (i, j), weight in tie.tensors.items():
            for (first, of_first, sign), (second, of_second, other) in product(ends, repeat=2):
                between = first * count + second
                motions = product(of_first[i].items(), of_second[j].items())
                for (row, one), (col, two) in motions:
                    cost = np.bincount(between, weight * one * two, minlength=count**2)
                    costs[:, row, :, col] += sign * other * cost.reshape(count, count)
    return costs.reshape(freedom(axes) * count, -1)


def freedom(axes: int) -> int:
    """Return the number of rigid motions."""
    return axes + len(_turns(axes))


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


def _motions(sites: Places, along: int, shape: tuple[int, ...]) -> Ways:
    """Return the displacement of sites along an axis, for each rigid motion that has one."""
    from_middle = [index - size / 2 for index, size in zip(sites, shape, strict=True)]
    motions = {along: np.ones(np.shape(sites[0]))}
    for number, (first, second) in enumerate(_turns(len(shape)), start=len(shape)):
        if along == first:
            motions[number] = -from_middle[second] / max(shape)
        elif along == second:
            motions[number] = from_middle[first] / max(shape)
    return motions


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
