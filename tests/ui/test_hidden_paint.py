"""Tests that painted layers, which do not move, are never visible over a deformed image."""

import pytest

from napari_hmrf.layers.compat import drawn_node
from napari_hmrf.layers.metadata import metadata_of
from tests.support.docks import dock_in, quick, viewer_of
from tests.support.person import Person
from tests.support.windowless import Touch


def deformed_of(viewer):
    (layer,) = [each for each in viewer.layers if metadata_of(each).get("kind") == "image"]
    return layer


@pytest.fixture
def painted(widget, small_sample, settle):
    """Return the dock with the result of a painted sample in live mode, and its painted layers."""
    _, tissue, boundary = small_sample(viewer_of(widget))
    widget.live = True
    settle(widget)
    return widget, tissue, boundary


def test_paint_is_hidden_over_the_result_with_a_message(painted):
    widget, tissue, boundary = painted
    assert deformed_of(viewer_of(widget)).visible
    assert not tissue.visible
    assert not boundary.visible
    assert "because paint does not move with it: 'Tissue', 'Boundary'" in widget.status


def test_paint_stays_visible_on_an_undeformed_image(widget, small_sample, settle):
    _, tissue, boundary = small_sample(viewer_of(widget))
    boundary.data = boundary.data * 0
    widget.live = True
    settle(widget)
    assert tissue.visible
    assert boundary.visible


def test_paint_that_the_user_shows_brings_back_the_undeformed_image(painted):
    widget, tissue, _ = painted
    deformed = deformed_of(viewer_of(widget))
    tissue.visible = True
    assert not deformed.visible
    assert tissue.visible
    assert "'Tissue' belongs to the undeformed image, shown now" in widget.status
    tissue.visible = False
    assert deformed.visible


def test_a_selected_layer_ends_the_view_of_the_undeformed_image(painted):
    widget, tissue, _ = painted
    viewer = viewer_of(widget)
    viewer.layers.selection.active = tissue
    tissue.visible = True
    viewer.layers.selection.active = widget.image
    assert deformed_of(viewer).visible
    assert not tissue.visible


def test_undone_paint_in_a_hidden_layer_is_solved(painted, settle):
    widget, tissue, _ = painted
    viewer = viewer_of(widget)
    viewer.layers.selection.active = tissue
    tissue.visible, tissue.mode, tissue.selected_label = True, "paint", 0
    Touch(viewer).drag((8, 10), (12, 10))
    settle(widget)
    holes = widget.solution.tissue.sum()
    viewer.layers.selection.active = widget.image
    settle(widget)
    assert not tissue.visible
    widget.undo()
    settle(widget)
    assert widget.solution.tissue.sum() > holes, "the undone paint was not noticed"


def test_a_brush_stays_in_use_but_its_paint_is_not_drawn_over_the_result(
    make_napari_viewer, small_sample, at_rest, settle, qtbot
):
    viewer = make_napari_viewer(show=True)
    _, tissue, _ = small_sample(viewer, (48, 64))
    widget = quick(dock_in(viewer))
    widget.live = True
    at_rest()
    settle(widget)
    person, deformed = Person(viewer, qtbot), deformed_of(viewer)
    widget.hand_brush(tissue)

    def opacity():
        return drawn_node(viewer, tissue).opacity

    assert not deformed.visible
    seen = []
    person.paint((20, 20), (24, 24), between=lambda: seen.append(opacity()))
    assert set(seen) == {tissue.opacity}
    settle(widget)
    assert (deformed.visible, tissue.visible, tissue.mode) == (True, True, "paint")
    assert opacity() == 0
    person.press(20, 20)
    assert (deformed.visible, opacity()) == (False, tissue.opacity)
    person.release(20, 20)
    settle(widget)
    tissue.mode = "pan_zoom"  # as napari does while the space key is held
    assert (deformed.visible, tissue.visible, opacity()) == (False, True, tissue.opacity)
