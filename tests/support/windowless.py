"""A dock beside a viewer without a window, and a simulated pointer."""

from types import SimpleNamespace

import numpy as np
from napari.components import ViewerModel
from napari.utils._proxies import ReadOnlyWrapper
from napari.utils.interactions import (
    mouse_move_callbacks,
    mouse_press_callbacks,
    mouse_release_callbacks,
    mouse_wheel_callbacks,
)
from napari.utils.key_bindings import KeymapHandler
from qtpy.QtCore import Qt
from qtpy.QtTest import QTest
from qtpy.QtWidgets import QVBoxLayout, QWidget

from napari_hmrf.layers.compat import camera_of
from napari_hmrf.ui.soft_tissue import SoftTissue
from tests.support.person import CTRL, PLAIN, SHIFT
from tests.support.timeouts import LONG_MS

#: Screen pixels per image pixel, as in a window of the usual size.
_ZOOM = 8.0
#: Types of windows that a dock opens; Qt makes menus and lists, which are of other types.
_WINDOWS = Qt.WindowType.Window, Qt.WindowType.Dialog, Qt.WindowType.Tool
#: Names of napari for keys without a letter.
_KEYS = {
    Qt.Key.Key_Delete: "Delete",
    Qt.Key.Key_Backspace: "Backspace",
    Qt.Key.Key_Escape: "Escape",
    Qt.Key.Key_Space: "Space",
    Qt.Key.Key_Up: "Up",
    Qt.Key.Key_Down: "Down",
}


class Touch:
    """Simulated pointer at a viewer without a window, moved in world coordinates.

    In a 3-D view, places are (depth, row, col) on the line of sight, which has the direction
    `ahead`.

    It calls the functions of napari that a canvas calls for mouse and keyboard events. Such a test
    is five times as fast as a test with a window. Tests of Qt, the canvas or the screen need a
    `Person`.
    """

    #: Direction from the camera in a 3-D view, as a unit vector.
    ahead = (1.0, 0.0, 0.0)

    def __init__(self, viewer, frame=None):
        self.viewer, self.frame = viewer, frame
        self._keys = KeymapHandler()

    def press(self, *at, modifiers=()):
        self._tell(mouse_press_callbacks, "mouse_press", at, modifiers)

    def move(self, *at):
        self._tell(mouse_move_callbacks, "mouse_move", at)

    def release(self, *at):
        self._tell(mouse_release_callbacks, "mouse_release", at)

    def pick(self, *at):
        self.press(*at, modifiers=("Shift",))
        self.release(*at)

    def wheel(self, steps):
        """Turn the mouse wheel forward by a number of steps."""
        self._tell(mouse_wheel_callbacks, "mouse_wheel", None, delta=(0.0, float(steps)))

    def turn_wheel(self, row, col, notches=1, modifiers=()):
        """Move the pointer to a pixel, and turn the mouse wheel."""
        at = row, col
        self._tell(mouse_move_callbacks, "mouse_move", at, is_dragging=False)
        self._tell(mouse_wheel_callbacks, "mouse_wheel", at, modifiers, delta=(0, notches))

    def drag(self, *places, between=lambda: None):
        self.press(*places[0])
        for place in places[1:]:
            self.move(*place)
            between()
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

    def _tell(self, callbacks, kind, at, modifiers=(), is_dragging=True, delta=(0.0, 0.0)):
        dims = self.viewer.dims
        place = list(self.viewer.cursor.position if at is None else dims.point)
        for axis, along in () if at is None else zip(dims.displayed, at, strict=True):
            place[axis] = along
        event = SimpleNamespace(
            type=kind,
            position=tuple(place),
            button=1,
            modifiers=modifiers,
            is_dragging=is_dragging,
            native=SimpleNamespace(inverted=lambda: False),
            dims_displayed=list(dims.displayed),
            dims_point=list(dims.point),
            camera_zoom=_ZOOM,
            view_direction=np.array(self.ahead) if dims.ndisplay == 3 else None,
            delta=delta,
            handled=False,
        )
        self.viewer.cursor._view_direction = event.view_direction
        self.viewer.cursor.position = event.position
        for told in (self.viewer, self.viewer.layers.selection.active):
            if told is not None:
                callbacks(told, ReadOnlyWrapper(event))


class Frame:
    """Viewer without a canvas, with a frame to which docks are added.

    Attributes
    ----------
    viewer : ViewerModel
    ready : SoftTissue or None
        Dock that the next call of `open` returns instead of a new dock.
    """

    def __init__(self):
        self.viewer, self.ready = ViewerModel(), None
        self._around = QWidget()
        self._around.setLayout(QVBoxLayout())
        self._docks = []
        parts = self.viewer.dims, camera_of(self.viewer), self.viewer.cursor
        self._home = [(part, part.model_dump()) for part in parts]

    def open(self):
        """Add a dock to the frame."""
        dock, self.ready = self.ready, None
        if dock is None:
            dock = SoftTissue(self.viewer)
            self._docks.append(dock)
            self._around.layout().addWidget(dock.native)
        return dock

    def open_loose(self):
        """Build a dock outside the frame, as a script does."""
        dock = SoftTissue(self.viewer)
        self._docks.append(dock)
        return dock

    def show(self):
        """Show the frame, so that its controls are visible to the mouse."""
        self._around.show()
        assert QTest.qWaitForWindowExposed(self._around, LONG_MS)

    def close(self, dock):
        """Remove a dock, as napari does with a closed dock."""
        dock.native.setParent(None)

    def reset(self, dock):
        """Hide the frame, close all windows and docks but one, and remove all layers."""
        self._around.hide()
        for root in (self._around, dock.native):
            for child in root.findChildren(QWidget):
                if child.windowType() in _WINDOWS:
                    child.close()
                    child.deleteLater()
        for other in self._docks:
            if other is not dock and not other.away:
                self.close(other)
        self._docks = [dock]
        layers = self.viewer.layers
        layers.selection.clear()
        with layers.events.blocker_all():  # each removal would update the whole dock
            del layers[1:]
        layers.clear()
        for part, values in self._home:
            part.update(values)

    def delete(self):
        """Close all docks, and delete the frame."""
        for dock in self._docks:
            if not dock.away:
                self.close(dock)
            dock.native.deleteLater()
        self._around.deleteLater()
