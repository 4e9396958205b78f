"""Letters at the edges of the canvas that say which side of the patient lies there."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from napari.qt import QtViewer
from qtpy.QtCore import QEvent, QObject, Qt
from qtpy.QtWidgets import QLabel

from napari_hmrf.layers.compat import camera_of
from napari_hmrf.layers.patient_axes import Sides
from napari_hmrf.ui.events import Listening

#: Read on dark tissue and on bright.
_STYLE = (
    "color: #ffd75e; background: rgba(0, 0, 0, 110); border-radius: 4px; padding: 1px 5px;"
    "font-weight: bold;"
)
_MARGIN = 6


class PatientSides(QObject):
    """Shows them while a dock is there, on slices whose layers say how they lie in the patient.

    Parameters
    ----------
    native : QWidget
        The dock.
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, native: Any, viewer: Any) -> None:
        super().__init__(native)
        self._viewer = viewer
        self._labels: list[QLabel] = []
        dims = viewer.dims.events
        self._heard = Listening(
            (dims.order, self.look),
            (dims.ndisplay, self.look),
            (camera_of(viewer).events.orientation, self.look),
            (viewer.layers.events, self._on_layers),
        )

    @property
    def shown(self) -> Sides:
        """The letters that are seen, in words of the edges."""
        return Sides(*(label.text() for label in self._labels)) if self._labels else Sides()

    def begin(self, window: Any) -> None:
        """Show them on the canvas of a window of napari's."""
        canvas = window.findChild(QtViewer).canvas.native
        if not self._labels:
            self._labels = [QLabel(canvas) for _ in Sides._fields]
            canvas.installEventFilter(self)
        for label in self._labels:
            label.setStyleSheet(_STYLE)
            label.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.look()

    def eventFilter(self, watched: Any, event: Any) -> bool:
        """Keep to the edges of the canvas."""
        if event.type() == QEvent.Type.Resize:
            self._place()
        return False

    def look(self, *_: Any) -> None:
        """Show what is known of the slice that is seen."""
        for label, letter in zip(self._labels, Sides.of(self._viewer), strict=False):
            label.setText(letter)
            label.setVisible(bool(letter))
            label.adjustSize()
        self._place()

    def _on_layers(self, event: Any) -> None:
        if event.type in _TELLING:
            self.look()

    def _place(self) -> None:
        for label, (across, down) in zip(self._labels, _EDGES, strict=False):
            canvas = label.parentWidget().rect()
            room = canvas.adjusted(
                _MARGIN, _MARGIN, -_MARGIN - label.width(), -_MARGIN - label.height()
            )
            label.move(
                room.left() + round(across * room.width()), room.top() + round(down * room.height())
            )

    def release(self) -> None:
        """Take them away."""
        self._heard.release()
        for label in self._labels:
            with suppress(RuntimeError):  # gone with their window
                label.deleteLater()
        self._labels = []


#: What happens to layers, of all that does, after which other letters may be seen.
_TELLING = ("inserted", "removed", "visible", "axis_labels")
#: Where the letters stand, from 0 to 1, in the order of `Sides`.
_EDGES = ((0.5, 0.0), (0.5, 1.0), (0.0, 0.5), (1.0, 0.5))
