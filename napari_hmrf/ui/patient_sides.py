"""Letters at the edges of the canvas for the sides of the patient."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from napari.qt import QtViewer
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QGridLayout, QLabel

from napari_hmrf.layers.compat import camera_of
from napari_hmrf.layers.slice_view import Sides
from napari_hmrf.study.session import Session
from napari_hmrf.ui.events import EventConnections

#: Style that is legible on dark and on bright tissue.
_STYLE = (
    "color: #ffd75e; background: rgba(0, 0, 0, 110); border-radius: 4px; padding: 1px 5px;"
    "font-weight: bold;"
)
_MARGIN = 6
#: Top margin in pixels, which leaves room for the line of text about the colours of a layer.
_TOP = 34
#: Row and column of each edge in the grid of labels, in the order of `Sides`.
_EDGES = ((0, 1), (2, 1), (1, 0), (1, 2))
#: Layer list events that can change the letters.
_EVENTS = ("inserted", "removed", "axis_labels")


class PatientSides:
    """Letters at the edges of the canvas, if the image records its orientation in the patient.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    session : Session
        Session with the selected image.
    """

    def __init__(self, viewer: Any, session: Session) -> None:
        self._viewer, self._session = viewer, session
        self._labels: list[QLabel] = []
        dims = viewer.dims.events
        self._connections = EventConnections(
            (dims.order, self.refresh),
            (dims.ndisplay, self.refresh),
            (camera_of(viewer).events.orientation, self.refresh),
            (session.selected, self.refresh),
            (viewer.layers.events, self._on_layers),
        )

    @property
    def shown(self) -> Sides:
        """Letter at each edge of the canvas; "" if hidden."""
        return Sides(*(label.text() for label in self._labels)) if self._labels else Sides()

    def begin(self, window: Any) -> None:
        """Show the letters on the canvas of a napari window."""
        if self._labels:
            return
        canvas = window.findChild(QtViewer).canvas.native
        layout = canvas.layout()  # may exist from a dock that was closed
        if layout is None:
            layout = QGridLayout(canvas)
            layout.setContentsMargins(_MARGIN, _TOP, _MARGIN, _MARGIN)
            layout.setRowStretch(1, 1)
            layout.setColumnStretch(1, 1)
        for edge in _EDGES:
            label = QLabel(styleSheet=_STYLE)
            label.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
            layout.addWidget(label, *edge, Qt.AlignmentFlag.AlignCenter)
            self._labels.append(label)
        self.refresh()

    def refresh(self, *_: Any) -> None:
        """Update the letters for the visible slice."""
        letters = Sides.of(self._session.image, self._viewer)
        for label, letter in zip(self._labels, letters, strict=False):
            label.setText(letter)
            label.setVisible(bool(letter))

    def _on_layers(self, event: Any) -> None:
        if event.type in _EVENTS:
            self.refresh()

    def release(self) -> None:
        """Remove the letters."""
        self._connections.release()
        for label in self._labels:
            with suppress(RuntimeError):  # deleted with the window
                label.deleteLater()
        self._labels = []
