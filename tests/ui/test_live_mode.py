"""Live mode: whatever is edited, the newest edit is what is seen in the end."""

import threading

import numpy as np
import pytest
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest

from napari_hmrf import Multigrid, solve
from napari_hmrf.layers.metadata import METADATA, metadata_of
from napari_hmrf.solver.backends.thread import compute_thread
from napari_hmrf.study.ground import build_problem
from napari_hmrf.tissue.boundary_rules import BoundaryRule, Material
from napari_hmrf.ui.messages import CHOOSE, STILL
from tests.support.docks import dock_in, forget_choice, quick, viewer_of
from tests.support.person import CTRL, Person
from tests.support.screen import Cell, Screen
from tests.support.timeouts import LONG, LONG_MS


def names(widget):
    return [layer.name for layer in viewer_of(widget).layers]


def by_name(widget, name):
    return viewer_of(widget).layers[name]


def cold(widget):
    """What a script finds for the same layers."""
    stated = build_problem(widget.study)
    near = Multigrid(1e-4) if isinstance(stated.optimizer, Multigrid) else stated.optimizer
    return solve(stated.problem, stated.prior, optimizer=near, backend="cpu")


def assert_newest(widget):
    """What is seen is what the layers say now."""
    found, expected = widget.solution, cold(widget)
    assert found.displacement == pytest.approx(expected.displacement, abs=0.02)
    for layer in viewer_of(widget).layers:
        known = metadata_of(layer)
        here = known.get("slice") == widget.shown.grid.place.slice_name
        if known.get("kind") == "arrows" and here:
            assert known["solution"].displacement is found.displacement
            assert not known["inputs_changed"]


@pytest.fixture
def living(widget, small_sample, run):
    """The dock with a result that follows, and the layers it follows."""
    layers = small_sample(viewer_of(widget))
    widget.model = "elastic"
    forget_choice(widget)
    run(widget)
    widget.live = True
    return widget, layers


def paint(layer, places, label):
    layer.data_setitem(tuple(np.array(places).T), label)


def test_paint_tables_and_model_are_followed_without_a_button(living, settle):
    widget, (_, tissue, boundary) = living
    before = widget.solution
    layers = [id(layer) for layer in viewer_of(widget).layers]
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    settle(widget)
    assert widget.solution is not before
    assert np.abs(widget.solution.displacement[10, 12]).max() < 1e-3, "it is held there now"
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
    assert [id(layer) for layer in viewer_of(widget).layers] == layers, "in place"
    assert widget.status.startswith("Tissue moved up to")


@pytest.mark.parametrize("model", ["paper", "paper, converged"])
def test_the_papers_energy_is_followed_too(widget, small_sample, run, settle, model):
    _, _, boundary = small_sample(viewer_of(widget))
    widget.model = model
    run(widget)
    widget.live = True
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    settle(widget)
    assert widget.solution.displacement[10, 12] == pytest.approx((0, 0), abs=0.01)
    assert_newest(widget)


def test_a_stiffness_image_that_is_replaced_is_followed(living, settle):
    widget, (_, tissue, _) = living
    stiff = np.where(tissue.data > 0, 5.0, 0.0).astype(np.float32)
    widget.tissue = viewer_of(widget).add_image(stiff, name="E")
    settle(widget)
    before = widget.solution
    changed = stiff.copy()
    changed[5:15, 4:10] *= 50
    widget.tissue.data = changed
    settle(widget)
    assert widget.solution is not before
    assert_newest(widget)
    widget.tissue.data[5:15, 12:16] *= 20  # in place, as a script may
    widget.tissue.refresh()
    settle(widget)
    assert_newest(widget)


def test_of_many_edits_the_newest_is_shown_in_the_end(living, settle, at_rest):
    widget, (_, _, boundary) = living
    seen = []
    widget.result_drawn.connect(seen.append)
    for col in range(5, 20):
        boundary.data[...] = np.where(boundary.data == 3, 0, boundary.data)
        paint(boundary, [(row, col) for row in range(8, 12)], 3)
        widget.rules = (*widget.rules[:2], BoundaryRule(3, "move", vector=(1.0, col / 10)))
        if col % 3 == 0:
            at_rest()
    settle(widget)
    assert 1 <= len(seen) < 15
    assert_newest(widget)


def test_an_error_leaves_the_last_result_and_is_said_once(living, settle, monkeypatch):
    widget, _ = living
    popups = []
    for kind in ("show_error", "show_warning"):
        monkeypatch.setattr(f"napari_hmrf.ui.controller.{kind}", popups.append)
    before, picture = widget.solution, by_name(widget, "MR deformed, elastic").data.copy()
    rules, why = widget.rules, "The tissue was not updated. 'Boundary' lets label 2 expand, but"
    for amount in (1.0, 2.0, 3.0):
        widget.rules = (rules[0], BoundaryRule(2, "expand", amount=amount))
        settle(widget)
        assert (widget.status == "Heard.") == (amount > 1), "once is enough"
        if amount == 1:
            assert widget.status.startswith(why)
            assert widget.status.endswith("The last result is still shown.")
        widget.show_message("Heard.")
    assert widget.solution is before
    assert np.array_equal(by_name(widget, "MR deformed, elastic").data, picture)
    assert not popups, "nobody asked for anything"
    widget.rules = rules
    settle(widget)
    assert widget.status.startswith("Tissue moved up to")
    assert_newest(widget)


def test_where_nothing_is_painted_any_more_tissue_is_where_it_was(living, settle):
    widget, (image, _, boundary) = living
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


def test_what_the_solver_refuses_names_the_layer(living, settle):
    widget, (_, _, boundary) = living
    before = widget.solution
    data = np.zeros_like(boundary.data)
    data[10, 10] = 2
    boundary.data = data
    settle(widget)
    assert widget.solution is before
    assert "'Boundary'" in widget.status
    assert "could still move" in widget.status


def test_cancel_gives_an_edit_up_and_the_next_one_is_followed(living, settle, busy_thread, qtbot):
    widget, (_, _, boundary) = living
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


def test_an_undo_that_is_cancelled_stays_and_all_say_so_until_deform(pulling_beside, settle, qtbot):
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
    assert "warnings do not include the last edits" in widget.status
    assert "nothing was changed" not in widget.status
    Screen(widget).press("Deform")
    settle(widget)
    assert not widget.solution.displacement.any()
    assert widget.status == STILL


def test_nothing_is_followed_while_it_is_off_and_all_is_once_it_is_on(living, settle):
    widget, (_, _, boundary) = living
    widget.live = False
    before = widget.solution
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    settle(widget)
    assert widget.solution is before
    widget.live = True
    settle(widget)
    assert_newest(widget)


def test_what_comes_painted_is_followed_at_once(widget, small_sample, settle):
    widget.live = True
    small_sample(viewer_of(widget))
    settle(widget)
    assert_newest(widget)
    assert "MR deformed, paper" in names(widget)
    assert widget.status.startswith("Tissue moved up to")


def test_that_the_image_is_gone_is_said(living, settle, at_rest):
    widget, (image, *_) = living
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
    viewer.add_image(image.data, name="T2")
    viewer.layers.remove("T1")
    assert widget.image is viewer.layers["T2"]
    viewer.layers.clear()
    at_rest()
    assert widget.status.startswith("Open an image first")


def test_another_image_is_followed_as_soon_as_it_is_chosen(living, small_sample, settle):
    widget, (first, *_) = living
    viewer = viewer_of(widget)
    image, other, boundary = small_sample(viewer)
    assert widget.image is first, "work has begun on it"
    widget.image = image
    assert (widget.image, widget.tissue) == (image, other)
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    settle(widget)
    assert widget.solution.displacement == pytest.approx(cold(widget).displacement, abs=0.02)
    there = widget.solution
    widget.image = first
    settle(widget)
    expected = cold(widget).displacement
    assert widget.solution.displacement == pytest.approx(expected, abs=0.02)
    assert np.abs(expected - there.displacement).max() > 0.5, "it has a boundary of its own"


def test_for_a_large_image_it_is_off_unless_somebody_wants_it(
    widget, small_sample, monkeypatch, at_rest
):
    monkeypatch.setattr("napari_hmrf.ui.footer.LARGEST", 300)
    widget._form.footer.live._decided = False
    small_sample(viewer_of(widget))
    at_rest()
    check = widget._form.footer.live
    assert not widget.live
    check.native.click()
    at_rest()
    assert widget.live, "who wants it may have it"


@pytest.mark.parametrize(("size", "followed"), [((1200, 1200), True), ((1200, 1201), False)])
def test_up_to_twelve_hundred_pixels_along_each_side_it_is_on(widget, at_rest, size, followed):
    widget._form.footer.live._decided = False
    widget.image = viewer_of(widget).add_image(np.zeros(size, np.uint8))
    at_rest()
    assert widget.live is followed


def test_layers_may_be_renamed_removed_and_replaced_in_mid_edit(
    living, settle, busy_thread, at_rest
):
    widget, (image, tissue, boundary) = living
    viewer = viewer_of(widget)
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    at_rest(thread=False)
    boundary.name, image.name = "Walls", "T1"
    viewer.layers.remove("MR arrows, elastic")
    busy_thread.set()
    settle(widget)
    assert_newest(widget)
    assert "MR arrows, elastic" in names(widget), "it is made again"
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


def test_the_image_removed_in_mid_edit_is_not_shown_any_more(living, settle, busy_thread, at_rest):
    widget, (image, _, boundary) = living
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    at_rest(thread=False)
    viewer_of(widget).layers.remove(image)
    busy_thread.set()
    settle(widget)
    assert not [name for name in names(widget) if name.startswith("MR")], "nor what it was"


def test_each_slice_of_a_stack_is_followed_where_it_is_painted(
    widget, small_sample, run, settle, qtbot
):
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
    boundary.data_setitem((np.full(8, 1), np.arange(6, 14), np.full(8, 12)), 1)
    settle(widget)
    assert_newest(widget)
    assert sum("deformed" in name for name in names(widget)) == 2


def test_a_press_of_the_button_in_mid_edit_does_not_bring_an_older_result_back(
    living, settle, busy_thread, qtbot, at_rest
):
    widget, (_, _, boundary) = living
    widget.deform()
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    at_rest(thread=False)
    busy_thread.set()
    qtbot.waitUntil(lambda: widget.idle, timeout=LONG_MS)
    settle(widget)
    assert_newest(widget)


def test_two_viewers_follow_their_own(
    unstyled, without_controls, make_napari_viewer, small_sample, settle, run
):
    docks = []
    for _ in range(2):
        viewer = make_napari_viewer()
        small_sample(viewer)
        dock = dock_in(viewer)
        quick(dock).model = "elastic"
        run(dock)
        dock.live = True
        docks.append(dock)
    one, other = docks
    untouched = other.solution
    paint(by_name(one, "Boundary"), [(row, 12) for row in range(6, 14)], 1)
    settle(one)
    settle(other)
    assert_newest(one)
    assert other.solution is untouched


def test_a_closed_dock_follows_nothing(frame, small_sample, run, settle, at_rest):
    _, _, boundary = small_sample(frame.viewer)
    dock = quick(frame.open())
    run(dock)
    dock.live = True
    settle(dock)
    seen = []
    dock.deformation_changed.connect(seen.append)
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    frame.close(dock)
    paint(boundary, [(row, 15) for row in range(6, 14)], 1)
    at_rest()
    assert not seen


# With a real mouse


@pytest.fixture
def at_work(unstyled, without_controls, make_napari_viewer, small_sample, run, qtbot, at_rest):
    """A person with a brush before a real window, and a result that follows."""
    viewer = make_napari_viewer(show=True)
    small_sample(viewer, (48, 64))
    dock = dock_in(viewer)
    quick(dock).model = "elastic"
    run(dock)
    dock.live = True
    at_rest()
    return Person(viewer, qtbot), dock


def test_tissue_follows_while_the_brush_is_down(at_work, settle):
    person, dock = at_work
    viewer = person.viewer
    boundary = viewer.layers["Boundary"]
    Cell(dock._form.motion.boundary.table, 0).click()
    assert viewer.layers.selection.active is boundary
    assert (boundary.mode, boundary.selected_label) == ("paint", 1)
    boundary.brush_size = 5
    deformed = viewer.layers["MR deformed, elastic"]
    assert not deformed.visible, "paint lies where tissue was before it moved"
    found = []
    dock.deformation_changed.connect(found.append)
    places = [(row, 32) for row in range(14, 34, 2)]
    during, shown = [], []

    def look():
        settle(dock)
        during.append(len(found))
        shown.append(deformed.visible)

    person.paint(*places, between=look)
    assert during[0] >= 1, "while the button is down"
    assert during[-1] > during[0]
    assert not any(shown), "and the image is seen as it was"
    settle(dock)
    assert deformed.visible, "it is watched between two strokes"
    assert (boundary.data == 1).sum() > 100
    assert_newest(dock)
    assert np.abs(dock.solution.displacement[24, 32]).max() < 1e-3
    assert viewer.layers.selection.active is boundary, "the brush stays in the hand"
    # Labels' own undo is followed as well.
    person.key(Qt.Key.Key_Z, CTRL)
    settle(dock)
    assert np.abs(dock.solution.displacement[24, 32]).max() > 0.5
    assert_newest(dock)


# Undo


def test_tables_are_undone_and_followed(living, settle):
    widget, (_, _, boundary) = living
    footer = widget._form.footer
    assert not footer.undo.enabled
    rules, materials = widget.rules, widget.materials
    Cell(widget._form.motion.boundary.table, 1, 4).write("5")
    assert footer.undo.tooltip == ("Undo: changed label 2 of 'Boundary' (Ctrl+Z)")
    Cell(widget._form.tissue.table, 1, 2).write("33")
    settle(widget)
    assert widget.solution.displacement[10, -3, 1] == pytest.approx(5, abs=0.02)
    footer.undo.native.click()
    assert widget.materials == materials
    assert widget.status == "Undid: changed label 1 of 'Tissue'."
    footer.undo.native.click()
    settle(widget)
    assert widget.rules == rules
    assert boundary.metadata[METADATA]["rules"][1]["vector"] == (0.0, 3.0)
    assert_newest(widget)
    assert not footer.undo.enabled
    footer.redo.native.click()
    settle(widget)
    assert_newest(widget)
    assert widget.rules != rules


def test_rows_that_come_with_the_paint_are_no_steps(living, settle):
    widget, (_, tissue, _) = living
    paint(tissue, [(8, 8)], 5)
    settle(widget)
    widget._form.tissue.table.refresh()
    assert 5 in [row.label for row in widget.materials]
    assert not widget._form.footer.undo.enabled
    widget._form.tissue.table.add()
    assert "added label 6 to 'Tissue'" in widget._form.footer.undo.tooltip
    widget.undo()
    assert [row.label for row in widget.materials] == [0, 1, 5]


def test_keys_take_back_from_within_the_dock_and_a_layer_takes_its_steps_along(
    docked, small_sample
):
    widget, (_, _, boundary) = docked, small_sample(viewer_of(docked))
    table = widget._form.motion.boundary.table
    before = widget.rules
    Cell(table, 1, 4).write("5")
    QTest.keyClick(table, Qt.Key.Key_Z, CTRL)
    assert widget.rules == before
    QTest.keyClick(table, Qt.Key.Key_Y, CTRL)
    assert widget.rules != before
    viewer_of(widget).layers.remove(boundary)
    assert not widget._form.footer.undo.enabled


def test_a_layer_that_is_tissue_and_boundary_is_undone_in_the_table_that_was_edited(living):
    widget, (_, tissue, _) = living
    widget.boundary = tissue
    before = widget.materials, widget.rules
    Cell(widget._form.tissue.table, 1, 2).write("33")
    widget.undo()
    assert (widget.materials, widget.rules) == before


def test_a_table_that_is_not_shown_is_undone_in_its_layer(living):
    widget, (_, tissue, _) = living
    before = widget.materials
    Cell(widget._form.tissue.table, 1, 2).write("33")
    image, widget.image = widget.image, viewer_of(widget).add_image(np.ones((9, 9)))
    assert widget.tissue is None
    widget.undo()
    assert tissue.metadata[METADATA]["materials"][1]["stiffness"] == before[1].stiffness
    widget.image = image
    assert widget.materials == before


def test_a_curve_is_undone_with_what_it_shows(widget, small_sample, wait_for):
    viewer = viewer_of(widget)
    small_sample(viewer)
    tissue = widget.tissue
    before = widget.tissue_from_intensity()
    shown = next(layer for layer in viewer.layers if "stiffness" in layer.name)
    stiff = shown.data.copy()
    editor = widget._form.tissue.editor
    editor.points.native.setText("0: 1; 100: 3; 255: 1000")
    editor.points.native.editingFinished.emit()
    assert widget.curve != before
    assert "changed the curve" in widget._form.footer.undo.tooltip
    wait_for(lambda: not np.array_equal(shown.data, stiff))
    widget.undo()
    assert widget.curve == before
    wait_for(lambda: np.array_equal(shown.data, stiff))
    widget.redo()
    assert widget.curve not in (before, None)
    widget.tissue = tissue
    widget.undo()
    assert widget.curve not in (before, None), "what is taken back is seen"


def test_what_is_looked_at_is_the_result_that_has_followed(living, settle):
    widget, (_, _, boundary) = living
    paint(boundary, [(row, 12) for row in range(6, 14)], 1)
    settle(widget)
    assert widget.result is by_name(widget, "MR arrows, elastic")
    assert widget._view.shown.answer.solution.displacement is widget.solution.displacement
    assert_newest(widget)


def test_what_came_of_deform_is_said_though_a_tool_is_in_the_hand(pulling_beside, settle, run):
    person, widget = pulling_beside
    person.drag((30, 30), (34, 32), (34, 34))
    settle(widget)
    assert widget.status == widget.invitation, "while the mouse pulls, how it does is said"
    for _ in range(2):
        assert run(widget) is not None
        assert widget.active
        assert widget.status.startswith("Tissue moved up to")


def test_with_a_tool_in_the_hand_what_was_wrong_is_said_as_long_as_it_is(pulling_beside, settle):
    _, widget = pulling_beside
    viewer = viewer_of(widget)
    how = widget.status
    widget.make_layers()
    widget.start()
    widget.tissue.scale = (2, 1)
    settle(widget)
    assert "'Tissue' lies elsewhere" in widget.status
    widget.tissue.scale = (1, 1)
    settle(widget)
    assert widget.active
    assert widget.status == how
    assert viewer.layers.selection.active.name == "Motion"
