"""Letters at the edges of the canvas that say which side of the patient lies there."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from napari.qt import QtViewer
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QGridLayout, QLabel

from napari_hmrf.layers.compat import camera_of
from napari_hmrf.layers.screen_directions import Sides
from napari_hmrf.ui.events import EventConnections
from napari_hmrf.ui.layer_choice import LayerChoice

#: Read on dark tissue and on bright.
_STYLE = (
    "color: #ffd75e; background: rgba(0, 0, 0, 110); border-radius: 4px; padding: 1px 5px;"
    "font-weight: bold;"
)
_MARGIN = 6
#: Below the line in which napari names what colours show.
_TOP = 34
#: Rows and columns of the canvas, in the order of `Sides`.
_EDGES = ((0, 1), (2, 1), (1, 0), (1, 2))
#: What happens to layers, of all that does, after which other letters may be seen.
_TELLING = ("inserted", "removed", "axis_labels")


class PatientSides:
    """Shows them while a dock is there, if its image says how it lies in the patient.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    image : LayerChoice
    """

    def __init__(self, viewer: Any, image: LayerChoice) -> None:
        self._viewer, self._image = viewer, image
        self._labels: list[QLabel] = []
        dims = viewer.dims.events
        self._connections = EventConnections(
            (dims.order, self.look),
            (dims.ndisplay, self.look),
            (camera_of(viewer).events.orientation, self.look),
            (image.changed, self.look),
            (viewer.layers.events, self._on_layers),
        )

    @property
    def shown(self) -> Sides:
        """The letters that are seen, in words of the edges."""
        return Sides(*(label.text() for label in self._labels)) if self._labels else Sides()

    def begin(self, window: Any) -> None:
        """Show them on the canvas of a window of napari's."""
        if self._labels:
            return
        canvas = window.findChild(QtViewer).canvas.native
        layout = canvas.layout()  # of a dock that was closed
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
        self.look()

    def look(self, *_: Any) -> None:
        """Show what is known of the slice that is seen."""
        seen = Sides.of(self._image.value, self._viewer)
        for label, letter in zip(self._labels, seen, strict=False):
            label.setText(letter)
            label.setVisible(bool(letter))

    def _on_layers(self, event: Any) -> None:
        if event.type in _TELLING:
            self.look()

    def release(self) -> None:
        """Take them away."""
        self._connections.release()
        for label in self._labels:
            with suppress(RuntimeError):  # gone with their window
                label.deleteLater()
        self._labels = []
