"""Solution of a problem with parts that slide along each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import around_sites, in_elements
from napari_hmrf.solver.drift import has_drift
from napari_hmrf.solver.elasticity import Elasticity
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.optimizers import Multigrid, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.uncertain_landmarks import corners_of
from napari_hmrf.solver.unfolded import UnfoldedProblem, unfolded
from napari_hmrf.solver.warm_start import Initial

Float64Array = npt.NDArray[np.float64]
#: Function that solves an unfolded problem with a prior, from a warm start.
Solve = Callable[[Problem, ElasticPrior, Optimizer, Initial | None], Solution]

#: Smallest part of a rigid motion at an interface that is along the normal; with less, the motion
#: counts as free. The value is a square, and includes rounding errors.
_FREE = 1e-9
#: The same value below which fitted normals are not exact enough to resist the motion.
_ALONG_NORMAL = 1e-3
#: Error of fitted normals at small curved interfaces, in radians.
_TILT = math.radians(2.0)
#: Largest change of the field by such errors, relative to its largest value.
_MOST_CHANGE = 0.3
# Reasons for a refusal.
_UNHELD = "can slide or turn without any force"
_UNCERTAIN = (
    "is held by the direction of the interface only, which is not known well enough: a change by 2 "
    "degrees changes the motion by more than 30 %"
)
# Weight of prescribed components in the search for free motions: any constraint suffices.
_CERTAIN = 1e6
# Value that keeps the comparison regular for a piece without any constraint.
_TINY = 1e-9
# Largest number of rigid motions that are compared together.
_MOST = 3000
# Latest solution: of the problem, and of the unfolded problem, for a warm start.
_solutions: Kept[tuple[Solution, Solution]] = Kept(is_large=True)


def solve_with_sliding(
    problem: Problem,
    prior: Prior | None,
    optimizer: Optimizer | None,
    initial: Initial | None,
    solve: Solve,
) -> Solution:
    """Solve a problem with sliding parts.

    Parameters
    ----------
    problem : Problem
    prior : Prior, optional
        Elastic prior; by default ``ElasticPrior()``.
    optimizer : Optimizer, optional
        Multigrid; by default ``Multigrid()``.
    initial : Solution or sequence of Solution, optional
        Warm start. Only the latest solution of sliding parts on the same grid is used.
    solve : callable
        Function that solves an unfolded problem.

    Raises
    ------
    ProblemError
        If the model does not support sliding parts, or a part can move freely.
    """
    sliding = problem.sliding
    assert sliding is not None
    elastic = ElasticPrior() if prior is None else prior
    schedule = Multigrid() if optimizer is None else optimizer
    _check_support(problem, elastic, schedule)
    assert isinstance(elastic, ElasticPrior)
    parts, of_parts = unfolded(problem, elastic)
    least, freest = _least_held(parts)
    if least < _FREE:
        _refuse(parts, freest, _UNHELD)
    nearly_free = least < _ALONG_NORMAL
    if nearly_free:
        parts = parts.with_coupling(replace(parts.coupling, nearly_free=True))
    begin = _start(initial, parts)
    found = solve(parts, of_parts, schedule, begin)
    displacement = parts.coupling.folded(found.displacement)
    if nearly_free:
        change = math.inf
        with suppress(ProblemError):  # tilted normals may let the loads move a part very far
            again = solve(_tilted(parts), of_parts, schedule, found)
            moved = parts.coupling.folded(again.displacement)
            change = float(np.abs(moved - displacement).max())
        if change > _MOST_CHANGE * float(np.abs(displacement).max()):
            _refuse(parts, freest, _UNCERTAIN)
    # An energy is reported per site of tissue, and a copy is no site.
    share = np.count_nonzero(parts.tissue) / np.count_nonzero(problem.tissue)
    loads, elasticity = problem.loads, Elasticity.of_problem(problem, elastic, 1.0)
    if has_drift(problem, elastic):
        assert found.loads is not None
        assert found.loads.growth is not None
        growth = parts.coupling.folded(found.loads.growth)
        force = None if loads is None else loads.force
        loads = Loads(growth=growth, force=force, spacing=problem.spacing)
        elasticity = replace(elasticity, growth=loads.growth)
    solution = replace(
        found,
        displacement=displacement,
        energy=found.energy * share,
        levels=tuple(replace(level, shape=problem.shape) for level in found.levels),
        tissue=problem.tissue,
        loads=loads,
        elasticity=elasticity,
        provenance=replace(found.provenance, inputs=problem.digests),
        parts=sliding.labels,
    )
    _solutions.value = solution, found
    return solution


def _check_support(problem: Problem, prior: Prior, optimizer: Optimizer) -> None:
    """Raise an error if parts cannot slide in this model."""
    if not isinstance(prior, ElasticPrior) or not isinstance(optimizer, Multigrid):
        raise ProblemError(
            "sliding",
            "is for ElasticPrior with Multigrid. Use this model, or remove the sliding parts.",
        )
    if prior.can_slip(problem):
        raise ProblemError(
            "sliding",
            "cannot be used beside observations with a confidence between 0 and 1 or a finite "
            "penalty. Use a precision instead, or a confidence of 1.",
        )


def _start(initial: Initial | None, parts: UnfoldedProblem) -> Solution | None:
    """Return the solution of the unfolded problem that belongs to a warm start, or None."""
    if initial is None or _solutions.value is None:
        return None
    given = (initial,) if isinstance(initial, Solution) else tuple(initial)
    folded, found = _solutions.value
    known = any(each.displacement is folded.displacement for each in given)
    return found if known and found.tissue.shape == parts.shape else None


def _tilted(parts: UnfoldedProblem) -> UnfoldedProblem:
    """Return the problem with normals that are tilted at random, by about 2 degrees."""
    normals = parts.coupling.normals
    tilted = normals + _TILT * np.random.default_rng(0).normal(size=normals.shape)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    return parts.with_coupling(replace(parts.coupling, normals=tilted))


def _least_held(parts: UnfoldedProblem) -> tuple[float, npt.NDArray[np.bool_]]:
    """Return how well the freest piece of tissue is held, and a mask of its sites.

    The rigid motions of all connected pieces are compared. No prescribed component may prevent the
    motion; the returned value is the share of its gaps at the interfaces, squared, that is along
    the normals.
    """
    pieces, count = scipy.ndimage.label(in_elements(parts.stiffness))
    of_sites = around_sites(pieces, np.maximum)
    axes = of_sites.ndim
    turns = [(i, j) for i in range(axes) for j in range(i + 1, axes)]
    freedom = axes + len(turns)
    held = parts.known & (of_sites > 0)[..., None]
    extent = float(max(parts.shape))

    def motions(
        sites: npt.NDArray[np.intp], of: npt.NDArray[np.intp] | None = None
    ) -> tuple[Float64Array, npt.NDArray[np.intp]]:
        """Return the rigid motions of sites, shape (n, freedom, axes), and their pieces."""
        index = np.stack(np.unravel_index(sites, parts.shape), axis=1)
        return motions_of(index, (of_sites.ravel()[sites] if of is None else of) - 1)

    def motions_of(
        places: npt.NDArray[Any], piece: npt.NDArray[np.intp]
    ) -> tuple[Float64Array, npt.NDArray[np.intp]]:
        """Return the rigid motions of places in given pieces, counted from 0, and the pieces."""
        from_middle = (places - middle[piece]) / extent
        moves = np.zeros((len(places), freedom, axes))
        moves[:, range(axes), range(axes)] = 1
        for number, (i, j) in enumerate(turns, start=axes):
            moves[:, number, i], moves[:, number, j] = -from_middle[:, j], from_middle[:, i]
        # Positions are in the image: boxes differ by a shift, which only changes the basis.
        return moves, piece

    middle = np.array(
        scipy.ndimage.center_of_mass(of_sites > 0, of_sites, range(1, count + 1))
    ).reshape(count, axes)
    between = parts.coupling
    coupled = (of_sites.ravel()[between.first] > 0) & (of_sites.ravel()[between.second] > 0)
    first, second = between.first[coupled], between.second[coupled]
    normals = between.normals[coupled]
    one, two = motions(first), motions(second)
    hinges, of_hinges = _hinges(pieces, of_sites)
    pin, pinned = motions(hinges), motions(hinges, of_hinges)
    pairs = np.concatenate([one[1], pin[1]]), np.concatenate([two[1], pinned[1]])
    links = scipy.sparse.coo_array((np.ones(len(pairs[0])), pairs), shape=(count, count))
    clusters, cluster_of = scipy.sparse.csgraph.connected_components(links, directed=False)
    at_held = np.flatnonzero(held.any(axis=-1))
    of_held, held_piece = motions(at_held)
    known = held.reshape(-1, axes)[at_held]
    data, data_piece = np.zeros((0, freedom, axes)), np.zeros(0, np.intp)
    tensors = np.zeros((0, axes, axes))
    if parts.precision is not None:
        flat = parts.precision.reshape(-1, axes, axes)
        at_data = np.flatnonzero(flat.any(axis=(1, 2)) & (of_sites.ravel() > 0))
        data, data_piece = motions(at_data)
        tensors = flat[at_data] / np.trace(flat[at_data], axis1=1, axis2=2)[:, None, None]
    points, point_piece = np.zeros((0, freedom, axes)), np.zeros(0, np.intp)
    if parts.landmarks is not None:
        elements, _ = corners_of(parts.landmarks.points, parts.shape)
        points, point_piece = motions_of(parts.landmarks.points, pieces[tuple(elements.T)] - 1)
    least, freest = math.inf, np.zeros(parts.shape, np.bool_)
    for cluster in range(clusters):
        mine = np.flatnonzero(cluster_of == cluster)
        if len(mine) * freedom > _MOST:
            continue
        place = np.full(count, -1)
        place[mine] = np.arange(len(mine))
        size = len(mine) * freedom
        cost, scale = np.zeros((size, size)), np.zeros((size, size))
        for moves, piece, weights in (
            (of_held, held_piece, known[:, :, None] * np.eye(axes)),
            (data, data_piece, tensors),
            (points, point_piece, np.broadcast_to(np.eye(axes), (len(points), axes, axes))),
        ):
            here = place[piece] >= 0
            rows = _rows(moves[here], place[piece[here]], freedom, size)
            cost += _CERTAIN * np.einsum("nai,nij,nbj->ab", rows, weights[here], rows)
            scale += np.einsum("nai,nbi->ab", rows, rows)
        here = place[pin[1]] >= 0
        apart = _rows(pin[0][here], place[pin[1][here]], freedom, size)
        apart -= _rows(pinned[0][here], place[pinned[1][here]], freedom, size)
        tied = np.einsum("nai,nbi->ab", apart, apart)
        cost += _CERTAIN * tied
        scale += tied
        here = place[one[1]] >= 0
        gaps = _rows(one[0][here], place[one[1][here]], freedom, size)
        gaps -= _rows(two[0][here], place[two[1][here]], freedom, size)
        along = np.einsum("nai,ni->na", gaps, normals[here])
        cost += along.T @ along
        scale += np.einsum("nai,nbi->ab", gaps, gaps)
        scale += _TINY * max(float(np.trace(scale)), 1.0) * np.eye(size)
        values, modes = scipy.linalg.eigh(cost, scale, subset_by_index=[0, 0])
        if values[0] < min(least, _ALONG_NORMAL):
            least = float(values[0])
            moved = np.abs(modes[:, 0].reshape(len(mine), freedom)).max(axis=1)
            freest = around_sites(pieces == 1 + mine[int(moved.argmax())], np.logical_or)
            if not (freest & between.own).any():
                freest = np.isin(of_sites, 1 + mine)  # a piece of copies only
    return least, freest


def _hinges(
    pieces: npt.NDArray[Any], of_sites: npt.NDArray[Any]
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return sites at which pieces touch without a common face, and each other piece there.

    Elements of one part that have only a corner or an edge in common are different pieces, but they
    move together at their common sites.

    Parameters
    ----------
    pieces : ndarray of int
        Number of the piece of each element, from 1; 0 if the element does not exist.
    of_sites : ndarray of int
        Largest number of a piece at each site.

    Returns
    -------
    sites, others : ndarray of int, shape (n,)
        Index of each site in the flattened grid, and the number of another piece there.
    """
    around = np.pad(pieces, 1)
    sites, others = [], []
    for corner in np.ndindex(*(2,) * pieces.ndim):
        at = tuple(
            slice(begin, begin + size) for begin, size in zip(corner, of_sites.shape, strict=True)
        )
        there = around[at].ravel()
        found = np.flatnonzero((there > 0) & (there != of_sites.ravel()))
        sites.append(found)
        others.append(there[found].astype(np.intp))
    return np.concatenate(sites), np.concatenate(others)


def _rows(
    moves: Float64Array, place: npt.NDArray[np.intp], freedom: int, size: int
) -> Float64Array:
    """Return the motions of sites, shape (n, size, axes), in the numbering of a cluster."""
    rows = np.zeros((len(moves), size, moves.shape[2]))
    at = place[:, None] * freedom + np.arange(freedom)
    rows[np.arange(len(moves))[:, None], at] = moves
    return rows


def _refuse(parts: UnfoldedProblem, piece: npt.NDArray[np.bool_], why: str) -> NoReturn:
    """Raise an error about a piece of tissue that is not held."""
    image = parts.coupling.folded(piece)
    centre = tuple(int(np.mean(at)) for at in np.nonzero(image))
    raise ProblemError(
        "sliding",
        f"leaves a piece of tissue free: the piece of {int(image.sum())} pixels around {centre} "
        f"{why}. Hold or move part of it.",
    )
