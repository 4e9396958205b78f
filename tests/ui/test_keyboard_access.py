"""Tests of the access by keyboard and screen reader: Tab key, visible focus, accessible names."""

from itertools import pairwise

import numpy as np
import pytest
from qtpy.QtCore import QPoint, QRect, Qt
from qtpy.QtGui import QImage
from qtpy.QtTest import QTest
from qtpy.QtWidgets import (
    QAbstractButton,
    QAbstractSlider,
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QLineEdit,
    QRadioButton,
    QScrollBar,
    QTableView,
    QWidget,
)

from napari_hmrf.field.directions import Directions
from tests.support.docks import dock_in, quick
from tests.support.screen import Screen

_CONTROLS = (
    QAbstractButton,
    QAbstractSlider,
    QAbstractSpinBox,
    QComboBox,
    QLineEdit,
    QTableView,
)
#: Keys that press a button.
KEYS = Qt.Key.Key_Space, Qt.Key.Key_Return, Qt.Key.Key_Enter
#: Size of the frame, so that the dock does not scroll.
_SIZE = (400, 2000)
#: Clearly visible difference of two grey values, of 255.
_VISIBLE = 60


@pytest.fixture
def dock(frame, small_sample, at_rest):
    """Return a dock with all sections open, beside a volume and landmarks."""
    small_sample(frame.viewer, (4, 20, 24))
    frame.viewer.add_points(np.zeros((2, 3)), name="Marks")
    made = quick(frame.open())
    frame.show()
    open_sections(made)
    made.native.window().resize(*_SIZE)
    at_rest.until(lambda: not made.busy)
    return made


def open_sections(dock):
    for section in dock._form.sections.values():
        section.expand(animate=False)


def controls_of(dock):
    """Return the enabled, visible controls; the keys of a radio group reach its other buttons."""
    return [
        each
        for each in dock.native.findChildren(QWidget)
        if isinstance(each, _CONTROLS)
        and each.isVisible()
        and each.isEnabled()
        and each.focusProxy() is None
        and not isinstance(each, QScrollBar)
        and not (isinstance(each, QRadioButton) and not each.isChecked())
    ]


def walk(dock):
    """Press Tab until the focus has gone around the dock; return the controls that had it."""
    # The window may not get the keyboard of the screen, or lose it when the screen notices that a
    # window of an earlier test is closed. Until the walk ends, no event of the screen is processed.
    QApplication.setActiveWindow(dock.native.window())
    image = dock.native.findChild(QComboBox)
    image.setFocus(Qt.FocusReason.TabFocusReason)
    stops = []
    while (stop := QApplication.focusWidget()) not in stops:
        assert stop is not None, "nothing has the focus"
        stops.append(stop)
        QTest.keyClick(stop, Qt.Key.Key_Tab)
    assert stop is image, f"the Tab key does not leave {stop}"
    return stops


def place_of(control, dock):
    return QRect(control.mapTo(dock.native, QPoint(0, 0)), control.size())


def edge_of(control):
    """Return the grey values along the edge of a control in its window."""
    window = control.window()
    seen = window.grab(QRect(control.mapTo(window, QPoint(0, 0)), control.size()))
    picture = seen.toImage().convertToFormat(QImage.Format.Format_Grayscale8)
    right, bottom = picture.width() - 1, picture.height() - 1
    places = [(x, y) for x in range(right + 1) for y in (0, bottom)]
    places += [(x, y) for x in (0, right) for y in range(bottom + 1)]
    return np.array([picture.pixelColor(x, y).red() for x, y in places], int)


def test_the_tab_key_visits_every_control_in_reading_order(dock):
    stops = walk(dock)
    missed = [each.toolTip() for each in controls_of(dock) if each not in stops]
    assert not missed, "the Tab key does not reach these controls"
    for before, after in pairwise(stops):
        one, other = place_of(before, dock), place_of(after, dock)
        within = one.contains(other)  # a menu in a table
        beside = one.bottom() >= other.top() and one.left() < other.left()
        assert within or beside or other.top() >= one.top() + one.height() // 2, (
            before.toolTip(),
            after.toolTip(),
        )


def test_the_tab_key_skips_the_controls_of_closed_sections(dock):
    sections = dock._form.sections.values()
    for section in sections:
        section.collapse(animate=False)
    stops = walk(dock)
    headers = [section.toggleButton() for section in sections if section.isVisible()]
    assert [each for each in stops if each in headers] == headers
    unseen = [each.toolTip() for each in stops if each.visibleRegion().isEmpty()]
    assert not unseen, "the Tab key reaches these hidden controls"


def test_every_control_has_a_name_for_screen_readers(dock):
    nameless = [
        each.toolTip()
        for each in controls_of(dock)
        if not each.accessibleName()
        and not (isinstance(each, QAbstractButton) and any(map(str.isalpha, each.text())))
    ]
    assert not nameless
    radius = dock.fields.radius.native
    assert radius.accessibleName() == "radius (px)"
    dock.fields.show_place("mm", Directions())
    assert radius.accessibleName() == "radius (mm)"


def test_a_key_opens_and_closes_a_section(dock):
    header = Screen(dock).button("Advanced")
    for key in KEYS:
        for is_open in (False, True):
            QTest.keyClick(header, key)
            assert header.isChecked() == is_open, key


def test_a_key_presses_the_button_of_a_tool(dock):
    button = Screen(dock).button("Hold")
    for key in KEYS:
        dock.tool = "pull"
        assert not button.isChecked()
        QTest.keyClick(button, key)
        assert button.isChecked(), key
        assert dock.tool == "pin"


def test_the_keyboard_focus_is_visible_in_the_themes_of_napari(
    make_napari_viewer, without_controls, small_sample, at_rest, wait_for
):
    viewer = make_napari_viewer(show=True)
    small_sample(viewer)
    dock = quick(dock_in(viewer))
    open_sections(dock)
    at_rest.until(lambda: not dock.busy)
    window, header = dock.native.window(), Screen(dock).button("Advanced")
    window.resize(1000, _SIZE[1])
    window.activateWindow()
    wait_for(window.isActiveWindow)
    for theme in ("dark", "light"):
        viewer.theme = theme
        for control in controls_of(dock):
            control.setFocus(Qt.FocusReason.TabFocusReason)
            framed = edge_of(control)
            window.setFocus()
            is_changed = np.abs(framed - edge_of(control)) > _VISIBLE
            assert is_changed.mean() > 0.9, control.accessibleName() or control.text()
        before = edge_of(header)
        for _ in range(2):
            QTest.mouseClick(header, Qt.MouseButton.LeftButton)
        assert header.hasFocus()
        assert np.abs(edge_of(header) - before).max() < _VISIBLE, "the mouse needs no frame"
