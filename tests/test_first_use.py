"""What somebody does who sees the dock for the first time, by the mouse, is what they meant."""

import pytest
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest
from screen import Screen

LEFT = Qt.MouseButton.LeftButton


@pytest.fixture
def click(at_rest):
    """Click a button of a dock, in its middle."""

    def clicked(widget, words):
        QTest.mouseClick(Screen(widget).button(words), LEFT)
        at_rest.pass_through()

    return clicked


def test_pull_stays_in_the_hand_of_who_presses_it_after_it_was_taken_up_by_itself(
    open_window, settle, click
):
    widget = open_window()[1]
    settle(widget)
    assert widget.active
    click(widget, "Pull")
    assert widget.active, "the message said to press it"
    click(widget, "Pull")
    assert not widget.active, "and once more puts it down"


def test_pull_that_was_used_is_put_down_by_the_first_press(open_window, settle, click):
    person, widget = open_window()
    settle(widget)
    person.drag((30, 30), (30, 36))
    click(widget, "Pull")
    assert not widget.active
