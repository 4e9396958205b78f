"""What happens in the viewer and the tables, and what the widget does about it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.metadata import role_of
from napari_hmrf.layers.pixel_copy import plane_shape
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.screen_directions import Directions
from napari_hmrf.layers.slice_view import View, unit_symbol
from napari_hmrf.layers.viewer_layers import is_selection_kept
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.ui.deform_form import Face
from napari_hmrf.ui.event_wait import Listening
from napari_hmrf.ui.messages import READY
from napari_hmrf.ui.preview import BoundaryPreview, LandmarkPreview
from napari_hmrf.ui.result_dock import ResultDock
from napari_hmrf.ui.sections import NO_PREVIEW, PREVIEW
from napari_hmrf.ui.timers import single_shot

#: How long after the last change it is asked what that means for the result, in milliseconds.
_PAUSE = 300


_log = logging.getLogger("napari_hmrf")


class Watch:
    """Listens for a widget, until it is released; draws the preview of its boundary.

    Parameters
    ----------
    widget : ResultDock
    viewer : napari.Viewer or ViewerModel
    face : Face
        Of the widget.
    edited, rested : callable
        Called when anything has changed that a result depends on, and when that is over.
    removed : callable
        Called with a layer that is gone.
    """

    def __init__(
        self,
        widget: ResultDock,
        viewer: Any,
        face: Face,
        *,
        edited: Callable[[], None],
        rested: Callable[[], None],
        removed: Callable[[Any], None],
    ) -> None:
        self._widget = widget
        self._edited, self._removed = edited, removed
        self._viewer = viewer
        self._face = face
        self.preview = BoundaryPreview(viewer)
        self.pairs = LandmarkPreview(viewer)
        self._undrawn = ""
        self._drawing = single_shot(widget.native, 0, self._draw_preview)
        self._fitting = single_shot(widget.native, 50, self._fit_view)
        self._checking = single_shot(widget.native, _PAUSE, rested)
        face.image.changed.connect(self._on_image)
        face.boundary.edited.connect(self._on_edited)
        face.tissue.edited.connect(self._on_edited)
        face.model.changed.connect(self._check_soon)
        face.settings.changed.connect(self._check_soon)
        for check in face.checks:
            check.changed.connect(self._check_soon)
        for section in (face.tissue, face.boundary):
            section.painted.found.connect(widget.note)
            section.table.refused.connect(widget.say)
        face.tissue.menu.said.connect(widget.say)
        face.tissue.menu.taken.connect(widget.note)
        face.tissue.curve.refused.connect(widget.say)
        self._events = Listening(
            (viewer.layers.events.inserted, self._on_inserted),
            (viewer.layers.events.removed, self._on_removed),
            (viewer.layers.events.renamed, widget.reset_choices),
            (viewer.layers.selection.events.active, self._on_active),
            (viewer.dims.events.current_step, self._on_edited),
            (viewer.dims.events.order, self._on_edited),
            (viewer.dims.events.current_step, face.tissue.curve.look),
            (viewer.dims.events.order, face.tissue.curve.look),
            (viewer.events.theme, self._on_theme),
        )
        self._on_theme()

    def release(self) -> None:
        """Listen no more."""
        self._events.release()

    def hide_previews(self) -> None:
        """Make way for a result; the next edit shows them again."""
        self.preview.hide()
        self.pairs.hide()

    def leave(self) -> None:
        """The dock was closed: nobody would keep the previews true."""
        self._drawing.stop()
        self.preview.remove()
        self.pairs.remove()

    def settle(self) -> None:
        """Forget what has changed so far: there is something else to read at the bottom."""
        self._checking.stop()

    def _on_edited(self, *_: Any) -> None:
        if not self._widget.away:
            self._drawing.start()
            self._mark()
            self._check_soon()

    def _on_image(self, image: Any) -> None:
        self._face.make.enabled = self._face.intensity.enabled = image is not None
        self._on_edited()

    def _check_soon(self, *_: Any) -> None:
        if not self._widget.away:
            self._checking.start()
            self._edited()

    def _on_inserted(self, event: Any) -> None:
        widget = self._widget
        if widget.away:
            return
        widget.reset_choices()
        widget.choose_by_role([event.value])
        if role_of(event.value) and len(self._viewer.layers) == 1:
            self._fitting.start()
        if role_of(event.value) and widget.can_deform:
            widget.say(widget.invitation)

    def _fit_view(self) -> None:
        """Show the whole of a sample; napari fitted its first layer before it knew the canvas."""
        if not self._widget.away:
            self._viewer.reset_view()

    def _on_removed(self, event: Any) -> None:
        widget = self._widget
        if widget.away:
            return
        was_image = widget.image is event.value
        widget.reset_choices()
        if was_image:
            widget.choose_another()
            widget.image_gone(event.value)
        self._check_soon()
        self._removed(event.value)

    def _on_active(self, *_: Any) -> None:
        if not self._widget.away:
            self._mark()
            if not is_selection_kept(self._viewer):
                self._widget.active_changed(self._viewer.layers.selection.active)

    def _mark(self) -> None:
        active = self._viewer.layers.selection.active
        for section in (self._face.tissue, self._face.boundary):
            section.painted.mark(active)

    def _on_theme(self, *_: Any) -> None:
        theme = getattr(self._viewer, "theme", None)
        if theme is not None and not self._widget.away:
            self._face.energy.show_theme(str(theme))

    def _draw_preview(self) -> None:
        widget, boundary = self._widget, self._face.boundary
        view = View.of(self._viewer.dims)
        place = widget.image if widget.image is not None else widget.tissue
        try:
            reference = None if place is None else Frame.of(place, view)
            if reference is not None:
                ways = Directions.of(reference, self._viewer)
                boundary.table.show_place(unit_symbol(reference.unit), ways)
                boundary.landmarks.show_place(reference, plane_shape(place, reference))
            layer = boundary.painted.layer
            too_large = layer is not None and self.preview.too_large(layer)
            boundary.preview.enabled = not too_large
            boundary.preview.text = NO_PREVIEW if too_large else PREVIEW
            if layer is not None and boundary.preview.value and not too_large:
                self.preview.update(layer, widget.rules, view, reference)
            else:
                self.preview.remove()
            self._draw_pairs(place, view)
        except Exception as error:  # noqa: BLE001 - Qt calls this: nobody else would tell the user
            if not isinstance(error, ProblemError):
                _log.exception("the preview could not be drawn")
            self._undrawn = error.sentence if isinstance(error, LayerError) else str(error)
            widget.say(self._undrawn)
        else:
            if self._undrawn and self._undrawn == widget.status:
                widget.say(READY)
            self._undrawn = ""

    def _draw_pairs(self, place: Any, view: View) -> None:
        """Show which landmarks are pairs, once they are pairs."""
        landmarks = self._face.boundary.landmarks
        if place is None or not landmarks.complete or not self._face.boundary.preview.value:
            self.pairs.remove()
        elif (pair := landmarks.chosen) is not None:
            self.pairs.update(pair, place, view)
