"""Edits of landmarks as steps that can be undone: napari has no undo of points, or of lines."""

from __future__ import annotations

import weakref
from collections.abc import Iterable
from functools import partial
from operator import eq
from typing import Any

from napari.layers import Points, Shapes
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QApplication

from napari_hmrf.layers.compat import is_drawn
from napari_hmrf.layers.edit_history import POINTS, Slot, steps_of
from napari_hmrf.layers.points_state import placed_in
from napari_hmrf.ui.event_wait import Listening
from napari_hmrf.ui.timers import single_shot

#: How long points, or lines, must rest until a drag of them is over, in milliseconds.
_REST = 200


class PointSteps:
    """Keeps what is done to points or lines that are landmarks, and puts back what is undone.

    A drag is one step, however many times napari tells of it. Points that have steps are listened
    to until their layer is removed, landmarks or not, whichever docks are closed: what is put back
    is all of a layer, and would take along what nobody heard of.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
        Have one of them in a viewer, by `shared`.
    """

    def __init__(self, viewer: Any) -> None:
        self._edits = steps_of(viewer).edits
        self._chosen: weakref.WeakKeyDictionary[Any, tuple[Any, ...]] = weakref.WeakKeyDictionary()
        self._heard: dict[Any, Listening] = {}
        self._undoing = False
        self._resting = single_shot(None, _REST, self._on_rest)
        self._edits.changed.connect(self._on_undone)
        viewer.layers.events.removed.connect(self._on_removed)

    def listen(self, owner: Any, layers: Iterable[Any]) -> None:
        """Listen to the layers that are an owner's landmarks now, none or more.

        Parameters
        ----------
        owner : object
            Who chose them; known weakly.
        layers : iterable of napari.layers.Layer
            Those that are neither points nor lines do not matter.
        """
        points = tuple(layer for layer in layers if isinstance(layer, Points | Shapes))
        if points == self._chosen.get(owner, ()):
            return
        self._end()
        self._chosen[owner] = points
        wanted = {layer for chosen in self._chosen.values() for layer in chosen}
        for layer in self._heard.keys() - wanted:
            slot = Slot(POINTS, layer)
            if not self._edits.has_steps(slot):
                self._heard.pop(layer).release()
                self._edits.drop(partial(eq, slot))
        for layer in wanted - self._heard.keys():
            self._edits.open(Slot(POINTS, layer), placed_in(layer))
            self._heard[layer] = Listening((layer.events.data, self._on_data))

    def _on_removed(self, event: Any) -> None:
        """The steps go with the layer, too."""
        if event.value in self._heard:
            self._heard.pop(event.value).release()

    def _on_data(self, event: Any) -> None:
        layer = event.source
        slot, now = Slot(POINTS, layer), placed_in(layer)
        before = self._edits.get(slot)
        if self._undoing or before is None:
            return
        # napari tells before and after; of a drag once before and then after every move.
        if now == before:
            before.look.update(now.look)
            return
        if self._edits.in_progress != slot or now.count != before.count:
            self._edits.begin(slot, before.change(now, layer.name))
        self._edits.update(now)
        if now.count == before.count or is_drawn(layer):
            self._resting.start()
        else:
            self._end()

    def _on_rest(self) -> None:
        drawn = any(is_drawn(layer) for layer in self._heard)
        if drawn or QApplication.mouseButtons() != Qt.MouseButton.NoButton:
            self._resting.start()
        else:
            self._end()

    def _end(self) -> None:
        """End a drag of ours, and nobody else's."""
        self._resting.stop()
        slot = self._edits.in_progress
        if isinstance(slot, Slot) and slot.what == POINTS:
            self._edits.end()

    def _on_undone(self, slot: Any, value: Any) -> None:
        if not isinstance(slot, Slot) or slot.what != POINTS or placed_in(slot.layer) == value:
            return
        self._undoing = True
        try:
            value.give_to(slot.layer)
        finally:
            self._undoing = False
