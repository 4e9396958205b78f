"""From layers to a problem: the one place where tests of recorded studies know who reads them.

Another reader is tried by changing `read`; nothing else of those tests has to change.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from napari.layers import Layer
from studies import Study

from napari_hmrf import ICM, ElasticPrior, Multigrid, Problem, SeilerPrior
from napari_hmrf.layers.ground import read_ground
from napari_hmrf.layers.inputs import Request, copy_layers, prepare
from napari_hmrf.layers.landmarks import LandmarkLayers
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, rows_of
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.stiffness_layers import stiffness_layer
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve


class Read(NamedTuple):
    """What is solved: as `solve(*read)`."""

    problem: Problem
    prior: Any
    optimizer: Any


def read(study: Study) -> Read:
    """Read a study's layers, tables and drawing as the window does."""
    prior, optimizer = _model(**study.model)
    view = View.of(study.viewer.dims)
    tissue = study.tissue if study.curve is None else _by_curve(study)
    if study.drawing is not None:
        ground = read_ground(study.image, tissue, study.boundary, view, study.hold_edge, prior)
        drawing = Drawing.from_dict({"version": 1, "marks": study.drawing})
        has_tissue = any(mark.get("action") == "tissue" for mark in study.drawing)
        return Read(*ground.problem(drawing.render(ground.base), has_tissue), optimizer)
    landmarks = None
    if study.where is not None:
        landmarks = LandmarkLayers(study.where, study.should, **study.landmarks)
    request = Request(
        tissue=tissue,
        boundary=study.boundary,
        image=study.image,
        materials=_table(tissue, TISSUE),
        rules=_table(study.boundary, BOUNDARY),
        confidence=study.confidence,
        view=view,
        landmarks=landmarks,
    )
    inputs = prepare(copy_layers(request), prior, optimizer, complete=True)
    return Read(inputs.problem, inputs.prior, optimizer)


def _table(layer: Any, role: Any) -> tuple[Any, ...]:
    return () if layer is None else rows_of(layer, role) or ()


def _by_curve(study: Study) -> Any:
    made = stiffness_layer(study.image, StiffnessCurve.from_dict(study.curve or {}))
    return study.viewer.add_layer(Layer.create(*made))


def _model(
    energy: str,
    schedule: str = "paper",
    poisson: float = 0.45,
    plane: str = "stress",
    grip: float = math.inf,
    penalty: float | None = None,
) -> tuple[Any, Any]:
    if energy == "elastic":
        return ElasticPrior(poisson, plane=plane, penalty=grip), Multigrid()
    return SeilerPrior(penalty=penalty), ICM() if schedule == "paper" else Multigrid()
