"""Somebody before a window or beside a viewer, for tests of what the mouse and the keys do."""

from types import SimpleNamespace

from napari.utils._proxies import ReadOnlyWrapper
from napari.utils.interactions import (
    mouse_move_callbacks,
    mouse_press_callbacks,
    mouse_release_callbacks,
)
from napari.utils.key_bindings import KeymapHandler
from patience import LONG_MS
from qtpy.QtCore import QEvent, QPoint, QPointF, Qt
from qtpy.QtGui import QMouseEvent
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QApplication

LEFT, NO_BUTTON = Qt.MouseButton.LeftButton, Qt.MouseButton.NoButton
PLAIN, CTRL = Qt.KeyboardModifier.NoModifier, Qt.KeyboardModifier.ControlModifier
SHIFT = Qt.KeyboardModifier.ShiftModifier
#: Pixels of the screen for one of the image, as in a window of the usual size.
_ZOOM = 8.0
#: How napari calls keys that write no letter.
_KEYS = {
    Qt.Key.Key_Delete: "Delete",
    Qt.Key.Key_Backspace: "Backspace",
    Qt.Key.Key_Escape: "Escape",
    Qt.Key.Key_Space: "Space",
}


class Person:
    """Somebody before a window: moves the mouse to pixels of the image, and presses keys."""

    def __init__(self, viewer, qtbot):
        self.viewer = viewer
        self._qtbot = qtbot
        self._canvas = viewer.window._qt_viewer.canvas

    @property
    def canvas(self):
        """What the image is drawn on."""
        return self._canvas.native

    def where(self, row, col):
        view = self._canvas.view
        x, y = (view.transform * view.scene.transform).map([col, row])[:2]
        return QPoint(round(x), round(y))

    def press(self, row, col):
        QTest.mousePress(self._canvas.native, LEFT, PLAIN, self.where(row, col))

    def move(self, row, col, button=LEFT):
        place = QPointF(self.where(row, col))
        native = self._canvas.native
        there = QPointF(native.mapToGlobal(place.toPoint()))
        event = QMouseEvent(QEvent.Type.MouseMove, place, there, NO_BUTTON, button, PLAIN)
        QApplication.sendEvent(native, event)

    def release(self, row, col):
        QTest.mouseRelease(self._canvas.native, LEFT, PLAIN, self.where(row, col))

    def pick(self, row, col):
        QTest.mouseClick(self._canvas.native, LEFT, SHIFT, self.where(row, col))

    def drag(self, *places):
        self.press(*places[0])
        for place in places[1:]:
            self.move(*place)
        self.release(*places[-1])

    def paint(self, *places, between=lambda: None):
        """A drag whose every move is felt: vispy and napari drop moves that follow closely."""
        self.press(*places[0])
        for place in places[1:]:
            self._canvas.native._last_time = 0.0
            self.move(*place)
            self._qtbot.waitUntil(lambda place=place: self._is_at(*place), timeout=LONG_MS)
            between()
        self.release(*places[-1])

    def _is_at(self, row, col):
        """Whether napari knows that the pointer is there, to a pixel of the screen."""
        at = self.where(*self.viewer.cursor.position[-2:]) - self.where(row, col)
        return at.manhattanLength() <= 2

    def key(self, key, modifiers=PLAIN):
        self._canvas.native.setFocus()
        QTest.keyClick(self._canvas.native, key, modifiers)


class Touch:
    """Somebody beside a viewer without a window: moves a pointer to places of the world.

    What a canvas tells the viewer and its active layer of the mouse and the keys, they are told by
    the same functions of napari's. That costs a test a fifth of what a window does; what Qt, the
    canvas and the screen have a part in takes a `Person`.
    """

    def __init__(self, viewer):
        self.viewer = viewer
        self._keys = KeymapHandler()

    def press(self, row, col, modifiers=()):
        self._tell(mouse_press_callbacks, "mouse_press", row, col, modifiers)

    def move(self, row, col):
        self._tell(mouse_move_callbacks, "mouse_move", row, col)

    def release(self, row, col):
        self._tell(mouse_release_callbacks, "mouse_release", row, col)

    def pick(self, row, col):
        self.press(row, col, ("Shift",))
        self.release(row, col)

    def drag(self, *places):
        self.press(*places[0])
        for place in places[1:]:
            self.move(*place)
        self.release(*places[-1])

    paint = drag

    def key(self, key, modifiers=PLAIN):
        name = _KEYS.get(key) or chr(int(key))
        for modifier, called in ((SHIFT, "Shift"), (CTRL, "Control")):
            name = f"{called}-{name}" if modifier & modifiers else name
        active = self.viewer.layers.selection.active
        self._keys.keymap_providers = [each for each in (active, self.viewer) if each is not None]
        self._keys.press_key(name)
        self._keys.release_key(name)

    def _tell(self, callbacks, kind, row, col, modifiers=()):
        dims = self.viewer.dims
        place = list(dims.point)
        for axis, at in zip(dims.displayed, (row, col), strict=True):
            place[axis] = at
        event = SimpleNamespace(
            type=kind,
            position=tuple(place),
            button=1,
            modifiers=modifiers,
            is_dragging=True,
            dims_displayed=list(dims.displayed),
            dims_point=list(dims.point),
            camera_zoom=_ZOOM,
            handled=False,
        )
        self.viewer.cursor.position = event.position
        for told in (self.viewer, self.viewer.layers.selection.active):
            if told is not None:
                callbacks(told, ReadOnlyWrapper(event))


def only(widget):
    (mark,) = widget.drawing.marks
    return mark


def by_name(viewer, name):
    return viewer.layers[name]


def settle_moves(person, widget):
    person._qtbot.waitUntil(lambda: not widget.busy, timeout=LONG_MS)
