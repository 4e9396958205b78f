"""Tests of messages about a result."""

from types import SimpleNamespace

import numpy as np
import pytest

from napari_hmrf.layers.result_layers import CompleteResult, Outputs
from napari_hmrf.notes import Note
from napari_hmrf.study.measured_motion import MeasuredMotion
from napari_hmrf.study.session import ModelChoice
from napari_hmrf.study.study import Grid, Motion, Study
from napari_hmrf.tissue.boundary_rules import BoundaryRule
from napari_hmrf.ui.messages import BACK, OFFER, marks_of, offer_of, warnings_of


@pytest.mark.parametrize(("folds", "marks"), [(0, {}), (5, {}), (6, {"folds": 6})])
def test_a_few_folded_pixels_cause_no_warning_and_more_do(folds, marks):
    assert marks_of(Outputs(None, {}, folds)) == marks


@pytest.mark.parametrize(
    ("note", "label"),
    [
        (
            "nothing holds the tissue, so that all of it gives way: hold its edge",
            "Nothing holds the tissue",
        ),
        (Note("label 3 of 'Tissue' is unknown", short="label 3 is unknown"), "Label 3 is unknown"),
    ],
)
def test_the_label_of_a_warning_without_folds_names_the_issue_in_a_few_words(note, label):
    notes = (note, "more")
    study = SimpleNamespace(grid=SimpleNamespace(shape=(4, 4)))
    done = CompleteResult(SimpleNamespace(study=study), Outputs(None, {}, 0), notes)
    assert warnings_of(done, "nothing")[1] == label


def test_large_motion_is_offered_for_folds_unless_it_does_not_support_the_study():
    y, precision = np.zeros((4, 4, 2), np.float32), np.zeros((4, 4, 2, 2), np.float32)
    marks = np.ones((4, 4), np.uint8)
    slides = Motion(labels=marks, rules=(BoundaryRule(1, "slide"),))
    for motion, offer in ((Motion(measured=MeasuredMotion(y, precision)), OFFER), (slides, "")):
        study = Study(Grid((4, 4), (1, 1)), motion=motion)
        outputs = Outputs(SimpleNamespace(parts=None), {}, 99)
        done = CompleteResult(SimpleNamespace(study=study, solution=None), outputs, ())
        assert offer_of(done, ModelChoice()) == offer
        assert offer_of(done, ModelChoice("large motion")) == BACK
        assert offer_of(done, ModelChoice("large motion", unfolds=False)) == ""
    assert offer_of(None, ModelChoice()) == ""
