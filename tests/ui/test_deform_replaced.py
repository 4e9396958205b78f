"""Tests that a press of Deform always ends, even if an edit replaces its study."""

import numpy as np
import pytest

from napari_hmrf.tissue.drawing import Arrow, Drawing
from tests.support.docks import quick


@pytest.fixture
def stack_dock(frame, at_rest):
    """Return a dock beside a stack of two slices; the first slice is pulled."""
    rows, cols = np.indices((24, 26))
    slice_ = (np.hypot(rows - 12, cols - 13) < 10) * 100.0 + 20
    frame.viewer.add_image(np.stack([slice_, slice_ + 1]), name="MR")
    frame.viewer.dims.set_point(0, 0)
    dock = quick(frame.open())
    dock.live = False
    at_rest()
    dock.drawing = Drawing((Arrow((12, 13), (0, 2), 2.0),))
    at_rest.until(lambda: not dock.busy)
    return dock


@pytest.fixture
def finished(stack_dock):
    """Return a list that collects the results emitted by `finished`."""
    ended = []
    stack_dock.finished.connect(ended.append)
    return ended


def test_deform_ends_without_a_result_if_another_slice_is_displayed(
    frame, stack_dock, finished, busy_thread, at_rest
):
    stack_dock.deform()
    assert not stack_dock.idle
    frame.viewer.dims.set_point(0, 1)
    at_rest(thread=False)
    assert finished == [None]
    assert stack_dock.idle
    busy_thread.set()
    at_rest.until(lambda: not stack_dock.busy)
    assert finished == [None]
    stack_dock.drawing = Drawing((Arrow((12, 13), (2, 0), 2.0),))
    stack_dock.deform()
    at_rest.until(lambda: len(finished) == 2)
    assert finished[1] is not None, "the next press has no result"


def test_the_reason_for_a_refused_edit_stays_when_an_earlier_result_arrives(
    frame, stack_dock, busy_thread, at_rest
):
    stack_dock.live = True
    at_rest(thread=False)
    stack_dock.drawing = Drawing((Arrow((12, 13), (2, 0), 2.0),))
    at_rest(thread=False)
    stack_dock.boundary = frame.viewer.add_labels(np.zeros((5, 5), int), name="small")
    at_rest(thread=False)
    assert "The tissue was not updated" in stack_dock.status
    busy_thread.set()
    at_rest.until(lambda: not stack_dock.busy)
    assert "The tissue was not updated" in stack_dock.status


def test_deform_ends_without_a_result_if_the_drawing_is_removed(
    stack_dock, finished, busy_thread, at_rest
):
    stack_dock.deform()
    stack_dock.drawing = Drawing()
    busy_thread.set()
    at_rest.until(lambda: bool(finished))
    assert stack_dock.idle
    at_rest.until(lambda: not stack_dock.busy)
    assert len(finished) == 1


def test_deform_ends_if_a_layer_raises_an_unexpected_error(
    stack_dock, finished, at_rest, monkeypatch
):
    def fail(*_):
        raise RuntimeError("a layer of another plugin")

    with monkeypatch.context() as broken:
        broken.setattr("napari_hmrf.layers.read.study_from_layers", fail)
        broken.setattr("napari_hmrf.ui.controller.show_error", lambda _: None)
        stack_dock.deform()
    assert finished == [None]
    assert stack_dock.idle
    stack_dock.deform()
    at_rest.until(lambda: len(finished) == 2)
    assert finished[1] is not None
