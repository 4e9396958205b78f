"""Conversion of layers to a problem, for tests of recorded studies.

To test another reader, change only `read`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from napari_hmrf import ICM, ElasticPrior, Multigrid, Problem, SeilerPrior
from napari_hmrf.layers.landmarks import read_landmarks
from napari_hmrf.layers.read import Request, study_from_layers
from napari_hmrf.layers.slice_view import View, frame_of
from napari_hmrf.study.ground import Ground, build_problem
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from tests.support.studies import Study


class Read(NamedTuple):
    """Arguments of `solve(*read)`."""

    problem: Problem
    prior: Any
    optimizer: Any


def read(study: Study) -> Read:
    """Read the layers, tables and drawing of a study as the window does."""
    prior, optimizer = _model(**study.model)
    view = View.of(study.viewer.dims)
    curve = None if study.curve is None else StiffnessCurve.from_dict(study.curve)
    drawing = None
    if study.drawing is not None:
        drawing = Drawing.from_dict({"marks": study.drawing})
    hold_edge = study.hold_edge and drawing is not None
    if study.where is not None:
        reference = study.image if study.image is not None else study.tissue
        frame = frame_of(reference, view)
        shape = tuple(reference.data.shape[axis] for axis in frame.plane)
        how = study.landmarks
        marks = read_landmarks(study.where, study.should, frame, shape, view, **how)
        drawing = Drawing((*marks, *(drawing.marks if drawing else ())))
    request = Request(
        tissue=study.tissue,
        boundary=study.boundary,
        image=study.image,
        confidence=study.confidence,
        view=view,
        hold_edge=hold_edge,
        drawing=drawing,
        curve=curve,
    )
    stated = build_problem(replace(study_from_layers(request), prior=prior, optimizer=optimizer))
    return Read(stated.problem, stated.prior, stated.optimizer)


def read_ground(image: Any, tissue: Any = None, boundary: Any = None, **how: Any) -> Ground:
    """Return the ground of layers to draw on, with a fixed edge by default."""
    chosen = {"hold_edge": True, "drawing": Drawing(), **how}
    request = Request(tissue=tissue, boundary=boundary, image=image, **chosen)
    return Ground.of(study_from_layers(request))


class Stated(NamedTuple):
    """Problem read from a request, with frame, pictures and notes."""

    problem: Problem
    prior: Any
    frame: Any
    pictures: Any
    notes: tuple[str, ...]


def read_layers(request: Request, prior: Any = None, optimizer: Any = None) -> Stated:
    """Read a request into a problem, by default for the paper's prior and schedule."""
    model = {"prior": prior or SeilerPrior(), "optimizer": optimizer or ICM()}
    study = replace(study_from_layers(request), **model)
    ground = Ground.of(study)
    stated = ground.statement()
    return Stated(
        problem=stated.problem,
        prior=stated.prior,
        frame=study.grid.place,
        pictures=study.pictures,
        notes=ground.notes_on(stated),
    )


def _model(
    energy: str,
    schedule: str = "paper",
    poisson: float = 0.45,
    plane: str = "stress",
    grip: float | None = None,
    penalty: float | None = None,
) -> tuple[Any, Any]:
    if energy == "elastic":
        return ElasticPrior(poisson, plane=plane, penalty=grip), Multigrid()
    return SeilerPrior(penalty=penalty), ICM() if schedule == "paper" else Multigrid()
