"""Inputs and analyses that only some models support."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import (
    BoundaryRule,
    ElasticPrior,
    Grid,
    Material,
    Motion,
    NeoHookeanPrior,
    Study,
    Tissue,
)
from napari_hmrf.errors import LayerError, ProblemError
from napari_hmrf.solver.model_names import ELASTIC, MODELS
from napari_hmrf.study.ground import build_problem
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.models import parts_of
from napari_hmrf.study.support import refuse_model, supports, unsupported
from napari_hmrf.tissue.drawing import Drawing, Landmark, Stroke

SHAPE = (12, 12)
LABELS = np.ones(SHAPE, np.uint8)
LABELS[:, 6:] = 2
PLAIN = Material(1, "muscle", 1.0), Material(2, "fat", 2.0)


def study(*rows, **motion):
    given = Motion(hold_edge=True, **motion)
    return Study(Grid(SHAPE, (1.0, 1.0)), Tissue(labels=LABELS, materials=rows or PLAIN), given)


def drawn(*marks):
    return study(drawing=Drawing(marks))


ALL = tuple(MODELS.values())
MEASURED = MeasuredMotion(np.zeros((*SHAPE, 2), np.float32), np.ones((*SHAPE, 2, 2), np.float32))
#: A study with each input, the part of the study that has it, and the models that support it.
INPUTS = {
    "sliding stroke": (
        drawn(Stroke("slide", (((2, 2), (2, 9)),), 1.0)),
        "drawing",
        ("elastic",),
    ),
    "sliding label": (
        study(labels=LABELS, rules=(BoundaryRule(2, "slide"),)),
        "boundary",
        ("elastic",),
    ),
    "sliding tissue": (
        study(PLAIN[0], replace(PLAIN[1], slides=True)),
        "tissue",
        ELASTIC,
    ),
    "rigid tissue that slides": (
        study(PLAIN[0], replace(PLAIN[1], slides=True, stiffness=np.inf)),
        "tissue",
        ("elastic",),
    ),
    "growth": (study(PLAIN[0], replace(PLAIN[1], growth=0.1)), "tissue", ELASTIC),
    "weight": (study(weight=(0.0, 0.1)), "weight", ELASTIC),
    "rigid tissue": (study(PLAIN[0], replace(PLAIN[1], stiffness=np.inf)), "tissue", ELASTIC),
    "uncertain landmark": (
        drawn(Landmark((5, 5), (6, 5), 1.0, sd=0.5)),
        "drawing",
        ELASTIC,
    ),
    "drift": (
        study(drawing=Drawing((Landmark((5, 5), (6, 5), 1.0, sd=0.5),)), drift=True),
        "drawing",
        ("elastic",),
    ),
    "measured motion": (study(measured=MEASURED), "registration", ELASTIC),
    "infinite stiffness": (
        replace(study(), tissue=Tissue(stiffness=np.where(LABELS == 2, np.inf, 1.0))),
        "tissue",
        ELASTIC,
    ),
    "drift without an uncertain landmark": (study(drift=True), "", ALL),
    "exact landmark": (drawn(Landmark((5, 5), (6, 5), 1.0)), "", ALL),
    "rigid tissue that is not painted": (study(*PLAIN, Material(3, "bone", np.inf)), "", ALL),
}


@pytest.mark.parametrize("name", INPUTS)
def test_a_model_refuses_exactly_the_inputs_that_it_does_not_support(name):
    given, part, models = INPUTS[name]
    for model in MODELS.values():
        error = unsupported(given, parts_of(model))
        assert (error is None) == (model in models), model
        if error is not None:
            assert error.field == part
            prior, optimizer = parts_of(model)
            with pytest.raises(LayerError, match="does not support"):
                build_problem(replace(given, prior=prior, optimizer=optimizer))


@pytest.mark.parametrize("name", ["rigid tissue", "sliding tissue"])
def test_large_motion_of_rigid_or_sliding_tissue_needs_exact_constraints(name):
    given = INPUTS[name][0]
    prior, optimizer = NeoHookeanPrior(penalty=0.1), given.optimizer
    assert unsupported(given, (prior, optimizer)).field == "tissue"
    assert unsupported(given, (replace(prior, penalty=np.inf), optimizer)) is None
    assert unsupported(given, (ElasticPrior(penalty=0.1), optimizer)) is None


@pytest.mark.parametrize(
    ("analysis", "models"),
    [("registration", ("elastic",)), ("fit", ELASTIC), ("uncertainty", ("elastic",))],
)
def test_an_analysis_is_refused_for_other_models(analysis, models):
    for model in MODELS.values():
        assert supports(model, analysis) == (model in models)
        prior, optimizer = parts_of(model)
        if model not in models:
            with pytest.raises(ProblemError) as refusal:
                refuse_model(replace(study(), prior=prior, optimizer=optimizer), analysis)
            assert refusal.value.field == "model"
