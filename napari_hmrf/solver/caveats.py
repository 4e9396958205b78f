"""Caveats about the solution of a problem, as clauses for the user."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.notes import Note
from napari_hmrf.solver.model_names import converged
from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.optimizers.base import Reach
from napari_hmrf.solver.priors import Elastic, NeoHookeanPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.quadtree import levels, sampled

# Smallest fraction of a boundary that the first three coarse levels must sample. They sample 0.16
# to 0.29 of a boundary that is one pixel wide, and 0.41 or more if the boundary is 3 pixels wide.
_SAMPLED_SHARE = 0.32
# The fraction is not checked for up to this many levels, because images of up to 32 pixels have few
# coarse levels.
_SMALLEST_TREE = 6
# Number of regions short of their targets that a clause names, besides the farthest.
_NAMED_REGIONS = 3
# Difference of the observed displacements of two neighbouring sites, in pixels, above which tissue
# between them cannot follow.
_TEARING = 3.0
# Held tissue is in the way up to this multiple of a displacement, because tissue before it that is
# crushed needs room as well.
_CRUSHED = 1.25
# Clause about tissue that observations with a precision hold.
_OF_DATA = Note(
    "measured motion, such as that of a registration, holds the tissue around: move the tissue "
    "less, or remove the measured motion",
    short="measured motion holds the tissue",
)
#: Kind of the note about tissue without sufficient constraints.
LOOSE = "loose"


def caveats(problem: Problem, prior: Prior, optimizer: Optimizer) -> tuple[str, ...]:
    """Return caveats about a problem that can be solved, as clauses for the user.

    Parameters
    ----------
    problem : Problem
    prior : SeilerPrior, ElasticPrior or NeoHookeanPrior
    optimizer : ICM or Multigrid
    """
    if isinstance(prior, Elastic):
        notes = [rigid_caveat(problem, prior)]
    else:
        thin = "" if converged(optimizer.parameters) else _thin_boundary(problem)
        notes = [thin, _loose_pieces(problem)]
    return tuple(filter(None, notes))


def shortfall(reach: Reach | None, unit: str) -> str:
    """Describe how a large-motion solution falls short of the problem; "" if it does not.

    Parameters
    ----------
    reach : Reach or None
        Reach of a solution, with lengths in `unit`.
    unit : str
        Unit of lengths.
    """
    clauses, short = [], ""
    if reach is not None and reach.grown < 1:
        clauses.append(f"only {reach.grown:.0%} of the growth was possible: there is no more room")
    if reach is not None and reach.where is not None:
        cause = (
            "the solve stopped before the tissue was fully there"
            if reach.stopped
            else "tissue could not move all the way without being crushed"
        )
        if not clauses:
            end = "is not fully there yet" if reach.stopped else "stays short of its target"
            short = f"{'' if reach.stopped else 'some '}tissue {end}"
        clauses.append(
            f"{cause}: {reach.sites} pixels stay short of their targets, the pixel at "
            f"{reach.where} by {reach.missing:.3g} {unit}{_other_regions(reach)}"
        )
    if reach is not None and reach.unbalanced_at is not None:
        cause = "tissue had no time to settle" if reach.stopped else "crushed tissue did not settle"
        # The estimate is rough: an estimate above the distance from the targets says only that
        # the tissue has not settled.
        far = f": pixels may still be {reach.unbalanced:.3g} {unit} from equilibrium"
        is_rough = 0 < reach.missing < reach.unbalanced
        clauses.append(f"{cause}{'' if is_rough else far}, most at {reach.unbalanced_at}")
    if clauses and reach is not None and reach.stopped:
        clauses.append("to go on, allow more work (`budget`)")
    return Note("; ".join(clauses), short) if clauses else ""


def touching(problem: Problem, edge: npt.NDArray[np.bool_] | None = None) -> str:
    """Return a clause if neighbouring sites have very different observed displacements, or "".

    No model can follow both observations without tearing or crushing the tissue between them.

    Parameters
    ----------
    problem : Problem
    edge : ndarray of bool, shape ([D,] H, W), optional
        Outer edge of the tissue, which the clause then names.
    """
    known = np.asarray(problem.known.all(axis=-1))
    y = np.where(known[..., None], problem.observed, np.nan) / np.asarray(problem.spacing)
    at: tuple[int, ...]
    after: tuple[int, ...]
    most, at, after = _TEARING, (), ()
    for axis in range(known.ndim):
        difference = np.sqrt((np.diff(y, axis=axis) ** 2).sum(axis=-1))
        difference[np.isnan(difference)] = 0
        farthest = float(difference.max(initial=0.0))
        if farthest > most:
            most = farthest
            first = np.unravel_index(int(difference.argmax()), difference.shape)
            at = tuple(map(int, first))
            after = tuple(index + (along == axis) for along, index in enumerate(at))
    if not at:
        return ""
    still = [site for site in (at, after) if not problem.observed[site].any()]
    if edge is not None and any(edge[site] for site in still):
        return Note(
            f"at {at}, tissue is moved beside the outer edge, which is held, and what lies between "
            "is torn or crushed: move tissue farther inside, or let the edge move",
            short="moved tissue touches the held edge",
        )
    return Note(
        f"at {at}, tissue that is held or moved in two different ways touches, and what lies "
        "between is torn or crushed: release one of the two, or move them farther apart",
        short="held and moved tissue touch",
    )


def in_the_way(problem: Problem, reach: Reach, edge: npt.NDArray[np.bool_] | None = None) -> str:
    """Return a clause about what keeps tissue from its target, or "".

    This is held tissue in its way, or else measured motion.

    Parameters
    ----------
    problem : Problem
    reach : Reach
        Reach of the solution of the problem.
    edge : ndarray of bool, shape ([D,] H, W), optional
        Outer edge of the tissue, which the clause then names.
    """
    if reach.where is None or reach.stopped or not problem.known[reach.where].all():
        return ""
    spacing = np.asarray(problem.spacing)
    motion = problem.observed[reach.where] / spacing
    length = float(np.linalg.norm(motion))
    held = np.argwhere(problem.known.all(axis=-1) & (problem.observed == 0).all(axis=-1))
    if length == 0:
        return ""
    # Tissue that is moved together has about this radius.
    radius = _radius_of(reach.sites, held.shape[1])
    away = held - reach.where
    ahead = away @ motion / length
    beside = np.linalg.norm(away - ahead[:, None] * (motion / length), axis=1)
    is_near = (ahead > 0) & (beside <= radius) & (ahead <= _CRUSHED * length + radius)
    if not is_near.any():
        return _OF_DATA if problem.precision is not None else ""
    nearest = np.where(is_near, np.linalg.norm(away, axis=1), np.inf).argmin()
    at = tuple(map(int, held[nearest]))
    if edge is not None and edge[at]:
        return Note(
            f"the outer edge, which is held, is in the way at {at}: move the tissue less, or let "
            "the edge move",
            short="the held edge is in the way",
        )
    return Note(
        f"held tissue is in the way at {at}: move the tissue less, or release what is held",
        short="held tissue is in the way",
    )


def _radius_of(sites: int, axes: int) -> float:
    """Return the radius of a disc or ball of a number of sites, in pixels."""
    return float(np.sqrt(sites / np.pi) if axes == 2 else np.cbrt(0.75 * sites / np.pi))


def _other_regions(reach: Reach) -> str:
    """Return the positions of the other regions that stay short of their targets, or ""."""
    others = [str(at) for at in reach.regions[1:]]
    if len(others) > _NAMED_REGIONS:
        others[_NAMED_REGIONS:] = [f"in {len(others) - _NAMED_REGIONS} more regions"]
    if not others:
        return ""
    *first, last = others
    return f", and others at {', '.join(first)} and {last}" if first else f", and others at {last}"


def missing_constraint(problem: Problem) -> str:
    """Return a clause if no tissue moves or the tissue is not constrained; otherwise "".

    Parameters
    ----------
    problem : Problem
    """
    if problem.loads is not None or problem.landmarks is not None:
        # Another check raises an error for unconstrained tissue.
        return ""
    observed = problem.known.any(axis=-1)
    if problem.precision is not None:
        observed |= problem.precision.any(axis=(-2, -1))
    displacements = problem.observed[observed]
    if not displacements.any():
        return (
            "nothing moves: mark tissue that moves or expands, by a distance other than 0 "
            "and with a confidence above 0"
        )
    if problem.precision is not None:
        return ""
    rim = problem.tissue & ~scipy.ndimage.binary_erosion(problem.tissue)
    tolerance = 1e-3 * float(np.abs(displacements).max())
    is_translation = np.allclose(displacements, displacements[0], atol=tolerance)
    if not displacements.any(axis=-1).all() or ((observed & rim).any() and not is_translation):
        return ""
    motion = "moves as one" if is_translation else "gives way"
    remedy = "hold its edge (`hold_edge=True`), or paint the tissue that stays in place"
    return Note(f"nothing holds the tissue, so that all of it {motion}: {remedy}", kind=LOOSE)


def rigid_caveat(problem: Problem, prior: Prior) -> str:
    """Return a clause if rigid tissue makes uncertain observations exact; otherwise "".

    Only large motion does so.

    Parameters
    ----------
    problem : Problem
    prior : Prior
        Prior, before its method `resolved` is called.
    """
    is_large = isinstance(prior, NeoHookeanPrior)
    if not is_large or prior.penalty is not None or not problem.has_rigid:
        return ""
    doubted = problem.known & (problem.confidence < 1)
    count = int(doubted.any(axis=-1).sum())
    if not count:
        return ""
    pixels = "1 boundary pixel was" if count == 1 else f"{count} boundary pixels were"
    return Note(
        f"{pixels} held exactly, although the confidence is below 1, because observations cannot "
        "slip in large motion with rigid tissue",
        short="uncertain tissue is held exactly",
    )


def _thin_boundary(problem: Problem) -> str:
    """Return a clause if the boundary is too thin for the coarse levels; otherwise ""."""
    # Level n samples every 2^n-th pixel. Motion starts on the coarse levels; if they miss a
    # boundary, the sweeps on the finest level cannot correct for it.
    tree = levels(problem.shape)
    if len(tree) <= _SMALLEST_TREE:
        return ""
    observed = np.asarray(problem.known.any(axis=-1))
    shares = []
    for level in tree[1:4]:
        size = 2**level.number
        blocks = observed
        for axis, extent in enumerate(observed.shape):
            blocks = np.logical_or.reduceat(blocks, np.arange(0, extent, size), axis=axis)
        shares.append(float(sampled(observed, level).sum()) / max(1.0, float(blocks.sum())))
    if np.mean(shares) > _SAMPLED_SHARE:
        return ""
    return Note(
        "most of the boundary is so thin that the coarse levels miss it, and the motion falls "
        "short: make it at least 3 pixels wide",
        short="the boundary is too thin",
    )


def _loose_pieces(problem: Problem) -> str:
    """Return a clause if pieces of tissue have no observation; otherwise ""."""
    around = np.ones((3,) * problem.tissue.ndim)
    pieces, count = scipy.ndimage.label(problem.tissue, structure=around)
    held = np.unique(pieces[problem.known.any(axis=-1)])
    loose = count - int((held > 0).sum())
    if not loose:
        return ""
    pixels = int((problem.tissue & ~np.isin(pieces, held)).sum())
    sites = "voxels" if problem.tissue.ndim == 3 else "pixels"
    subject = "a piece of tissue touches" if loose == 1 else f"{loose} pieces of tissue touch"
    return Note(
        f"{subject} no boundary ({pixels} {sites}): the motion there is not determined",
        short=f"{subject} no boundary",
    )
