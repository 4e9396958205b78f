"""What happens in the viewer while tissue is pulled."""

from __future__ import annotations

from typing import Any, Protocol

from napari_hmrf.layers.edit_history import Slot, steps_of
from napari_hmrf.layers.image_choice import image_in_front, painted_on
from napari_hmrf.layers.metadata import BOUNDARY, IMAGE, TISSUE, role_of
from napari_hmrf.layers.slice_view import View
from napari_hmrf.tissue.drawing import Drawing
from napari_hmrf.ui.event_wait import Listening
from napari_hmrf.ui.grab.form import GrabForm
from napari_hmrf.ui.grab.histories import drawn_on
from napari_hmrf.ui.pixels import Pixels
from napari_hmrf.ui.preview import is_preview
from napari_hmrf.ui.timers import single_shot

#: How long after the last change of a layer it is read again, in milliseconds.
_PAUSE = 200


class Watched(Protocol):
    """The dock, as far as it is told of what happens."""

    native: Any

    @property
    def away(self) -> bool:
        """Whether the window is gone, or the dock was closed."""

    @property
    def drawing(self) -> Drawing:
        """What is drawn on the slice that is shown."""

    def reset_choices(self) -> None:
        """There are other layers."""

    def look(self) -> object:
        """What is read may say something else."""

    def let_go(self) -> None:
        """Another slice is shown."""

    def active_changed(self) -> None:
        """Another layer feels the mouse."""

    def layer_gone(self, layer: Any) -> None:
        """A layer was removed."""

    def cover_changed(self) -> None:
        """The image may be hidden beneath another, or no more."""


class GrabWatch:
    """Listens for *Grab and pull*, until it is released.

    Parameters
    ----------
    widget : Watched
    form : GrabForm
        Of the widget.
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, widget: Watched, form: GrabForm, viewer: Any) -> None:
        self._widget, self._form = widget, form
        self._viewer = viewer
        self._looking = single_shot(widget.native, _PAUSE, self._look)
        self._pixels = Pixels(self._on_pixels)
        steps_of(viewer).edits.changed.connect(self._on_table)
        form.image.changed.connect(self._on_choice)
        form.tissue.changed.connect(self._on_choice)
        form.boundary.changed.connect(self._on_choice)
        form.edge.changed.connect(self._on_choice)
        form.fields.preset.changed.connect(self._on_choice)
        self._events = Listening(
            (viewer.layers.events.inserted, self._on_inserted),
            (viewer.layers.events.removed, self._on_removed),
            (viewer.layers.events.renamed, widget.reset_choices),
            (viewer.layers.selection.events.active, self._on_active),
            (viewer.dims.events.current_step, self._on_slice),
            (viewer.dims.events.order, self._on_slice),
            (viewer.dims.events.ndisplay, self._on_slice),
            (viewer.layers.events.reordered, self._on_cover),
        )
        self._slice = _slice_of(viewer.dims)
        self._eyes = Listening()
        self._look_at_eyes()

    @property
    def waiting(self) -> bool:
        """Whether layers have changed that are not read yet."""
        return bool(self._looking.isActive())

    def choose_first(self) -> None:
        """Choose among what is there: the image in front, or one drawn on, and what is painted."""
        layers, image = list(self._viewer.layers), self._form.image
        meant = image_in_front(self._viewer, image.offered, drawn_on(self._viewer))
        if meant is not None:
            layers = [meant, *painted_on(meant, layers, View.of(self._viewer.dims))]
        self.choose_by_role(layers)

    def choose_by_role(self, layers: list[Any]) -> None:
        """Choose an image and its tissue as they come, and the first image if there is none yet."""
        image, tissue = self._form.image, self._form.tissue
        for layer in layers:
            role = role_of(layer)
            if role == TISSUE:
                tissue.value = layer
            elif layer in image.offered and (role == IMAGE or image.value is None):
                image.value = layer

    def hide_paint(self) -> None:
        """Hide what is painted: it says where tissue is before it moves, and would tint it."""
        for layer in self._viewer.layers:
            painted = layer in self._painted or role_of(layer) in (TISSUE, BOUNDARY)
            if painted or is_preview(layer):
                layer.visible = False

    def release(self) -> None:
        """Listen no more."""
        self._events.release()
        self._eyes.release()
        self._pixels.release()
        steps_of(self._viewer).edits.changed.disconnect(self._on_table, missing_ok=True)

    @property
    def _painted(self) -> tuple[Any, Any]:
        """The layers that say what is tissue and what holds it."""
        return self._form.tissue.value, self._form.boundary.value

    def _look(self) -> None:
        if not self._widget.away:
            self._widget.look()

    def _on_choice(self, *_: Any) -> None:
        if self._widget.away:
            return
        chosen = (self._form.image.value, *self._painted)
        self._pixels.listen_to([layer for layer in chosen if layer is not None])
        self._looking.start(0)

    def _on_pixels(self, *_: Any) -> None:
        if not self._widget.away:
            self._looking.start(_PAUSE)

    def _on_table(self, slot: Any, _: Any) -> None:
        """The table of a layer says something else, in whichever dock that was done."""
        of_ours = isinstance(slot, Slot) and slot.what in (TISSUE, BOUNDARY)
        if of_ours and slot.layer in self._painted:
            self._on_pixels()

    def _on_slice(self, *_: Any) -> None:
        # An arrow over the image's edge makes the canvas larger, and napari says as much.
        before, self._slice = self._slice, _slice_of(self._viewer.dims)
        widget = self._widget
        if not widget.away and self._slice != before:
            widget.let_go()
            self._looking.start(0)

    def _look_at_eyes(self) -> None:
        """Listen to whether layers are shown: those that there are now."""
        self._eyes.release()
        seen = ((layer.events.visible, self._on_cover) for layer in self._viewer.layers)
        self._eyes = Listening(*seen)

    def _on_cover(self, *_: Any) -> None:
        if not self._widget.away:
            self._widget.cover_changed()

    def _on_inserted(self, event: Any) -> None:
        self._look_at_eyes()
        if not self._widget.away:
            self._widget.reset_choices()
            # What is drawn on stays: a layer that comes now was made for something else.
            if not self._widget.drawing.marks:
                self.choose_by_role([event.value])
            self._on_cover()

    def _on_removed(self, event: Any) -> None:
        self._look_at_eyes()
        widget = self._widget
        if not widget.away:
            widget.reset_choices()
            widget.layer_gone(event.value)
            self._on_cover()

    def _on_active(self, *_: Any) -> None:
        if not self._widget.away:
            self._widget.active_changed()


def _slice_of(dims: Any) -> tuple[int, tuple[int, ...], tuple[float, ...]]:
    """In how many dimensions, which axes are drawn, and where on all others."""
    shown = tuple(int(axis) for axis in dims.displayed)
    return (
        int(dims.ndisplay),
        shown,
        tuple(float(at) for axis, at in enumerate(dims.point) if axis not in shown),
    )
