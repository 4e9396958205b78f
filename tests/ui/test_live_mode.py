"""Tests of live mode, in which the result of the newest edit is shown."""

import threading

import numpy as np
import pytest
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest

from napari_hmrf import Multigrid, solve
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.layers.compat import drawn_node
from napari_hmrf.layers.metadata import METADATA, metadata_of
from napari_hmrf.study.ground import build_problem
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.tissue.drawing import Arrow, Drawing
from napari_hmrf.ui.messages import CHOOSE, MEANWHILE, STILL
from tests.support.docks import dock_in, forget_choice, quick, viewer_of
from tests.support.person import CTRL, Person
from tests.support.screen import Cell, Screen
from tests.support.timeouts import LONG, LONG_MS


def names(widget):
    return [layer.name for layer in viewer_of(widget).layers]


def by_name(widget, name):
    return viewer_of(widget).layers[name]


def cold_start(widget):
    """Return the solution that a script computes for the same layers."""
    stated = build_problem(widget.study)
    near = Multigrid(1e-4) if isinstance(stated.optimizer, Multigrid) else stated.optimizer
    return solve(stated.problem, stated.prior, optimizer=near, backend="cpu")


def assert_newest(widget):
    """Assert that the displayed result belongs to the current layers."""
    found, expected = widget.solution, cold_start(widget)
    assert found.displacement == pytest.approx(expected.displacement, abs=0.02)
    for layer in viewer_of(widget).layers:
        known = metadata_of(layer)
        here = known.get("slice") == widget.shown.grid.place.slice_name
        if known.get("kind") == "arrows" and here:
            assert known["solution"].displacement is found.displacement
            assert not known["inputs_changed"]


@pytest.fixture
def live_dock(widget, small_sample, run, settle):
    """Return the dock in live mode with a result, and the layers of its study."""
    layers = small_sample(viewer_of(widget))
    widget.model = "elastic"
    forget_choice(widget)
    run(widget)
    widget.live = True
    settle(widget)
    return widget, layers


def paint(layer, places, label):
    layer.data_setitem(tuple(np.array(places).T), label)


def test_live_mode_follows_paint_tables_and_model(live_dock, settle):
    widget, (_, tissue, boundary) = live_dock
    before, selected = widget.solution, widget.result
    layers = [id(layer) for layer in viewer_of(widget).layers]
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    settle(widget)
    assert widget.solution is not before
    assert np.abs(widget.solution.displacement[10, 12]).max() < 1e-3, (
        "the painted tissue is not fixed"
    )
    assert_newest(widget)
    widget.rules = (widget.rules[0], BoundaryRule(2, "move", vector=(2.0, 1.0)))
    settle(widget)
    assert widget.solution.displacement[10, -3] == pytest.approx((2.0, 1.0), abs=0.02)
    assert_newest(widget)
    paint(tissue, [(row, col) for row in range(4, 9) for col in range(14, 19)], 2)
    settle(widget)
    widget.materials = (*widget.materials[:2], Material(2, "lump", 900.0))
    settle(widget)
    assert_newest(widget)
    widget.poisson = 0.1
    widget.plane = "strain"
    settle(widget)
    assert_newest(widget)
    assert [id(layer) for layer in viewer_of(widget).layers] == layers, (
        "layers of the result were replaced"
    )
    assert widget.result is selected
    assert widget.status.startswith("Tissue moved up to")


def test_live_mode_follows_edits_with_the_paper_model(widget, small_sample, run, settle):
    _, _, boundary = small_sample(viewer_of(widget))
    widget.model = "paper, converged"
    run(widget)
    widget.live = True
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    settle(widget)
    assert widget.solution.displacement[10, 12] == pytest.approx((0, 0), abs=0.01)
    assert_newest(widget)


def test_the_newest_of_many_edits_is_shown_last(live_dock, settle, at_rest):
    widget, (_, _, boundary) = live_dock
    seen = []
    widget.result_drawn.connect(seen.append)
    for col in range(5, 14):
        boundary.data[...] = np.where(boundary.data == 3, 0, boundary.data)
        paint(boundary, [(row, col) for row in range(8, 12)], 3)
        widget.rules = (*widget.rules[:2], BoundaryRule(3, "move", vector=(1.0, col / 10)))
        if col % 3 == 0:
            at_rest()
    settle(widget)
    assert 1 <= len(seen) < 9
    assert_newest(widget)


def test_an_error_preserves_the_last_result_and_is_reported_once(live_dock, settle, monkeypatch):
    widget, _ = live_dock
    popups = []
    for kind in ("show_error", "show_warning"):
        monkeypatch.setattr(f"napari_hmrf.ui.controller.{kind}", popups.append)
    before, picture = widget.solution, by_name(widget, "MR deformed, elastic").data.copy()
    rules, why = widget.rules, "The tissue was not updated. 'Boundary' lets label 2 expand, but"
    for amount in (1.0, 2.0, 3.0):
        widget.rules = (rules[0], BoundaryRule(2, "expand", amount=amount))
        settle(widget)
        assert (widget.status == "Heard.") == (amount > 1), "the same error was reported again"
        if amount == 1:
            assert widget.status.startswith(why)
            assert widget.status.endswith("The last result is still shown.")
        widget.show_message("Heard.")
    assert widget.solution is before
    assert np.array_equal(by_name(widget, "MR deformed, elastic").data, picture)
    assert not popups, "a pop-up was shown although no button was pressed"
    widget.rules = rules
    settle(widget)
    assert widget.status.startswith("Tissue moved up to")
    assert_newest(widget)


def test_without_paint_the_undeformed_image_is_shown(live_dock, settle):
    widget, (image, _, boundary) = live_dock
    painted = boundary.data.copy()
    boundary.data = np.zeros_like(painted)
    settle(widget)
    assert widget.solution is None
    layers = viewer_of(widget).layers
    assert not any(layer.visible for layer in layers if layer.name.startswith("MR "))
    assert image.visible
    assert (widget.status, widget.details) == (STILL, "")
    boundary.data = painted
    settle(widget)
    assert widget.status.startswith("Tissue moved up to")
    assert_newest(widget)


def test_cancel_stops_a_solve_and_the_next_edit_is_followed(live_dock, settle, busy_thread, qtbot):
    widget, (_, _, boundary) = live_dock
    before = widget.solution
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    qtbot.waitUntil(lambda: widget._form.footer.cancel.enabled, timeout=LONG_MS)
    assert widget.status.startswith("Updating")
    widget.cancel()
    assert widget.status.startswith("Cancelled: the picture and the warnings")
    assert not widget._form.footer.cancel.enabled
    busy_thread.set()
    settle(widget)
    assert widget.solution is before
    paint(boundary, [(row, 14) for row in range(6, 14)], 1)
    settle(widget)
    assert_newest(widget)


def test_an_undo_with_a_cancelled_solve_remains_and_is_reported_until_deform(
    pulling_beside, settle, qtbot
):
    touch, widget = pulling_beside
    touch.drag((30, 30), (34, 34))
    settle(widget)
    go_on = threading.Event()
    compute_thread.submit(lambda: go_on.wait(LONG))
    widget.undo()
    qtbot.waitUntil(Screen(widget).button("Cancel").isEnabled, timeout=LONG_MS)
    Screen(widget).press("Cancel")
    go_on.set()
    settle(widget)
    picture = touch.viewer.layers["MR deformed, elastic"]
    assert not widget.drawing.marks
    assert widget.solution.displacement.any()
    assert metadata_of(picture)["inputs_changed"]
    assert (
        "warnings do not include the last edits. Press 'Solve precisely' under 'More'"
        in widget.status
    )
    assert "nothing was changed" not in widget.status
    Screen(widget).entry("More", "Solve precisely").trigger()
    settle(widget)
    assert not widget.solution.displacement.any()
    assert widget.status == STILL


def test_edits_are_followed_only_while_live_mode_is_on(live_dock, settle):
    widget, (_, _, boundary) = live_dock
    deform = Screen(widget).button("Deform")
    assert deform.isHidden() or deform.parent().isHidden(), "there is nothing to press"
    widget.live = False
    assert not deform.parent().isHidden()
    before = widget.solution
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    settle(widget)
    assert widget.solution is before
    widget.live = True
    settle(widget)
    assert_newest(widget)


def test_the_removal_of_the_image_is_reported(live_dock, settle, at_rest):
    widget, (image, *_) = live_dock
    viewer = viewer_of(widget)
    settle(widget)
    viewer.layers.remove(image)
    at_rest()
    assert widget.status == CHOOSE
    assert widget.solution is None
    viewer.add_image(image.data, name="T1")
    assert widget.image is viewer.layers["T1"]
    settle(widget)
    assert_newest(widget)
    viewer.add_image(image.data, name="T2", translate=(0, 300))
    viewer.layers.remove("T1")
    assert widget.image is viewer.layers["T2"]
    viewer.layers.clear()
    at_rest()
    assert widget.status.startswith("Open an image first")


def test_another_image_is_solved_as_soon_as_it_is_chosen(live_dock, small_sample, settle):
    widget, (first, *_) = live_dock
    viewer = viewer_of(widget)
    image, other, boundary = small_sample(viewer)
    assert widget.image is first, "an image with edits was deselected"
    widget.image = image
    assert (widget.image, widget.tissue) == (image, other)
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    settle(widget)
    assert widget.solution.displacement == pytest.approx(cold_start(widget).displacement, abs=0.02)
    there = widget.solution
    widget.image = first
    settle(widget)
    expected = cold_start(widget).displacement
    assert widget.solution.displacement == pytest.approx(expected, abs=0.02)
    assert np.abs(expected - there.displacement).max() > 0.5, (
        "the boundary of the other image was used"
    )


def test_layers_can_be_renamed_and_removed_during_a_solve(live_dock, settle, busy_thread, at_rest):
    widget, (image, tissue, boundary) = live_dock
    viewer = viewer_of(widget)
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    at_rest(thread=False)
    boundary.name, image.name = "Walls", "T1"
    viewer.layers.remove("MR arrows, elastic")
    busy_thread.set()
    settle(widget)
    assert_newest(widget)
    assert "T1 arrows, elastic" in names(widget), "the removed layer was not made again"
    paint(boundary, [(row, 15) for row in range(6, 14)], 1)
    viewer.layers.remove(boundary)
    settle(widget)
    assert widget.solution is None
    assert widget.status.endswith(STILL)
    widget.boundary = viewer.add_labels(
        boundary.data.copy(), name="again", metadata=dict(boundary.metadata)
    )
    settle(widget)
    assert_newest(widget)
    assert tissue in viewer.layers


def test_the_painted_slice_of_a_stack_is_followed(widget, small_sample, run, settle, qtbot):
    _, _, boundary = small_sample(viewer_of(widget), (3, 20, 24))
    boundary.data[0] = 0
    dims = viewer_of(widget).dims
    dims.set_current_step(0, 1)
    widget.model = "elastic"
    run(widget)
    widget.live = True
    first = widget.solution
    dims.set_current_step(0, 2)
    settle(widget)
    assert widget.solution is not first
    assert sum("deformed" in name for name in names(widget)) == 2
    assert widget.status.startswith("Slice 2: tissue moved")
    dims.set_current_step(0, 0)
    settle(widget)
    assert (widget.solution, widget.status) == (None, STILL)
    dims.set_current_step(0, 1)
    boundary.visible = True  # napari can paint only in visible layers
    boundary.data_setitem((np.full(8, 1), np.arange(6, 14), np.full(8, 12)), 1)
    settle(widget)
    assert_newest(widget)
    assert sum("deformed" in name for name in names(widget)) == 2


def test_a_press_of_deform_during_a_solve_does_not_restore_an_older_result(
    live_dock, settle, busy_thread, qtbot, at_rest
):
    widget, (_, _, boundary) = live_dock
    widget.deform()
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    at_rest(thread=False)
    busy_thread.set()
    qtbot.waitUntil(lambda: widget.idle, timeout=LONG_MS)
    settle(widget)
    assert_newest(widget)


# Painting with a mouse


def test_two_viewers_have_independent_docks(widget, frame, small_sample, settle, run):
    one, other = widget, quick(frame.open())
    for dock in (one, other):
        small_sample(viewer_of(dock))
    one.deform()
    run(other)
    settle(one)
    assert "MR arrows, paper" in names(one)
    assert "MR arrows, paper" in names(other)
    untouched = other.solution
    one.live = True
    one.tool, other.tool = "pin", "landmark"
    one.drawing = Drawing((Arrow((10, 12), (2, 0), 2),))
    settle(one)
    settle(other)
    assert_newest(one)
    assert other.solution is untouched
    assert (one.tool, other.tool) == ("pin", "landmark")
    assert not other.drawing.marks


@pytest.fixture
def user_in_live_mode(
    unstyled, without_controls, make_napari_viewer, small_sample, run, qtbot, at_rest
):
    """Return a simulated user with a brush in a window, and a dock in live mode."""
    viewer = make_napari_viewer(show=True)
    small_sample(viewer, (48, 64))
    dock = dock_in(viewer)
    quick(dock).model = "elastic"
    run(dock)
    dock.live = True
    at_rest()
    return Person(viewer, qtbot), dock


def test_tissue_follows_during_a_stroke_of_the_brush(user_in_live_mode, settle):
    person, dock = user_in_live_mode
    viewer = person.viewer
    boundary = viewer.layers["Boundary"]
    Cell(dock._form.motion.boundary.table, 0).click()
    assert viewer.layers.selection.active is boundary
    assert (boundary.mode, boundary.selected_label) == ("paint", 1)
    boundary.brush_size = 5
    deformed = viewer.layers["MR deformed, elastic"]
    assert not deformed.visible, "the moved image is visible below the paint"
    found = []
    dock.deformation_changed.connect(found.append)
    places = [(row, 32) for row in range(14, 34, 4)]
    during, shown = [], []

    def look():
        settle(dock)
        during.append(len(found))
        shown.append(deformed.visible)

    QTest.keyPress(person.canvas, Qt.Key.Key_Space)
    assert boundary.mode == "pan_zoom"
    assert not deformed.visible
    QTest.keyRelease(person.canvas, Qt.Key.Key_Space)
    assert boundary.mode == "paint", "moving the view ended painting"
    person.paint(*places, between=look)
    assert during[0] >= 1, "no result was solved during the stroke"
    assert during[-1] > during[0]
    assert not any(shown), "the moved image became visible during the stroke"
    assert MEANWHILE in dock.status
    assert drawn_node(viewer, boundary).opacity == boundary.opacity
    assert viewer.layers.selection.active is boundary, "the brush was deactivated"
    boundary.mode = "pan_zoom"
    settle(dock)
    assert deformed.visible, "the moved image is not shown after painting"
    assert (boundary.data == 1).sum() > 100
    assert_newest(dock)
    assert np.abs(dock.solution.displacement[24, 32]).max() < 1e-3
    # Live mode follows the undo of the labels layer.
    person.key(Qt.Key.Key_Z, CTRL)
    settle(dock)
    assert np.abs(dock.solution.displacement[24, 32]).max() > 0.5
    assert_newest(dock)


# Undo


def test_rows_added_for_painted_labels_are_no_undo_steps(live_dock, settle):
    widget, (_, tissue, _) = live_dock
    paint(tissue, [(8, 8)], 5)
    settle(widget)
    widget._form.tissue.table.refresh()
    assert 5 in [row.label for row in widget.materials]
    assert not widget._form.footer.undo.enabled
    widget._form.tissue.table.add()
    assert "added label 6 to 'Tissue'" in widget._form.footer.undo.tooltip
    widget.undo()
    assert [row.label for row in widget.materials] == [0, 1, 5]


def test_undo_of_a_hidden_table_changes_the_metadata_of_its_layer(live_dock):
    widget, (_, tissue, _) = live_dock
    before = widget.materials
    Cell(widget._form.tissue.table, 1, 2).write("33")
    image, widget.image = widget.image, viewer_of(widget).add_image(np.ones((9, 9)))
    assert widget.tissue is None
    widget.undo()
    assert tissue.metadata[METADATA]["materials"][1]["stiffness"] == before[1].stiffness
    widget.image = image
    assert widget.materials == before


def test_deform_reports_its_result_while_a_tool_is_active(pulling_beside, settle, run):
    person, widget = pulling_beside
    person.drag((30, 30), (34, 32), (34, 34))
    settle(widget)
    assert widget.status == widget.invitation, "pulling replaced the hint of the tool"
    for _ in range(2):
        assert run(widget) is not None
        assert widget.active
        assert widget.status.startswith("Tissue moved up to")


def test_an_error_is_shown_only_until_it_is_corrected_while_a_tool_is_active(
    pulling_beside, settle
):
    _, widget = pulling_beside
    viewer = viewer_of(widget)
    how = widget.status
    widget.make_layers()
    widget.start()
    widget.tissue.scale = (2, 1)
    settle(widget)
    assert "'Tissue' is not on the grid" in widget.status
    widget.tissue.scale = (1, 1)
    settle(widget)
    assert widget.active
    assert widget.status == how
    assert viewer.layers.selection.active.name == "Motion"
