"""Simulated user of a window, for tests of the mouse and the keyboard."""

from qtpy.QtCore import QEvent, QPoint, QPointF, Qt
from qtpy.QtGui import QMouseEvent
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QApplication

from tests.support.timeouts import LONG_MS

LEFT, NO_BUTTON = Qt.MouseButton.LeftButton, Qt.MouseButton.NoButton
PLAIN, CTRL = Qt.KeyboardModifier.NoModifier, Qt.KeyboardModifier.ControlModifier
SHIFT = Qt.KeyboardModifier.ShiftModifier


class Person:
    """Simulated user: moves the mouse to pixels of the image and presses keys."""

    def __init__(self, viewer, qtbot):
        self.viewer = viewer
        self._qtbot = qtbot
        self._canvas = viewer.window._qt_viewer.canvas

    @property
    def canvas(self):
        """Native canvas on which the image is drawn."""
        return self._canvas.native

    def where(self, *at):
        """Return the point of the canvas at (row, col), or at (depth, row, col) in a 3-D view."""
        view = self._canvas.view
        x, y, _, w = (view.transform * view.scene.transform).map(at[::-1])
        return QPoint(round(x / w), round(y / w))

    def press(self, *at):
        QTest.mousePress(self._canvas.native, LEFT, PLAIN, self.where(*at))

    def move(self, *at, button=LEFT):
        place = QPointF(self.where(*at))
        native = self._canvas.native
        there = QPointF(native.mapToGlobal(place.toPoint()))
        event = QMouseEvent(QEvent.Type.MouseMove, place, there, NO_BUTTON, button, PLAIN)
        QApplication.sendEvent(native, event)

    def release(self, *at):
        QTest.mouseRelease(self._canvas.native, LEFT, PLAIN, self.where(*at))

    def pick(self, row, col):
        QTest.mouseClick(self._canvas.native, LEFT, SHIFT, self.where(row, col))

    def drag(self, *places):
        self.press(*places[0])
        for place in places[1:]:
            self.move(*place)
        self.release(*places[-1])

    def paint(self, *places, between=lambda: None):
        """Drag and wait for each move, because vispy and napari drop moves in quick succession."""
        self.press(*places[0])
        for place in places[1:]:
            self._canvas.native._last_time = 0.0
            self.move(*place)
            self._qtbot.waitUntil(lambda place=place: self._is_at(*place), timeout=LONG_MS)
            between()
        self.release(*places[-1])

    def _is_at(self, *place):
        """Return whether napari's cursor is at a place, to 2 pixels of the screen."""
        at = self.where(*self.viewer.cursor.position[-len(place) :]) - self.where(*place)
        return at.manhattanLength() <= 2

    def key(self, key, modifiers=PLAIN):
        self._canvas.native.setFocus()
        QTest.keyClick(self._canvas.native, key, modifiers)


def only(widget):
    (mark,) = widget.drawing.marks
    return mark


def by_name(viewer, name):
    return viewer.layers[name]
