"""Layers and tables become a problem, and complete its prior."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.layers.background import air_that_is_tissue
from napari_hmrf.layers.label_defaults import default_material, default_rule
from napari_hmrf.layers.layer_names import LayerError, Named, naming
from napari_hmrf.layers.observed_arrows import arrow_observations
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.reading_warnings import caveats, lacks
from napari_hmrf.layers.result_layers import Pictures
from napari_hmrf.layers.snapshot import Request, Snapshot, copy_layers
from napari_hmrf.solver.optimizers import ICM, Optimizer
from napari_hmrf.solver.priors import ElasticPrior, Prior, SeilerPrior
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.unconnected import left_at_rest, scraps
from napari_hmrf.tissue.boundary_rules import boundary_images, poisson_image, stiffness_image
from napari_hmrf.tissue.drawing import Canvas, Drawing
from napari_hmrf.tissue.labels import labels_present

__all__ = [
    "Inputs",
    "Request",
    "Snapshot",
    "copy_layers",
    "prepare",
    "read_layers",
    "refuse_rigid",
]

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Inputs:
    """Everything a solve needs, which no later painting changes.

    Attributes
    ----------
    problem : Problem
    prior : SeilerPrior or ElasticPrior
        The energy asked for; an elastic one with the Poisson's ratios of the table of tissues.
    frame : Frame
        Where the slice lies.
    pictures : Pictures
        The slices of the image and of the tissue labels, to be deformed.
    ignored : int
        Boundary pixels painted where there is no tissue.
    notes : tuple of str
        What the user should know about how the layers were read.
    """

    problem: Problem
    prior: Prior
    frame: Frame
    pictures: Pictures
    ignored: int = 0
    notes: tuple[str, ...] = ()


def read_layers(
    request: Request, prior: Prior | None = None, optimizer: Optimizer | None = None
) -> Inputs:
    """Turn layers and tables into a problem and its prior; the one way to do so.

    Parameters
    ----------
    request : Request
    prior, optimizer
        As for `prepare`.

    Returns
    -------
    Inputs
        Copies; no layer is kept or changed.

    Raises
    ------
    ProblemError
        Naming the layer, what is wrong with it and what to do.
    """
    return prepare(copy_layers(request), prior, optimizer)


def prepare(
    snapshot: Snapshot,
    prior: Prior | None = None,
    optimizer: Optimizer | None = None,
    complete: bool = False,
    checkpoint: Callable[[], None] = lambda: None,
) -> Inputs:
    """Turn copies of layers into a problem; on any thread, for it takes a while on large images.

    Parameters
    ----------
    snapshot : Snapshot
    prior : SeilerPrior or ElasticPrior, optional
        The energy; by default the paper's. Where tissues are labels, Poisson's ratios are those of
        their table; where the layer is an image of stiffness, the prior's own.
    optimizer : ICM or Multigrid, optional
        The schedule, by default the paper's: some notes are about what it does badly.
    complete : bool
        Whether a label without a row gets a default one, and a note, instead of an error.
    checkpoint : callable
        Called between the parts; raises to stop the work.

    Returns
    -------
    Inputs

    Raises
    ------
    ProblemError
        As `read_layers`.
    """
    prior = prior or SeilerPrior()
    refuse_rigid(snapshot, prior)
    notes = snapshot.notes + _check_picture(snapshot)
    if complete:
        snapshot, added = _completed(snapshot)
        notes += added
    checkpoint()
    tissue, boundary = snapshot.tissue_name, snapshot.boundary_name
    with naming(stiffness=tissue):
        if snapshot.tissue_labelled:
            m = stiffness_image(snapshot.tissue, snapshot.materials)
            if isinstance(prior, ElasticPrior):
                prior = replace(prior, poisson=poisson_image(snapshot.tissue, snapshot.materials))
        else:
            m = snapshot.tissue
            notes += _check_digits(tissue, m)
    checkpoint()
    with naming(
        stiffness=tissue,
        observed=boundary,
        confidence=snapshot.confidence_name or boundary,
        spacing=snapshot.reference_name,
    ):
        y, c, out = _observed(snapshot)
        if out:
            what = "1 arrow points" if out == 1 else f"{out} arrows point"
            notes += (f"{what} straight out of the slice and did not count",)
        checkpoint()
        ignored = int(((c > 0).any(axis=-1) & (m == 0)).sum())
        y, c = _with_landmarks(snapshot, m, y, c)
        _refuse_in_words(snapshot, m, c)
        there = np.asarray(m > 0)
        if isinstance(prior, ElasticPrior):
            scrap = scraps(there, c > 0)
            if scrap.any():
                m = np.where(scrap, 0, m)
                notes += (left_at_rest(scrap),)
        problem = Problem(y, c, m, spacing=snapshot.frame.spacing)
    checkpoint()
    if snapshot.boundary_labelled and snapshot.landmarks is None:
        notes += lacks(problem, y, there)
    picture = snapshot.pictures.image
    if complete and snapshot.tissue_labelled and picture is not None:
        notes += air_that_is_tissue(picture, there)
    return Inputs(
        problem=problem,
        prior=prior,
        frame=snapshot.frame,
        pictures=snapshot.pictures,
        ignored=ignored,
        notes=(*notes, *caveats(problem, prior, optimizer or ICM())),
    )


def refuse_rigid(snapshot: Snapshot, prior: Prior) -> None:
    """Refuse rigid tissue of a prior that cannot have it, in words and before any work.

    Raises
    ------
    ProblemError
        Naming the layer, what in it is rigid and what to do.
    """
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
    if snapshot.tissue_labelled:
        rigid = [row for row in snapshot.materials if row.is_rigid]
        names = [row.name or f"label {row.label}" for row in rigid if row.label in snapshot.tissue]
        there, which = bool(names), " and ".join(f"'{name}'" for name in names)
    else:
        there, which = bool((snapshot.tissue == np.inf).any()), "an infinite stiffness"
    if there:
        raise LayerError(snapshot.tissue_name, f"has rigid tissue ({which}), {why}")


def _completed(snapshot: Snapshot) -> tuple[Snapshot, tuple[str, ...]]:
    """Give labels that no table mentions their default, and say so."""
    notes = []
    materials, rules = list(snapshot.materials), list(snapshot.rules)
    if snapshot.tissue_labelled:
        listed = {material.label for material in materials}
        for label in labels_present(snapshot.tissue):
            if int(label) not in listed:
                materials.append(default_material(int(label), snapshot.materials))
                notes.append(
                    f"label {label} of '{snapshot.tissue_name.name}' is not in the table and got "
                    f"stiffness {materials[-1].stiffness:g}"
                )
    if snapshot.boundary_labelled:
        listed = {0, *(rule.label for rule in rules)}
        for label in labels_present(snapshot.boundary):
            if int(label) not in listed:
                rules.append(default_rule(int(label)))
                notes.append(
                    f"label {label} of '{snapshot.boundary_name.name}' is not in the table and was "
                    "held fixed"
                )
    return replace(snapshot, materials=tuple(materials), rules=tuple(rules)), tuple(notes)


def _check_picture(snapshot: Snapshot) -> tuple[str, ...]:
    """Refuse a picture of nothing; count the holes of another."""
    picture, named = snapshot.pictures.image, snapshot.image_name
    if picture is None or named is None or picture.dtype.kind != "f":
        return ()
    bad = int((~np.isfinite(picture)).sum())
    if bad == picture.size:
        raise LayerError(named, "is NaN everywhere in this slice. Choose another image or slice.")
    return (f"{bad} pixels of '{named.name}' are NaN or infinite",) if bad else ()


def _check_digits(layer: Named, stiffness: npt.NDArray[Any]) -> tuple[str, ...]:
    """Say so where single precision, which the solver works in, rounds whole numbers."""
    if stiffness.dtype.kind not in "iu":
        return ()
    # Bit by bit: no float holds all 64-bit integers to compare with.
    whole = np.maximum(stiffness, 1).astype(np.uint64)
    lowest_bit = whole & (~whole + np.uint64(1))
    rounded = int((whole // lowest_bit > 2**24).sum())
    if not rounded:
        return ()
    return (f"{rounded} whole numbers of '{layer.name}' above 2^24 were rounded",)


def _observed(snapshot: Snapshot) -> tuple[FloatArray, FloatArray, int]:
    spacing = snapshot.frame.spacing
    if snapshot.boundary_labelled:
        return (*boundary_images(snapshot.boundary, snapshot.rules, spacing=spacing), 0)
    y, c, out = arrow_observations(
        snapshot.boundary, snapshot.boundary_frame, spacing, snapshot.shape
    )
    if snapshot.confidence is not None:
        if snapshot.confidence.ndim != 2:
            raise LayerError(
                snapshot.confidence_name, "is a colour image. Choose a grey image of values 0 to 1."
            )
        sure = snapshot.confidence.astype(np.float32)
        c = np.where(c > 0, sure[..., None], np.float32(0))
    return y, c, out


def _with_landmarks(
    snapshot: Snapshot, m: npt.NDArray[Any], y: FloatArray, c: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What was observed, with the landmarks on top: what is marked there counts."""
    landmarks, spacing = snapshot.landmarks, snapshot.frame.spacing
    if landmarks is None or not m.any():
        return y, c
    landmarks.refuse_void(m != 0, spacing, snapshot.tissue_name)
    canvas = Drawing(landmarks.marks).render(Canvas(y, c, None, spacing))
    return canvas.observed, canvas.confidence


def _refuse_in_words(snapshot: Snapshot, m: npt.NDArray[Any], c: FloatArray) -> None:
    """What the solver would refuse by its symbols, said of the layers."""
    tissue, boundary = snapshot.tissue_name, snapshot.boundary_name
    if not m.any():
        raise LayerError(
            tissue,
            "has stiffness 0 everywhere.",
            f"There is no tissue in '{tissue.name}': all of it has stiffness 0. Give what is "
            "tissue a stiffness above 0.",
        )
    somewhere = (c != 0).any(axis=-1)
    if not somewhere.any():
        if not snapshot.boundary_labelled and snapshot.confidence is None:
            sentence = (
                f"No arrow of '{boundary.name}' starts in this slice: add some, or choose a Labels "
                "layer to paint on."
            )
        else:
            sentence = (
                f"Nothing in '{boundary.name}' counts: its confidence is 0 everywhere. Give "
                "something a confidence above 0, up to 1 for certain."
            )
        raise LayerError(boundary, "says nothing of how tissue moves.", sentence)
    if not (somewhere & (m != 0)).any():
        raise LayerError(
            boundary,
            "lies outside all tissue.",
            f"All of '{boundary.name}' lies where there is no tissue (stiffness 0). Paint it on "
            f"tissue, or give that place of '{tissue.name}' a stiffness.",
        )
