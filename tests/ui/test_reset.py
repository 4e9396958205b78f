"""Tests of the entry that removes the drawing and the settings of a study."""

import pytest
from qtpy.QtWidgets import QMessageBox

from napari_hmrf.tissue.drawing import Drawing
from tests.support.screen import Screen

BUTTON = QMessageBox.StandardButton


@pytest.fixture
def reset(monkeypatch):
    """Return a function that chooses the entry, answers its question, and returns the question."""

    def press(dock, answer):
        asked = []

        def question(parent, title, text, *buttons):
            asked.append(text)
            return answer

        monkeypatch.setattr(QMessageBox, "question", question)
        Screen(dock).entry("Clear", "Reset the study").trigger()
        return asked

    return press


@pytest.fixture
def pulled(pulling_beside, settle):
    """Return a dock with a pull, a model and an edge that are not the defaults."""
    touch, dock = pulling_beside
    touch.drag((20, 20), (24, 26))
    dock.model = "elastic"
    dock.plane, dock.hold_edge = "strain", False
    settle(dock)
    return dock


def chosen(dock):
    return dock.drawing, dock.plane, dock.hold_edge


def test_a_reset_after_a_question_is_undone_in_one_step(pulled, reset, settle):
    before = chosen(pulled)
    (question,) = reset(pulled, BUTTON.Reset)
    assert question.startswith("Remove all marks of 'MR' and restore the default settings?")
    settle(pulled)
    assert chosen(pulled) == (Drawing(), "stress", True)
    assert pulled.solution is None
    assert pulled.status.startswith("Removed all marks and restored the default settings.")
    Screen(pulled).press("Undo")
    settle(pulled)
    assert chosen(pulled) == before
    assert pulled.solution is not None


def test_a_reset_that_is_cancelled_changes_nothing(pulled, reset):
    before = chosen(pulled)
    reset(pulled, BUTTON.Cancel)
    assert chosen(pulled) == before


def test_a_reset_needs_an_image(widget):
    assert not Screen(widget).entry("Clear", "Reset the study").isEnabled()
