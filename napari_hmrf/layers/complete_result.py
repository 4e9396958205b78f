"""Layers of a completed deformation, and notes for the user."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from napari_hmrf.field.held_forces import held_forces
from napari_hmrf.layers.result_layers import Outputs, result_layers
from napari_hmrf.notes import kind_of
from napari_hmrf.posterior.study_uncertainty import ground_uncertainty
from napari_hmrf.solver.drift import drift_clauses
from napari_hmrf.solver.priors import Elastic, ElasticPrior
from napari_hmrf.solver.solution import Solution
from napari_hmrf.study.engine import Deformation
from napari_hmrf.study.ground import Ground
from napari_hmrf.study.shortcomings import FOLDS, shortcomings
from napari_hmrf.tissue.drawing.record import record_of

#: Largest number of labels whose mean displacements are estimated. More labels would take longer
#: than the samples of the patches.
_MOST_LABELS = 10


class CompleteResult(NamedTuple):
    """Completed deformation, its layers, and notes for the user; each note is a clause."""

    moved: Deformation
    outputs: Outputs
    notes: tuple[str, ...]


def complete_result(
    moved: Deformation, checkpoint: Callable[[], None] = lambda: None
) -> CompleteResult:
    """Create the layers of a deformation, and collect notes for the user.

    Parameters
    ----------
    moved : Deformation
        Deformation with a solution.
    checkpoint : callable
        Called between steps; raises an exception to cancel the work.
    """
    study, ground, stated, solved = moved.study, moved.ground, moved.stated, moved.solution
    assert ground is not None
    assert stated is not None
    assert solved is not None
    place, pictures = study.grid.place, study.pictures
    if stated.labels is not None:
        pictures = replace(pictures, labels=stated.labels)
    # A ground may be older than the drawing.
    ground = replace(ground, study=study)
    of_study = tuple(filter(None, ground.notes_on(stated)))
    stored = (*drift_clauses(solved), *of_study) if of_study else solved.notes
    kept = replace(_solution_to_keep(moved, ground), notes=stored)
    forces = estimate = None
    if isinstance(stated.prior, Elastic):
        forces = partial(held_forces, stated.problem, solved)
    if isinstance(stated.prior, ElasticPrior):
        labels = pictures.labels
        is_quick = labels is None or len(np.unique(labels)) <= _MOST_LABELS
        where = kept.tissue if is_quick else np.zeros_like(kept.tissue)
        estimate = partial(ground_uncertainty, ground, stated, labels=labels, where=where)
    outputs = result_layers(kept, place, pictures, checkpoint, stated.problem, forces, estimate)
    short = shortcomings(solved, study.grid.unit, outputs.folds, stated.problem)
    # The warning chip reports the number of folds.
    notes = (*(note for note in short if kind_of(note) != FOLDS), *of_study)
    return CompleteResult(moved, outputs, notes)


def _solution_to_keep(moved: Deformation, ground: Ground) -> Solution:
    """Return the solution without air and with records of the drawing and the tissue."""
    study, solution = moved.study, moved.solution
    assert solution is not None
    body = solution.tissue & ground.body
    if not np.array_equal(body, solution.tissue):
        field = np.where(body[..., None], solution.displacement, np.float32(0))
        solution = replace(solution, displacement=field, tissue=body)
    if study.motion.drawing.marks:
        solution = replace(solution, frame={"drawing": record_of(study.motion.drawing)})
    if study.tissue.record or study.tissue.stiffness_unit:
        record = {"unit": study.tissue.stiffness_unit, **study.tissue.record}
        parameters = {**solution.provenance.parameters, "tissue": record}
        solution = replace(solution, provenance=replace(solution.provenance, parameters=parameters))
    return solution
