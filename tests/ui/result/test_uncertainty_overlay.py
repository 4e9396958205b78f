"""Tests of the overlay of the uncertainty, and of the error bar in the status bar."""

import re
import threading
from dataclasses import replace

import numpy as np
import pytest
from qtpy.QtWidgets import QFileDialog, QTableWidget

from napari_hmrf import Drawing, HmrfError, Landmark
from napari_hmrf.io.images import read_image
from tests.support.docks import viewer_of
from tests.support.screen import Screen
from tests.support.timeouts import LONG


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
    stopped = threading.Event()
    shown.answer = replace(shown.answer, estimate=lambda progress, cancel: stopped.wait(LONG))
    elastic.overlay = "uncertainty"
    wait_for(lambda: screen.button("Cancel").isEnabled())
    assert "Estimating the uncertainty" in elastic.status
    screen.press("Cancel")
    stopped.set()
    wait_for(lambda: not elastic.busy)
    assert elastic.overlay == "nothing"
    assert "was not estimated" in elastic.status
    assert bars(elastic) is None


def test_results_of_the_papers_model_have_no_uncertainty(widget, small_sample, run, wait_for):
    small_sample(viewer_of(widget))
    run(widget)
    Screen(widget).choose("uncertainty (not of this result)")
    wait_for(lambda: widget.overlay == "nothing")
    assert "Only results of the elastic model" in widget.status


def test_an_estimated_uncertainty_is_exported_and_gives_measurements_error_bars(
    elastic, wait_for, tmp_path, monkeypatch
):
    screen, path = Screen(elastic), tmp_path / "sd.tif"
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_, **__: (str(path), ""))
    assert not screen.entry("More", "Export uncertainty").isEnabled()
    assert all(row.mean_displacement_sd is None for row in elastic.more.measure())
    with pytest.raises(HmrfError, match="Choose 'uncertainty' in 'overlay' first"):
        elastic.more.save_uncertainty(path)
    elastic.overlay = "uncertainty"
    wait_for(lambda: bars(elastic) is not None)
    estimated = elastic._view.shown.estimated
    (row,) = elastic.more.measure()
    assert row.mean_displacement_sd == estimated.labels[row.label].along > 0
    screen.entry("More", "Measurements").trigger()
    (table,) = elastic.native.window().findChildren(QTableWidget, "measurements")
    cells = [table.item(0, at).text() for at in range(table.columnCount())]
    assert f"{row.mean_displacement:.3f} ± {row.mean_displacement_sd:.3f}" in cells
    table.window().close()
    screen.entry("More", "Export uncertainty").trigger()
    wait_for(lambda: not elastic.busy)
    assert "sd.tif, sd-row.tif, sd-col.tif" in elastic.status
    np.testing.assert_array_equal(read_image(path).pixels, estimated.along)


def test_the_table_of_landmarks_shows_the_error_bar_of_the_tissue(elastic, wait_for):
    elastic.drawing = Drawing((Landmark((10, 12), (10, 13), 3.0, sd=0.5),))
    wait_for(lambda: not elastic.busy)
    Screen(elastic).entry("More", "Landmarks ...").trigger()
    (table,) = elastic.native.window().findChildren(QTableWidget, "measurements")
    assert table.isColumnHidden(4)
    elastic.overlay = "uncertainty"
    wait_for(lambda: bars(elastic) is not None)
    assert not table.isColumnHidden(4)
    assert table.horizontalHeaderItem(4).text() == "tissue ± (px)"
    # The overlay shows the tissue where it is now.
    assert float(table.item(0, 4).text()) == pytest.approx(bars(elastic).data[10, 13], rel=0.1)
    table.window().close()
