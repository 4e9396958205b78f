"""Keeping a Labels layer and the table of its labels in step."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Labels
from psygnal import Signal

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.metadata import BOUNDARY, Role, described, known_of, rows_of
from napari_hmrf.layers.pixel_copy import copy_slice
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.slice_view import View
from napari_hmrf.tissue.labels import labels_present
from napari_hmrf.ui.events import Listening, single_shot
from napari_hmrf.ui.label_table import LabelTable

#: How long after the last brush stroke the labels are looked at, in milliseconds.
_PAUSE = 150
#: The layer's events after which there may be new labels, or other colours.
_EVENTS = ("data", "set_data", "labels_update", "paint", "colormap")


class PaintedLabels:
    """A Labels layer beside its table: new labels get rows, rows that are picked their label.

    The table is kept in the layer's metadata, so that it goes where the layer goes.

    Parameters
    ----------
    role : "tissue" or "boundary"
    table : LabelTable
    view : callable
        Which slice is shown.
    """

    #: The paint or the table changed.
    changed = Signal()
    #: A row was picked, to paint with in the layer.
    picked = Signal(object)
    #: What new labels were painted, in words.
    found = Signal(str)

    def __init__(self, role: Role, table: LabelTable, view: Callable[[], View | None]) -> None:
        self._role, self._table, self._view = role, table, view
        self._layer: Any = None
        self._loading = False
        self._active = False
        #: Whether rows are being added for what was painted, by nobody's hand.
        self.by_itself = False
        self._heard = Listening()
        self._timer = single_shot(table, _PAUSE, self.look)
        table.edited.connect(self._on_edited)
        table.picked.connect(self._on_picked)

    @property
    def layer(self) -> Any:
        """The Labels layer, or None."""
        return self._layer

    @layer.setter
    def layer(self, layer: Any) -> None:
        if layer is self._layer:
            return
        self.release()
        self._layer = layer if isinstance(layer, Labels) else None
        if self._layer is None:
            return
        self._loading = True
        self._table.unit = str(known_of(self._layer).get("unit", ""))
        self._table.rows = rows_of(self._layer, self._role) or ()
        self._look(quietly=True)
        self._loading = False
        events = self._layer.events
        self._heard = Listening(
            (events.selected_label, self._on_selected),
            *((getattr(events, name), self._on_painted) for name in _EVENTS),
        )
        self._on_edited()

    def release(self) -> None:
        """Stop listening to the layer."""
        with suppress(RuntimeError):  # at the end of the program Qt may have ended it already
            self._timer.stop()
        self._heard.release()
        self._layer = None

    def look(self) -> None:
        """Give new labels their rows and all rows their colours; now, not after a pause."""
        if self._layer is not None:
            self._look()
            self.changed.emit()

    def _look(self, quietly: bool = False) -> None:
        self._timer.stop()
        labels = {int(label) for label in labels_in(self._layer, self._view())}
        if self._role == BOUNDARY:
            labels = {label for label in labels if label > 0}
        self.by_itself = True
        try:
            new = self._table.ensure(labels)
        finally:
            self.by_itself = False
        if new and not quietly:
            said = " and ".join(f"label {row.label} ({self._table.words(row)})" for row in new[:3])
            self.found.emit(f"New in '{self._layer.name}': {said}. Change it in the table.")
        colours = {
            label: tuple(map(float, rgba))
            for label in self._table.labels
            if label and (rgba := self._layer.get_color(label)) is not None
        }
        self._table.set_colours(colours)

    def mark(self, active: Any) -> None:
        """Highlight the row that is painted with, if the layer is the active one; else none."""
        self._active = self._layer is not None and active is self._layer
        self._table.marked.emit(int(self._layer.selected_label) if self._active else None)

    def _on_painted(self) -> None:
        # Restarted at every stroke: looking at a large image takes longer than a stroke.
        self._timer.start()

    def _on_selected(self) -> None:
        if self._active:
            self._table.marked.emit(int(self._layer.selected_label))

    def _on_picked(self, label: int) -> None:
        if self._layer is not None and not self._loading:
            self._layer.selected_label = label
            self.picked.emit(self._layer)

    def _on_edited(self) -> None:
        if self._layer is None or self._loading:
            return
        self._layer.metadata.update(described(self._role, self._table.rows, self._table.unit))
        self._timer.start()
        self.changed.emit()


def labels_in(layer: Any, view: View | None) -> npt.NDArray[Any]:
    """The labels in the slice that is shown; none if it cannot be read."""
    try:
        picture = copy_slice(layer, Frame.of(layer, view))
    except ProblemError:
        return np.zeros(0, dtype=int)
    return labels_present(picture)
