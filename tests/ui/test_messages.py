"""Tests of messages about a result."""

from types import SimpleNamespace

import pytest

from napari_hmrf.layers.complete_result import CompleteResult
from napari_hmrf.layers.result_layers import Outputs
from napari_hmrf.ui.messages import marks_of, warnings_of


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
        (
            "label 3 of 'Tissue' is not in the table: stiffness 1 is assumed",
            "Label 3 is not in the table",
        ),
        (
            "2 pieces of tissue with too few constraints stay at rest (9 pixels)",
            "2 pieces of tissue stay at rest",
        ),
    ],
)
def test_the_label_of_a_warning_without_folds_names_the_issue_in_a_few_words(note, label):
    notes = (note, "more")
    study = SimpleNamespace(grid=SimpleNamespace(shape=(4, 4)))
    done = CompleteResult(SimpleNamespace(study=study), Outputs(None, {}, 0), notes)
    assert warnings_of(done, "nothing")[1] == label
