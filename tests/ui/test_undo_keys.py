"""Tests of the undo keys, which undo the last edit: painted, drawn or typed."""

import pytest
from napari.components import ViewerModel
from napari.layers import Vectors
from qtpy.QtCore import Qt

from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.tissue.drawing import Arrow
from tests.support.docks import dock_in, quick
from tests.support.person import CTRL, SHIFT, Person
from tests.support.screen import Screen
from tests.support.windowless import Touch

Z = Qt.Key.Key_Z


@pytest.fixture
def pointer_and_dock(frame, small_sample, at_rest):
    """Return a simulated pointer at a small sample without a window, and the dock."""
    small_sample(frame.viewer)
    dock = quick(frame.open())
    at_rest()
    return Touch(frame.viewer), dock


@pytest.fixture
def user_in_window(unstyled, without_controls, make_napari_viewer, small_sample, qtbot, at_rest):
    """Return a simulated user before a window with a small sample, and the dock."""
    viewer = make_napari_viewer(show=True)
    small_sample(viewer)
    dock = quick(dock_in(viewer))
    at_rest()
    return Person(viewer, qtbot), dock


def test_a_typed_number_is_undone_by_the_key_on_the_canvas(user_in_window):
    person, dock = user_in_window
    tissue, materials = dock.tissue, dock.materials
    screen = Screen(dock)
    screen.click_row("gel")
    assert person.viewer.layers.selection.active is tissue
    screen.cell("gel", "Stiffness").write("33")
    person.key(Z, CTRL)
    assert dock.materials == materials
    assert dock.status == "Undid: changed label 1 of 'Tissue'."
    person.key(Z, CTRL | SHIFT)
    assert dock.materials[1].stiffness == 33
    person.key(Z, CTRL)
    person.key(Z, CTRL)
    assert dock.status == "There is nothing to undo."


def test_paint_and_typed_numbers_are_undone_in_reverse_order(user_in_window):
    person, dock = user_in_window
    tissue, materials = dock.tissue, dock.materials
    screen = Screen(dock)
    clean = tissue.data.copy()
    screen.click_row("gel")
    person.paint((1, 1), (1, 4), (1, 8))
    painted = tissue.data.copy()
    assert (painted != clean).any()
    screen.cell("gel", "Stiffness").write("33")
    person.key(Z, CTRL)
    assert dock.materials == materials
    assert (tissue.data == painted).all(), "the earlier paint was undone instead of the number"
    screen.cell("gel", "Stiffness").write("44")
    person.paint((18, 1), (18, 4), (18, 8))
    person.key(Z, CTRL)
    assert (tissue.data == painted).all()
    assert dock.materials[1].stiffness == 44, "the earlier number was undone instead of the paint"
    person.key(Z, CTRL | SHIFT)
    assert (tissue.data != painted).any()


def test_the_undo_button_undoes_paint_in_order_and_reports_it(pointer_and_dock):
    person, dock = pointer_and_dock
    tissue, screen = dock.tissue, Screen(dock)
    clean = tissue.data.copy()
    screen.click_row("gel")
    person.paint((1, 1), (1, 4), (1, 8))
    painted = tissue.data.copy()
    screen.cell("gel", "Stiffness").write("33")
    person.paint((18, 1), (18, 4), (18, 8))
    assert screen.button("Undo").toolTip() == "Undo: painted in 'Tissue' (Ctrl+Z)"
    assert not screen.button("Redo").isEnabled()
    screen.press("Undo")
    assert (tissue.data == painted).all()
    assert dock.status == "Undid: painted in 'Tissue'."
    screen.press("Undo")
    assert dock.materials[1].stiffness != 33
    screen.press("Undo")
    assert (tissue.data == clean).all()
    for _ in range(2):
        screen.press("Redo")
    assert dock.materials[1].stiffness == 33
    person.paint((10, 1), (10, 4), (10, 8))
    assert not screen.button("Redo").isEnabled(), "redo is possible after a new edit"


def test_paint_from_before_the_dock_is_undone_after_later_edits(frame, small_sample, at_rest):
    viewer = frame.viewer
    _, tissue, _ = small_sample(viewer)
    clean = tissue.data.copy()
    tissue.paint((5, 5), 3)
    dock = quick(frame.open())
    at_rest()
    viewer.layers.selection.active = tissue
    tissue.paint((12, 12), 3)
    dock.undo()
    assert (tissue.data != clean).any()
    dock.undo()
    assert (tissue.data == clean).all()


def test_a_closed_dock_releases_the_undo_keys(pointer_and_dock, frame):
    _, dock = pointer_and_dock
    viewer = frame.viewer
    tissue = dock.tissue
    Screen(dock).click_row("gel")
    assert tissue.keymap
    viewer.layers.selection.active = dock.boundary
    assert not tissue.keymap
    assert dock.boundary.keymap
    boundary = dock.boundary
    frame.close(dock)
    assert not boundary.keymap
    assert not viewer.keymap


def test_undo_keys_of_a_deleted_owner_are_released():
    class Owner:
        def interrupt(self):
            return False

    viewer, owner = ViewerModel(), Owner()
    steps = undo_of(viewer)
    steps.bind_keys(Owner())
    steps.bind_keys(owner)
    assert viewer.keymap
    steps.unbind_keys(owner)
    assert not viewer.keymap


def test_undo_keys_remain_bound_while_one_of_two_docks_is_open(pointer_and_dock, frame):
    _, first = pointer_and_dock
    keys = {each for each in frame.viewer.keymap if str(each) in ("Ctrl+Z", "Ctrl+Shift+Z")}
    assert len(keys) == 2
    second = quick(frame.open())
    frame.close(second)
    assert keys <= frame.viewer.keymap.keys(), "the keys of the open dock were released"
    frame.close(first)
    assert not keys & frame.viewer.keymap.keys()


def test_keys_of_napari_keep_their_action_while_a_tool_is_active(pulling_beside):
    person, _ = pulling_beside
    viewer = person.viewer
    motion = viewer.layers["Motion"]
    own = {str(key) for each in (viewer, motion) for key in each.keymap}
    napari = {str(key) for each in (ViewerModel, Vectors) for key in each.class_keymap}
    assert "Ctrl+Y" in napari
    assert own & napari == {"Space"}, "a key of napari has another action"
    person.key(Qt.Key.Key_Y, CTRL)
    assert viewer.dims.ndisplay == 3


def test_arrows_and_typed_numbers_are_undone_in_reverse_order(pointer_and_dock, at_rest):
    person, dock = pointer_and_dock
    materials = dock.materials
    dock.start()
    at_rest.until(lambda: not dock.busy)
    dock.drawing = dock.drawing.with_mark(Arrow((8, 8), (10, 10), 2.0))
    Screen(dock).cell("gel", "Stiffness").write("33")
    person.key(Z, CTRL)
    assert dock.materials == materials
    assert dock.drawing.marks, "the earlier arrow was undone instead of the number"
    person.key(Z, CTRL)
    assert not dock.drawing.marks
    assert dock.status == "Undid: replaced the drawing."


def test_the_key_of_napari_for_the_3d_view_is_not_taken(user_in_window):
    person, dock = user_in_window
    before = dock.materials
    Screen(dock).click_row("gel")
    Screen(dock).cell("gel", "Stiffness").write("33")
    person.key(Z, CTRL)
    person.key(Qt.Key.Key_Y, CTRL)
    assert dock.materials == before
    assert person.viewer.dims.ndisplay == 3


def test_undo_of_paint_keeps_the_brush(pointer_and_dock):
    person, dock = pointer_and_dock
    screen = Screen(dock)
    screen.click_row("gel")
    person.paint((1, 1), (1, 4))
    screen.press("Undo")
    assert dock.tissue.mode == "paint"
