"""Tests of messages about a result."""

import pytest

from napari_hmrf.layers.result_layers import Outputs
from napari_hmrf.ui.messages import marks_of


@pytest.mark.parametrize(("folds", "marks"), [(0, {}), (5, {}), (6, {"folds": 6})])
def test_a_few_folded_pixels_cause_no_warning_and_more_do(folds, marks):
    assert marks_of(Outputs(None, {}, folds)) == marks
