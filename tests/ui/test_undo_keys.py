"""Tests of the undo keys, which undo the last edit: painted, drawn or typed."""

import numpy as np
import pytest
from napari.components import ViewerModel
from napari.layers import Vectors
from qtpy.QtCore import Qt

from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.tissue.drawing import Drawing, Landmark
from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.docks import quick
from tests.support.person import CTRL, SHIFT
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


def test_paint_and_typed_numbers_are_undone_in_reverse_order_and_reported(pointer_and_dock):
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
    assert dock.tissue.mode == "paint", "undo of paint put the brush away"
    assert dock.status == "Undid: painted in 'Tissue'."
    person.key(Z, CTRL)
    assert dock.materials[1].stiffness != 33
    assert (tissue.data == painted).all(), "the earlier paint was undone instead of the number"
    screen.press("Undo")
    assert (tissue.data == clean).all()
    assert not screen.button("Undo").isEnabled()
    person.key(Z, CTRL)
    assert dock.status == "There is nothing to undo."
    for _ in range(2):
        person.key(Z, CTRL | SHIFT)
    assert dock.materials[1].stiffness == 33
    person.paint((10, 1), (10, 4), (10, 8))
    assert not screen.button("Redo").isEnabled(), "redo is possible after a new edit"


def test_marks_on_tissue_without_an_image_are_undone(frame, at_rest):
    tissue = frame.viewer.add_labels(np.pad(np.ones((10, 10), int), 4))
    dock = quick(frame.open())
    dock.tissue = tissue
    dock.drawing = drawing = Drawing((Landmark((8.0, 8.0), (9.0, 9.0), 1.0),))
    dock.drawing = Drawing((*drawing.marks, Landmark((10.0, 8.0), (10.0, 9.0), 1.0)))
    dock.undo()
    assert dock.drawing == drawing
    assert dock.status == "Undid: replaced the drawing."
    at_rest()


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


def test_paint_from_before_the_dock_is_undone_after_later_edits(qtbot, small_sample, at_rest):
    viewer = ViewerModel()
    _, tissue, _ = small_sample(viewer)
    clean = tissue.data.copy()
    tissue.paint((5, 5), 3)
    dock = SoftTissue(viewer)
    qtbot.addWidget(dock.native)
    quick(dock)
    at_rest()
    viewer.layers.selection.active = tissue
    tissue.paint((12, 12), 3)
    dock.undo()
    assert (tissue.data != clean).any()
    dock.undo()
    assert (tissue.data == clean).all()


def test_undo_keys_remain_bound_while_one_of_two_docks_is_open(frame, small_sample):
    viewer = frame.viewer
    _, tissue, _ = small_sample(viewer)
    first, second = quick(frame.open()), quick(frame.open())
    keys = {each for each in viewer.keymap if str(each) in ("Ctrl+Z", "Ctrl+Shift+Z")}
    assert len(keys) == 2
    frame.close(second)
    assert keys <= viewer.keymap.keys(), "the keys of the open dock were released"
    boundary = first.boundary
    Screen(first).click_row("gel")
    assert tissue.keymap
    viewer.layers.selection.active = boundary
    assert not tissue.keymap
    assert boundary.keymap
    frame.close(first)
    assert not boundary.keymap
    assert not viewer.keymap


def test_keys_of_napari_keep_their_action_while_a_tool_is_active(pulling):
    person, _ = pulling  # napari binds its own keys when it opens a window
    viewer = person.viewer
    motion = viewer.layers["Motion"]
    own = {str(key) for each in (viewer, motion) for key in each.keymap}
    napari = {str(key) for each in (ViewerModel, Vectors) for key in each.class_keymap}
    assert "Ctrl+Y" in napari
    assert own & napari == {"Space"}, "a key of napari has another action"
    person.key(Qt.Key.Key_Y, CTRL)
    assert viewer.dims.ndisplay == 3
