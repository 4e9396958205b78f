"""What is chosen, painted, drawn and set in the dock, saved to a file and opened again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from napari_hmrf.io.study_file import load_study, save_study
from napari_hmrf.layers.edit_history import CURVE
from napari_hmrf.layers.metadata import known_of
from napari_hmrf.layers.read import study_layers
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.study.models import details_of, family_of
from napari_hmrf.ui import messages


def save(dock: Any, path: str | Path, fresh: bool) -> Path:
    """Save the study of a `SoftTissue`, and its field if that is fresh."""
    solution = dock.solution if fresh else None
    written = save_study(path, dock.study, solution)
    dock.say(messages.saved_study(written.name, solution is not None))
    return written


def open_into(dock: Any, viewer: Any, path: str | Path) -> None:
    """Add the layers of a saved study to a viewer, and have its dock be as it was."""
    study = load_study(path).study
    layers = study_layers(study)
    for layer in layers.values():
        viewer.add_layer(layer)
    for part in ("image", "tissue", "boundary", "confidence"):
        setattr(dock, part, layers.get(part))
    if study.tissue.curve is not None:
        dock.curve = study.tissue.curve
    dock.hold_edge = study.motion.hold_edge
    dock.without_border = study.tissue.without_border
    dock.model = family_of(study.prior, study.optimizer)
    dock.settings = details_of(study.prior, study.optimizer)
    if isinstance(study.prior, ElasticPrior):
        dock.plane = study.prior.plane
        if np.ndim(study.prior.poisson) == 0:
            dock.poisson = float(study.prior.poisson)
    dock.drawing = study.motion.drawing
    for layer in viewer.layers:
        if known_of(layer).get("kind") == CURVE and study.moves:
            layer.visible = False
