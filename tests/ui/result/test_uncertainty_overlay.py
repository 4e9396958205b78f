"""Tests of the overlay of the uncertainty, and of the error bar in the status bar."""

import re
from dataclasses import replace

import numpy as np
import pytest

from napari_hmrf import Drawing, Landmark
from tests.support.docks import viewer_of
from tests.support.screen import Screen


@pytest.fixture
def elastic(widget, small_sample, run):
    """Return the dock with a result of elastic tissue, held at the left and pushed right."""
    small_sample(viewer_of(widget))
    widget.model = "elastic"
    run(widget)
    return widget


def bars(widget):
    """Return the layer of the uncertainty, or None."""
    layers = viewer_of(widget).layers
    return next((layer for layer in layers if "uncertainty" in layer.name), None)


def test_the_overlay_shows_the_uncertainty_of_patches_and_the_status_bar_an_error_bar(
    elastic, wait_for
):
    elastic.overlay = "uncertainty"
    wait_for(lambda: bars(elastic) is not None)
    layer = bars(elastic)
    assert layer.visible
    assert "px, patches of" in layer.name
    drawn = layer.data[np.isfinite(layer.data)]
    assert drawn.max() > 0.05
    assert "±" in elastic._view.cursor.line_at((10, 12))
    row, col = map(int, re.search(r"at pixel \((\d+), (\d+)\)", elastic.status).groups())
    shown = elastic._view.shown
    assert (
        shown.estimated.along[row, col] == shown.estimated.along[shown.answer.solution.tissue].max()
    )
    elastic.overlay = "nothing"
    wait_for(lambda: bars(elastic) is None)


def test_a_new_result_has_a_new_uncertainty(elastic, wait_for):
    elastic.overlay = "uncertainty"
    wait_for(lambda: bars(elastic) is not None)
    before = float(np.nanmax(bars(elastic).data))
    elastic.drawing = Drawing((Landmark((10, 12), (10, 13), 3.0, sd=0.05),))
    wait_for(lambda: not elastic.busy)
    wait_for(lambda: bars(elastic) is not None)
    assert np.nanmax(bars(elastic).data) < before
    assert "±" in elastic._view.cursor.line_at((10, 12))


def test_an_estimate_is_cancelled_by_the_button_and_changes_nothing(elastic, wait_for):
    screen, shown = Screen(elastic), elastic._view.shown
    waits = replace(shown.answer, estimate=lambda progress, cancel: cancel.wait(60))
    shown.answer = waits
    elastic.overlay = "uncertainty"
    wait_for(lambda: screen.button("Cancel").isEnabled())
    assert "Estimating the uncertainty" in elastic.status
    screen.press("Cancel")
    wait_for(lambda: not elastic.busy)
    assert elastic.overlay == "nothing"
    assert "was not estimated" in elastic.status
    assert bars(elastic) is None


def test_results_of_the_papers_model_have_no_uncertainty(widget, small_sample, run, wait_for):
    small_sample(viewer_of(widget))
    run(widget)
    widget.overlay = "uncertainty"
    wait_for(lambda: widget.overlay == "nothing")
    assert "Only results of the elastic model" in widget.status
