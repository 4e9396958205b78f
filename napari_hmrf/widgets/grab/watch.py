"""What happens in the viewer while tissue is pulled."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from qtpy.QtCore import QTimer

from napari_hmrf.layers.metadata import IMAGE, TISSUE, known_of, role_of

if TYPE_CHECKING:
    from napari_hmrf.widgets.grab.dock import GrabAndPull

#: How long after the last change of a layer it is read again, in milliseconds.
_PAUSE = 200
#: The events after which a layer's pixels, or their place, are others.
_PIXELS = ("data", "labels_update", "paint", "scale", "translate", "rotate", "shear", "affine")


class GrabWatch:
    """Listens for *Grab and pull*, until it is released.

    Parameters
    ----------
    widget : GrabAndPull
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, widget: GrabAndPull, viewer: Any) -> None:
        self._widget = widget
        self._viewer = viewer
        self._looking = QTimer(widget.native)
        self._looking.setSingleShot(True)
        self._looking.timeout.connect(self._look)
        self._layers: list[Any] = []
        form = widget.form
        form.image.changed.connect(self._on_choice)
        form.tissue.changed.connect(self._on_choice)
        form.edge.changed.connect(self._on_choice)
        self._events = [
            (viewer.layers.events.inserted, self._on_inserted),
            (viewer.layers.events.removed, self._on_removed),
            (viewer.layers.events.renamed, widget.reset_choices),
            (viewer.layers.selection.events.active, self._on_active),
            (viewer.dims.events.current_step, self._on_slice),
            (viewer.dims.events.order, self._on_slice),
            (viewer.dims.events.ndisplay, self._on_slice),
        ]
        for event, answer in self._events:
            event.connect(answer)

    def release(self) -> None:
        """Listen no more."""
        for event, answer in self._events:
            event.disconnect(answer)
        self._events = []
        self._listen_to([])

    def _look(self) -> None:
        if not self._widget.away:
            self._widget.look()

    def _listen_to(self, layers: list[Any]) -> None:
        for layer in self._layers:
            for name in _PIXELS:
                if hasattr(layer.events, name):
                    getattr(layer.events, name).disconnect(self._on_pixels)
        self._layers = layers
        for layer in layers:
            for name in _PIXELS:
                if hasattr(layer.events, name):
                    getattr(layer.events, name).connect(self._on_pixels)

    def _on_choice(self, *_: Any) -> None:
        widget = self._widget
        if widget.away:
            return
        self._listen_to([layer for layer in (widget.image, widget.tissue) if layer is not None])
        self._looking.start(0)

    def _on_pixels(self, *_: Any) -> None:
        if not self._widget.away:
            self._looking.start(_PAUSE)

    def _on_slice(self, *_: Any) -> None:
        widget = self._widget
        if not widget.away:
            widget.let_go()
            self._looking.start(0)

    def _on_inserted(self, event: Any) -> None:
        widget, layer = self._widget, event.value
        if widget.away:
            return
        widget.reset_choices()
        if role_of(layer) == TISSUE:
            widget.tissue = layer
        elif role_of(layer) == IMAGE or (
            widget.image is None and layer in widget.form.image.offered and not known_of(layer)
        ):
            widget.image = layer

    def _on_removed(self, event: Any) -> None:
        widget = self._widget
        if not widget.away:
            widget.reset_choices()
            widget.layer_gone(event.value)

    def _on_active(self, *_: Any) -> None:
        if not self._widget.away:
            self._widget.active_changed()
