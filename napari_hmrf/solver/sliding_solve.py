"""Solution of a problem with parts that slide along each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import NoReturn

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import around_sites
from napari_hmrf.solver.drift import has_drift
from napari_hmrf.solver.elasticity import Elasticity
from napari_hmrf.solver.loads import Loads
from napari_hmrf.solver.optimizers import Multigrid, Optimizer
from napari_hmrf.solver.optimizers.base import Reach
from napari_hmrf.solver.priors import Elastic, ElasticPrior, NeoHookeanPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.rigid_modes import clusters, costs_of, freedom, pieces_of, ties_of
from napari_hmrf.solver.solution import Solution
from napari_hmrf.solver.unfolded import UnfoldedProblem, unfolded
from napari_hmrf.solver.warm_start import Initial

#: Function that converts a solution of an unfolded problem to one of the problem.
Fold = Callable[[Solution], Solution]
#: Function that solves an unfolded problem with a prior, from a warm start; it reports fields of
#: the problem.
Solve = Callable[[Problem, Elastic, Optimizer, Initial | None, Fold], Solution]

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
        `ElasticPrior`, by default ``ElasticPrior()``, or `NeoHookeanPrior`.
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
    given = ElasticPrior() if prior is None else prior
    schedule = Multigrid() if optimizer is None else optimizer
    elastic = _supported(problem, given, schedule)
    parts, of_parts = unfolded(problem, elastic)
    least, freest = _least_held(parts)
    if least < _FREE:
        _refuse(parts, freest, _UNHELD)
    nearly_free = least < _ALONG_NORMAL
    if nearly_free:
        parts = parts.with_coupling(replace(parts.coupling, nearly_free=True))

    def fold(found: Solution) -> Solution:
        return _folded(found, problem, elastic, parts)

    found = solve(parts, of_parts, schedule, _start(initial, parts), fold)
    solution = fold(found)
    displacement = solution.displacement
    if nearly_free:
        change = math.inf
        with suppress(ProblemError):  # tilted normals may let the loads move a part very far
            again = solve(_tilted(parts), of_parts, schedule, found, fold)
            moved = parts.coupling.folded(again.displacement)
            change = float(np.abs(moved - displacement).max())
        if change > _MOST_CHANGE * float(np.abs(displacement).max()):
            _refuse(parts, freest, _UNCERTAIN)
    _solutions.value = solution, found
    return solution


def _folded(found: Solution, problem: Problem, prior: Elastic, parts: UnfoldedProblem) -> Solution:
    """Return the solution of a problem that belongs to one of its unfolded problem."""
    assert problem.sliding is not None
    # An energy is reported per site of tissue, and a copy is no site.
    share = np.count_nonzero(parts.tissue) / np.count_nonzero(problem.tissue)
    reach = found.reach
    grown = 1.0 if reach is None else reach.grown
    loads, elasticity = problem.loads, Elasticity.of_problem(problem, prior, grown)
    if has_drift(problem, prior):
        assert found.loads is not None
        assert found.loads.growth is not None
        growth = parts.coupling.folded(found.loads.growth)
        force = None if loads is None else loads.force
        loads = Loads(growth=growth, force=force, spacing=problem.spacing)
        elasticity = replace(elasticity, growth=loads.growth)
    return replace(
        found,
        displacement=parts.coupling.folded(found.displacement),
        energy=found.energy * share,
        levels=tuple(replace(level, shape=problem.shape) for level in found.levels),
        tissue=problem.tissue,
        loads=loads,
        elasticity=elasticity,
        reach=None if reach is None else _folded_reach(reach, parts),
        provenance=replace(found.provenance, inputs=problem.digests),
        parts=problem.sliding.labels,
    )


def _supported(problem: Problem, prior: Prior, optimizer: Optimizer) -> Elastic:
    """Return the prior, or raise an error if parts cannot slide in this model."""
    if not isinstance(prior, ElasticPrior | NeoHookeanPrior) or not isinstance(
        optimizer, Multigrid
    ):
        raise ProblemError(
            "sliding",
            "is for ElasticPrior or NeoHookeanPrior with Multigrid. Use such a model, or remove "
            "the sliding parts.",
        )
    if isinstance(prior, NeoHookeanPrior):
        if problem.has_rigid:
            raise ProblemError(
                "sliding",
                "cannot be combined with rigid tissue in large motion. Use ElasticPrior, or give "
                "that tissue a finite stiffness.",
            )
        if prior.can_slip(problem):
            raise ProblemError(
                "sliding",
                "cannot be combined with observations that may slip in large motion. Use "
                "ElasticPrior, or a confidence of 1 and no penalty.",
            )
    return prior


def _folded_reach(reach: Reach, parts: UnfoldedProblem) -> Reach:
    """Return a report whose sites are those of the image."""
    places, shape = parts.coupling.places(), parts.coupling.stiffness.shape

    def folded(site: tuple[int, ...]) -> tuple[int, ...]:
        place = places[np.ravel_multi_index(site, parts.shape)]
        return tuple(map(int, np.unravel_index(place, shape)))

    return replace(
        reach,
        where=None if reach.where is None else folded(reach.where),
        unbalanced_at=None if reach.unbalanced_at is None else folded(reach.unbalanced_at),
        regions=tuple(map(folded, reach.regions)),
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
    pieces, count = pieces_of(parts.stiffness)
    motions = freedom(len(parts.shape))
    least, freest = math.inf, np.zeros(parts.shape, np.bool_)
    for cluster, (*ties, gaps) in clusters(ties_of(pieces, count, parts.known, parts), count):
        if len(cluster) * motions > _MOST:
            continue
        cost = _CERTAIN * costs_of(ties, len(cluster), parts.shape)
        cost += costs_of([gaps], len(cluster), parts.shape)
        everywhere = [tie.in_all_directions() for tie in (*ties, gaps)]
        scale = costs_of(everywhere, len(cluster), parts.shape)
        scale += _TINY * max(float(np.trace(scale)), 1.0) * np.eye(len(scale))
        values, modes = scipy.linalg.eigh(cost, scale, subset_by_index=[0, 0])
        if values[0] < min(least, _ALONG_NORMAL):
            least = float(values[0])
            moved = np.abs(modes[:, 0].reshape(len(cluster), motions)).max(axis=1)
            freest = around_sites(pieces == 1 + cluster[int(moved.argmax())], np.logical_or)
            if not (freest & parts.coupling.own).any():  # a piece of copies only
                freest = around_sites(np.isin(pieces, 1 + cluster), np.logical_or)
    return least, freest


def _refuse(parts: UnfoldedProblem, piece: npt.NDArray[np.bool_], why: str) -> NoReturn:
    """Raise an error about a piece of tissue that is not held."""
    image = parts.coupling.folded(piece)
    centre = tuple(int(np.mean(at)) for at in np.nonzero(image))
    raise ProblemError(
        "sliding",
        f"leaves a piece of tissue free: the piece of {int(image.sum())} pixels around {centre} "
        f"{why}. Hold or move part of it.",
    )
