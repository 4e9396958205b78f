"""What a study is refused for before any work, and what its owner may not expect of it.

Both are said of the parts that people know.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.study.study import Study

FloatArray = npt.NDArray[np.float32]


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
            "beside which nothing that is held may slip. Set 'holding force' under 'Advanced' to "
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
        raise LayerError(study.named("tissue", "image"), f"has rigid tissue ({which}), {why}")


def refuse_nothing(study: Study, m: FloatArray, c: FloatArray) -> None:
    """Refuse what holds nothing, and what holds only where there is no tissue.

    Parameters
    ----------
    study : Study
    m : ndarray, shape ([D,] H, W)
        Stiffness.
    c : ndarray, shape ([D,] H, W, n)
        Confidence.

    Raises
    ------
    ProblemError
        Naming the boundary.
    """
    named, drawn, tissue = map(study.names.get, ("boundary", "drawing", "tissue"))
    somewhere, silent = (c != 0).any(axis=-1), "says nothing of how tissue moves."
    if not somewhere.any():
        if drawn is not None:
            sentence = "Nothing is held or moved yet: take a tool and drag tissue, or paint."
            raise LayerError(drawn, silent, sentence)
        if named is None:
            return  # the problem itself says it
        sentence = (
            f"Nothing in '{named}' counts on this slice: add something, with a confidence above 0, "
            "up to 1 for certain."
        )
        raise LayerError(named, silent, sentence)
    if drawn is None and named and tissue and not (somewhere & (m != 0)).any():
        raise LayerError(
            named,
            "lies outside all tissue.",
            f"All of '{named}' lies where there is no tissue (stiffness 0). Paint it on "
            f"tissue, or give that place of '{tissue}' a stiffness.",
        )


def refuse_void(study: Study, m: FloatArray) -> None:
    """Refuse a study without any tissue.

    Raises
    ------
    ProblemError
        Naming what says where there is some.
    """
    if not m.any():
        named = study.named("tissue", "image")
        raise LayerError(
            named,
            "has stiffness 0 everywhere.",
            f"There is no tissue in '{named}': all of it has stiffness 0. Give what is tissue "
            "a stiffness above 0.",
        )


def holes(study: Study) -> str:
    """Refuse a picture of nothing; count the holes of another, as a clause."""
    image, named = study.pictures.image, study.named("image")
    if image is None or image.dtype.kind != "f":
        return ""
    bad = int((~np.isfinite(image)).sum())
    if bad == image.size:
        raise LayerError(named, "is NaN everywhere in this slice. Choose another image or slice.")
    return f"{bad} pixels of '{named}' are NaN or infinite" if bad else ""


def lack(problem: Problem) -> str:
    """Say what a painted boundary lacks: something that moves, or that holds the rest."""
    moves, seen = problem.known & (problem.observed != 0), problem.known.any(axis=-1)
    if not moves.any():
        return (
            "nothing moves: have something on tissue move or expand, by a distance other than 0 "
            "and with a confidence above 0"
        )
    rim = problem.tissue & ~scipy.ndimage.binary_erosion(problem.tissue)
    if (seen & rim).any() or (seen & ~problem.observed.any(axis=-1)).any():
        return ""
    return (
        "nothing holds the tissue, so that all of it gives way: paint what stays where it is, such "
        "as bone, as 'fixed'"
    )
