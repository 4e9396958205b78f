"""What a study is refused for before any work, said of the parts that people know."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.study.layer_names import LayerError, Named
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
