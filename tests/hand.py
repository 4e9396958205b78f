"""Somebody before a viewer that has no canvas: for claims that only need to know who did what."""

from types import SimpleNamespace

from napari.components import ViewerModel
from napari.utils.interactions import (
    mouse_move_callbacks,
    mouse_press_callbacks,
    mouse_release_callbacks,
)
from napari.utils.key_bindings import KeymapHandler
from person import PLAIN
from qtpy.QtGui import QKeySequence
from qtpy.QtWidgets import QVBoxLayout, QWidget

from napari_hmrf.ui.soft_tissue import SoftTissue

#: Pixels of the screen for each of the image, about as many as in a window.
_ZOOM = 8.0
#: Keys that napari calls by other names than Qt.
_NAMES = {"Del": "Delete", "Esc": "Escape"}


class Hand:
    """Moves the mouse and presses keys as `Person` does; layers are told what a canvas would say.

    Parameters
    ----------
    viewer : ViewerModel
    """

    def __init__(self, viewer):
        self.viewer = viewer
        self._event = None

    def press(self, row, col, modifiers=()):
        self._event = SimpleNamespace(button=1, modifiers=modifiers, is_dragging=True)
        self._tell(mouse_press_callbacks, "mouse_press", row, col)

    def move(self, row, col):
        self._tell(mouse_move_callbacks, "mouse_move", row, col)

    def release(self, row, col):
        self._tell(mouse_release_callbacks, "mouse_release", row, col)

    def pick(self, row, col):
        self.press(row, col, modifiers=("Shift",))
        self.release(row, col)

    def drag(self, *places, between=lambda: None):
        self.press(*places[0])
        for place in places[1:]:
            self.move(*place)
            between()
        self.release(*places[-1])

    paint = drag

    def key(self, key, modifiers=PLAIN):
        keys = KeymapHandler()
        active = self.viewer.layers.selection.active
        keys.keymap_providers = [each for each in (active, self.viewer) if each is not None]
        pressed = QKeySequence(int(key) | modifiers.value).toString()
        keys.press_key(_NAMES.get(pressed, pressed))

    def _tell(self, callbacks, kind, row, col):
        viewer, event = self.viewer, self._event
        event.type = kind
        event.position = (*viewer.dims.point[:-2], float(row), float(col))
        event.view_direction = event.up_direction = None
        event.dims_displayed = list(viewer.dims.displayed)
        event.dims_point = list(viewer.dims.point)
        event.camera_zoom = _ZOOM
        viewer.cursor.position = event.position
        callbacks(viewer, event)
        if (layer := viewer.layers.selection.active) is not None:
            callbacks(layer, event)


class Frame:
    """A viewer without a canvas, and the frame that a dock is put into, and taken out of again.

    Parameters
    ----------
    qtbot
    """

    def __init__(self, qtbot):
        self.viewer = ViewerModel()
        self._qtbot = qtbot
        self._around = QWidget()
        self._around.setLayout(QVBoxLayout())
        qtbot.addWidget(self._around)

    def open(self):
        """Put a new dock into the frame."""
        dock = SoftTissue(self.viewer)
        self._around.layout().addWidget(dock.native)
        return dock

    def show(self):
        """Have what is in the frame be seen, and pressed by a mouse where it is seen."""
        with self._qtbot.waitExposed(self._around):
            self._around.show()

    def close(self, dock):
        """Take a dock out, as napari does with one that is closed."""
        dock.native.setParent(None)
