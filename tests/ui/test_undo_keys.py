"""One key takes back what was done last, whether it was painted, drawn or typed."""

import pytest
from napari.components import ViewerModel
from qtpy.QtCore import Qt

from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.tissue.drawing import Arrow
from tests.support.docks import dock_in, quick
from tests.support.person import CTRL, SHIFT, Person
from tests.support.screen import Screen
from tests.support.windowless import Touch

Z, Y = Qt.Key.Key_Z, Qt.Key.Key_Y


@pytest.fixture
def at_hand(frame, small_sample, at_rest):
    """A hand at a small sample in a viewer without a canvas, and its dock."""
    small_sample(frame.viewer)
    dock = quick(frame.open())
    at_rest()
    return Touch(frame.viewer), dock


@pytest.fixture
def seated(unstyled, without_controls, make_napari_viewer, small_sample, qtbot, at_rest):
    """Somebody before a window with a small sample, and its dock."""
    viewer = make_napari_viewer(show=True)
    small_sample(viewer)
    dock = quick(dock_in(viewer))
    at_rest()
    return Person(viewer, qtbot), dock


def test_a_number_that_was_typed_is_taken_back_by_the_key_over_the_image(seated):
    person, dock = seated
    tissue, materials = dock.tissue, dock.materials
    screen = Screen(dock)
    screen.click_row("gel")
    assert person.viewer.layers.selection.active is tissue
    screen.cell("gel", "Stiffness").write("33")
    person.key(Z, CTRL)
    assert dock.materials == materials
    assert dock.status == "Undid: changed label 1 of 'Tissue'."
    person.key(Y, CTRL)
    assert dock.materials[1].stiffness == 33
    person.key(Z, CTRL)
    person.key(Z, CTRL)
    assert dock.status == "There is nothing to undo."


def test_paint_and_numbers_are_taken_back_from_the_last_to_the_first(seated):
    person, dock = seated
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
    assert (tissue.data == painted).all(), "the number came later"
    screen.cell("gel", "Stiffness").write("44")
    person.paint((18, 1), (18, 4), (18, 8))
    person.key(Z, CTRL)
    assert (tissue.data == painted).all()
    assert dock.materials[1].stiffness == 44, "the stroke came later"
    person.key(Z, CTRL | SHIFT)
    assert (tissue.data != painted).any()


def test_the_buttons_take_back_what_napari_painted_in_its_turn_and_say_so(at_hand):
    person, dock = at_hand
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
    assert not screen.button("Redo").isEnabled(), "something new was done"


def test_paint_that_was_there_before_the_dock_is_taken_back_after_all_else(
    frame, small_sample, at_rest
):
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


def test_a_closed_dock_leaves_the_keys_to_napari(at_hand, frame):
    _, dock = at_hand
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


def test_the_keys_of_who_is_gone_without_a_word_are_not_bound_twice():
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


def test_undo_keys_stay_while_one_of_two_docks_is_open(at_hand, frame):
    _, first = at_hand
    keys = {each for each in frame.viewer.keymap if str(each) in ("Ctrl+Z", "Ctrl+Y")}
    assert len(keys) == 2
    second = quick(frame.open())
    frame.close(second)
    assert keys <= frame.viewer.keymap.keys(), "the first dock uses them"
    frame.close(first)
    assert not keys & frame.viewer.keymap.keys()


def test_arrows_and_numbers_are_taken_back_from_the_last_to_the_first(at_hand, at_rest):
    person, dock = at_hand
    materials = dock.materials
    dock.start()
    at_rest.until(lambda: not dock.busy)
    dock.drawing = dock.drawing.with_mark(Arrow((8, 8), (10, 10), 2.0))
    Screen(dock).cell("gel", "Stiffness").write("33")
    person.key(Z, CTRL)
    assert dock.materials == materials
    assert dock.drawing.marks, "the number came later"
    person.key(Z, CTRL)
    assert not dock.drawing.marks
    assert dock.status == "Undid: replaced the drawing."
