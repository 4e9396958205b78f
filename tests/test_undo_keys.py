"""One key takes back what was done last, whether it was painted or typed, here or elsewhere."""

import pytest
from person import CTRL, SHIFT, Person
from qtpy.QtCore import Qt
from screen import Cell

from napari_hmrf.tissue.drawing import Arrow

Z, Y = Qt.Key.Key_Z, Qt.Key.Key_Y


@pytest.fixture
def seated(make_napari_viewer, small_sample, qtbot, at_rest):
    """Somebody before a window with *Deform tissue* and a small sample, and its dock."""
    viewer = make_napari_viewer(show=True)
    small_sample(viewer)
    _, dock = viewer.window.add_plugin_dock_widget("napari-hmrf", "Deform tissue")
    dock.live = False
    at_rest()
    return Person(viewer, qtbot), dock


def test_a_number_that_was_typed_is_taken_back_by_the_key_over_the_image(seated):
    person, dock = seated
    tissue, materials = dock.tissue, dock.materials
    table = dock._face.tissue.seen
    Cell(table, 1).click()
    assert person.viewer.layers.selection.active is tissue
    Cell(table, 1, 2).write("33")
    person.key(Z, CTRL)
    assert dock.materials == materials
    assert dock.status == "Took back: changed the stiffness of label 1 in 'Tissue'."
    person.key(Y, CTRL)
    assert dock.materials[1].stiffness == 33
    person.key(Z, CTRL)
    person.key(Z, CTRL)
    assert dock.status == "There is nothing to take back."


def test_paint_and_numbers_are_taken_back_from_the_last_to_the_first(seated):
    person, dock = seated
    tissue, materials = dock.tissue, dock.materials
    table = dock._face.tissue.seen
    clean = tissue.data.copy()
    Cell(table, 1).click()
    person.paint((1, 1), (1, 4), (1, 8))
    painted = tissue.data.copy()
    assert (painted != clean).any()
    Cell(table, 1, 2).write("33")
    person.key(Z, CTRL)
    assert dock.materials == materials
    assert (tissue.data == painted).all(), "the number came later"
    Cell(table, 1, 2).write("44")
    person.paint((18, 1), (18, 4), (18, 8))
    person.key(Z, CTRL)
    assert (tissue.data == painted).all()
    assert dock.materials[1].stiffness == 44, "the stroke came later"
    person.key(Z, CTRL | SHIFT)
    assert (tissue.data != painted).any()


def test_a_closed_dock_leaves_the_keys_to_napari(seated):
    person, dock = seated
    tissue = dock.tissue
    Cell(dock._face.tissue.seen, 1).click()
    assert tissue.keymap
    person.viewer.layers.selection.active = dock.boundary
    assert not tissue.keymap
    assert dock.boundary.keymap
    boundary = dock.boundary
    person.viewer.window.remove_dock_widget(dock.native)
    assert not boundary.keymap
    assert not person.viewer.keymap


def test_the_dock_in_front_says_what_was_taken_back_of_one_behind(seated, qtbot, at_rest):
    person, dock = seated
    _, puller = person.viewer.window.add_plugin_dock_widget("napari-hmrf", "Grab and pull")
    at_rest()
    puller.form.grab.native.click()
    puller.drawing = puller.drawing.with_mark(Arrow((8, 8), (10, 10), 2.0))
    dock.native.parent().raise_()
    qtbot.waitUntil(lambda: not dock.native.visibleRegion().isEmpty())
    assert puller.native.visibleRegion().isEmpty(), "it is behind"
    person.key(Z, CTRL)
    assert not puller.drawing.marks
    assert dock.status == "Took back: took over a drawing, in 'Grab and pull'."
