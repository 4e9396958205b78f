"""Tests that painted layers, which do not move, are never visible over a deformed image."""

from dataclasses import replace

import pytest

from napari_hmrf import Arrow, Drawing
from napari_hmrf.layers.metadata import metadata_of
from napari_hmrf.ui.messages import MEANWHILE
from tests.support.docks import viewer_of
from tests.support.screen import Screen
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


def test_an_edit_while_the_result_is_drawn_keeps_the_message(widget, small_sample, run):
    _, _, boundary = small_sample(viewer_of(widget))

    def edit(event):
        widget.without_border = not widget.without_border
        widget.without_border = not widget.without_border

    boundary.events.visible.connect(edit)
    run(widget)
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


def test_a_painted_layer_that_the_user_selects_or_makes_is_ready_for_paint(pulling_beside, settle):
    person, widget = pulling_beside
    viewer = person.viewer
    widget.drawing = Drawing((Arrow((32, 32), (0, 6), 8.0),))
    settle(widget)
    deformed = deformed_of(viewer)
    assert deformed.visible
    Screen(widget).press("New tissue layer")
    assert widget.status.startswith("Paint in 'Tissue' and 'Boundary': click a row")
    settle(widget)
    for layer in (widget.tissue, widget.boundary):
        viewer.layers.selection.active = layer
        assert layer.visible
        assert layer.mode == "paint"
        assert not deformed.visible
        widget.materials = (*widget.materials[:-1], replace(widget.materials[-1], stiffness=70.0))
        settle(widget)
        assert layer.visible, "an edit of a table hides the layer"
        assert layer.mode == "paint", "an edit of a table takes the brush"
        widget.start()
        settle(widget)
        assert deformed.visible
        assert not layer.visible


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
    tissue.selected_label = 0
    Touch(viewer).drag((8, 10), (12, 10))
    settle(widget)
    holes = widget.solution.tissue.sum()
    viewer.layers.selection.active = widget.image
    settle(widget)
    assert not tissue.visible
    widget.undo()
    settle(widget)
    assert widget.solution.tissue.sum() > holes, "the undone paint was not noticed"


def shows_paint(widget):
    """Return whether the image and its paint are shown undeformed, with the message about it."""
    deformed, tissue = deformed_of(viewer_of(widget)), widget.tissue
    is_undeformed = tissue.visible and not deformed.visible
    assert is_undeformed == (MEANWHILE in widget.status)
    assert tissue.visible != deformed.visible
    return is_undeformed


def test_the_deformed_image_returns_when_painting_ends(painted, settle):
    widget, *_ = painted
    viewer, screen = viewer_of(widget), Screen(widget)
    actions = {
        "view": lambda: setattr(widget.tissue, "mode", "pan_zoom"),
        "image": lambda: setattr(viewer.layers.selection, "active", widget.image),
        "tool": lambda: screen.press("Pull"),
        "play": lambda: screen.press("Play"),
        "overlay": lambda: setattr(widget, "overlay", "magnitude"),
        "eye": lambda: setattr(widget.tissue, "visible", False),
        "deform": lambda: screen.entry("More", "Solve precisely").trigger(),
    }
    for end, act in actions.items():
        screen.click_row("air")
        assert shows_paint(widget), end
        act()
        widget.pause()
        settle(widget)
        assert not shows_paint(widget), end
        assert widget.tissue.mode == "pan_zoom" or end in ("image", "tool")
        widget.overlay = "nothing"
        settle(widget)
        if end != "eye":  # the user has hidden the layer, which stays selected
            assert viewer.layers.selection.active is not widget.tissue, end
            viewer.layers.selection.active = widget.tissue
            assert shows_paint(widget), f"{end}: selecting the layer does not show it"
            assert widget.tissue.mode == "paint"


def test_the_first_result_is_not_shown_while_the_user_paints(widget, small_sample, at_rest, settle):
    small_sample(viewer_of(widget))
    at_rest()
    Screen(widget).click_row("air")
    assert MEANWHILE not in widget.status
    widget.live = True
    settle(widget)
    assert widget.solution is not None
    assert widget.boundary.visible, "the paint of the other layer was hidden"
    assert shows_paint(widget)
    widget.tissue.mode = "pan_zoom"
    assert not shows_paint(widget)
