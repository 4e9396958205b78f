"""What a study is refused for before any work, and what its owner may not expect of it.

Both are said of the parts that people know.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.model_names import converged
from napari_hmrf.solver.optimizers import Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.quadtree import levels, nearest_pixels
from napari_hmrf.study.layer_names import LayerError, Named
from napari_hmrf.study.study import Study

FloatArray = npt.NDArray[np.float32]

# How much of a boundary the first three coarse levels see: of one a pixel wide 0.16 to 0.29, of one
# of 3 pixels 0.41 or more. Images of up to 32 pixels have no coarse levels to speak of.
_ENOUGH = 0.32
_SMALLEST_TREE = 6


def refuse_rigid(study: Study) -> None:
    """Refuse rigid tissue of a prior that cannot have it, in words and before any work.

    Raises
    ------
    ProblemError
        Naming the tissue, what in it is rigid and what to do.
    """
    prior, tissue = study.prior, study.tissue
    why = (
        "which the paper's model cannot have: it compares stiffness by ratios. Take the elastic "
        "model, or give it a number."
    )
    if isinstance(prior, ElasticPrior):
        if prior.penalty == math.inf:
            return
        why = (
            "beside which nothing that is observed may slip. Set 'penalty K' under 'Advanced' to "
            "'held exactly', or give it a number."
        )
    if tissue.labels is not None:
        rigid = [row for row in tissue.materials if row.is_rigid]
        names = [row.name or f"label {row.label}" for row in rigid if row.label in tissue.labels]
        there, which = bool(names), " and ".join(f"'{name}'" for name in names)
    else:
        given = tissue.stiffness
        there, which = given is not None and bool((given == np.inf).any()), "an infinite stiffness"
    if there:
        raise LayerError(tissue_name(study), f"has rigid tissue ({which}), {why}")


def refuse_nothing(study: Study, m: FloatArray, c: FloatArray) -> None:
    """Refuse what holds nothing, and what holds only where there is no tissue.

    Parameters
    ----------
    study : Study
    m : ndarray, shape (H, W)
        Stiffness.
    c : ndarray, shape (H, W, 2)
        Confidence.

    Raises
    ------
    ProblemError
        Naming the boundary.
    """
    named, tissue = study.names.get("boundary"), study.names.get("tissue")
    somewhere = (c != 0).any(axis=-1)
    drawn = study.names.get("drawing")
    if drawn is not None and not somewhere.any():
        sentence = "Nothing is held or moved yet: take a tool and drag tissue, or paint."
        raise LayerError(drawn, "says nothing of how tissue moves.", sentence)
    if named is None or drawn is not None:
        return  # the problem itself says it, of what is drawn
    if not somewhere.any():
        if study.motion.labels is None and "confidence" not in study.names:
            sentence = (
                f"No arrow of '{named.name}' starts in this slice: add some, or choose a "
                "Labels layer to paint on."
            )
        else:
            sentence = (
                f"Nothing in '{named.name}' counts: its confidence is 0 everywhere. Give "
                "something a confidence above 0, up to 1 for certain."
            )
        raise LayerError(named, "says nothing of how tissue moves.", sentence)
    if tissue is not None and not (somewhere & (m != 0)).any():
        raise LayerError(
            named,
            "lies outside all tissue.",
            f"All of '{named.name}' lies where there is no tissue (stiffness 0). Paint it on "
            f"tissue, or give that place of '{tissue.name}' a stiffness.",
        )


def no_tissue(study: Study) -> LayerError:
    """The error that there is no tissue at all."""
    name = tissue_name(study)
    return LayerError(
        name,
        "has stiffness 0 everywhere.",
        f"There is no tissue in '{name.name}': all of it has stiffness 0. Give what is tissue a "
        "stiffness above 0.",
    )


def image_notes(study: Study) -> tuple[str, ...]:
    """Refuse a picture of nothing; count the holes of another."""
    image, named = study.pictures.image, study.names.get("image", Named("image", "of the study"))
    if image is None or image.dtype.kind != "f":
        return ()
    bad = int((~np.isfinite(image)).sum())
    if bad == image.size:
        raise LayerError(named, "is NaN everywhere in this slice. Choose another image or slice.")
    return (f"{bad} pixels of '{named.name}' are NaN or infinite",) if bad else ()


def digit_notes(study: Study, stiffness: npt.NDArray[Any]) -> tuple[str, ...]:
    """Say so where single precision, which the solver works in, rounds whole numbers."""
    if stiffness.dtype.kind not in "iu":
        return ()
    # Bit by bit: no float holds all 64-bit integers to compare with.
    whole = np.maximum(stiffness, 1).astype(np.uint64)
    lowest_bit = whole & (~whole + np.uint64(1))
    rounded = int((whole // lowest_bit > 2**24).sum())
    if not rounded:
        return ()
    return (f"{rounded} whole numbers of '{tissue_name(study).name}' above 2^24 were rounded",)


def tissue_name(study: Study) -> Named:
    """What people call the part that says where there is tissue."""
    names = study.names
    return names.get("tissue") or names.get("image") or Named("tissue", "of the study")


def caveats(problem: Problem, prior: Prior, optimizer: Optimizer) -> tuple[str, ...]:
    """Say what may surprise, as clauses for people; nothing that is refused anyway.

    Parameters
    ----------
    problem : Problem
    prior : SeilerPrior or ElasticPrior
    optimizer : ICM or Multigrid
    """
    if isinstance(prior, ElasticPrior):
        notes = [_held_exactly(problem) if prior.penalty == math.inf else ""]
    else:
        thin = "" if converged(optimizer.parameters) else _thin_boundary(problem)
        notes = [thin, _loose_pieces(problem)]
    return tuple(filter(None, notes))


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
    note = _at_rest(problem, painted != 0, tissue[..., None]) or _adrift(problem)
    return (note,) if note else ()


def _at_rest(problem: Problem, moves: npt.NDArray[np.bool_], tissue: npt.NDArray[np.bool_]) -> str:
    """Say so, and why, where all that was observed stays where it is."""
    if not moves.any():
        return (
            "nothing that is painted moves: have something move or expand, by a distance other "
            "than 0"
        )
    if not (moves & tissue).any():
        return (
            "nothing moves: all that is to move is painted where there is no tissue (stiffness 0). "
            "Paint it on tissue, or give that place a stiffness"
        )
    if not (moves & tissue & (problem.confidence > 0)).any():
        return (
            "nothing moves: all that is to move has a confidence of 0, with which it does not "
            "count. Give it one above 0, up to 1 for certain"
        )
    return ""


def _adrift(problem: Problem) -> str:
    """Say so where something moves within tissue whose rim nothing holds or moves."""
    seen = problem.known.any(axis=-1)
    rim = problem.tissue & ~scipy.ndimage.binary_erosion(problem.tissue)
    if (seen & rim).any() or (seen & ~problem.observed.any(axis=-1)).any():
        return ""
    return (
        "nothing holds the tissue, so that all of it gives way: paint what stays where it is, such "
        "as bone, as 'fixed'"
    )


def _held_exactly(problem: Problem) -> str:
    """Say so where a doubt about the boundary does not count."""
    doubted = problem.known & (problem.confidence < 1)
    count = int(doubted.any(axis=-1).sum())
    if not count:
        return ""
    what = "1 boundary pixel was" if count == 1 else f"{count} boundary pixels were"
    return (
        f"{what} held exactly, though of a confidence below 1, as beside rigid tissue nothing may "
        "slip"
    )


def _thin_boundary(problem: Problem) -> str:
    """Say so where the coarse levels, which take every second pixel and fewer, miss a boundary."""
    # There its motion begins; what they miss, the sweeps on the finest level do not make up for.
    tree = levels(problem.shape)
    if len(tree) <= _SMALLEST_TREE:
        return ""
    seen = np.asarray(problem.known.any(axis=-1))
    shares = []
    for level in tree[1:4]:
        rows, cols = nearest_pixels(level, problem.shape)
        size = 2**level.number
        there = seen
        for axis, extent in enumerate(seen.shape):
            there = np.logical_or.reduceat(there, np.arange(0, extent, size), axis=axis)
        sampled = seen.take(rows, axis=0).take(cols, axis=1)
        shares.append(float(sampled.sum()) / max(1.0, float(there.sum())))
    if np.mean(shares) > _ENOUGH:
        return ""
    return (
        "most of the boundary is so thin that the coarse levels miss it, and the motion falls "
        "short: make it at least 3 pixels wide"
    )


def _loose_pieces(problem: Problem) -> str:
    """Say so where tissue hangs on nothing that was observed."""
    pieces, count = scipy.ndimage.label(problem.tissue, structure=np.ones((3, 3)))
    held = np.unique(pieces[problem.known.any(axis=-1)])
    loose = count - int((held > 0).sum())
    if not loose:
        return ""
    pixels = int((problem.tissue & ~np.isin(pieces, held)).sum())
    what = "a piece of tissue touches" if loose == 1 else f"{loose} pieces of tissue touch"
    return f"{what} no boundary ({pixels} pixels): how it moves is not determined"
