"""Edits of landmarks as steps that can be undone: napari has no undo of points."""

from __future__ import annotations

from typing import Any

from napari.layers import Points
from qtpy.QtCore import QObject, Qt
from qtpy.QtWidgets import QApplication

from napari_hmrf.layers.placed import Placed
from napari_hmrf.layers.steps import POINTS, Slot, ViewerSteps
from napari_hmrf.widgets.landmark_choice import LandmarkChoice
from napari_hmrf.widgets.listening import Listening
from napari_hmrf.widgets.timers import single_shot

#: How long points must rest until a drag of them is over, in milliseconds.
_REST = 200


class PointSteps:
    """Keeps what is done to points while they are landmarks, and puts back what is undone.

    A drag is one step, however many times napari tells of it.

    Parameters
    ----------
    landmarks : LandmarkChoice
    steps : ViewerSteps
    parent : QObject
        With which this ends.
    """

    def __init__(self, landmarks: LandmarkChoice, steps: ViewerSteps, parent: QObject) -> None:
        self._landmarks, self._edits = landmarks, steps.edits
        self._layers: tuple[Any, ...] = ()
        self._listening = Listening()
        self._undoing = False
        self._resting = single_shot(parent, _REST, self._on_rest)
        landmarks.edited.connect(self.look)
        self._edits.changed.connect(self._on_undone)
        self.look()

    def look(self) -> None:
        """Listen to the layers that are chosen, and to no others."""
        layers = tuple(each for each in self._landmarks.layers if isinstance(each, Points))
        if [id(layer) for layer in layers] == [id(layer) for layer in self._layers]:
            return
        self.release()
        self._layers = layers
        for layer in layers:
            slot, now = Slot(POINTS, layer), Placed.of(layer)
            if self._edits.open(slot, now) != now:
                self._edits.amend(slot, now)
        self._listening = Listening(*((layer.events.data, self._on_data) for layer in layers))

    def release(self) -> None:
        """Listen to no layer."""
        self._end()
        self._listening.release()
        self._layers = ()

    def _on_data(self, event: Any) -> None:
        layer = event.source
        slot, now = Slot(POINTS, layer), Placed.of(layer)
        before = self._edits.get(slot)
        if self._undoing or before is None:
            return
        # napari tells before and after; of a drag once before and then after every move.
        if now == before:
            before.look.update(now.look)
            return
        if self._edits.in_progress != slot or now.shape != before.shape:
            self._edits.begin(slot, before.change(now, layer.name))
        self._edits.update(now)
        if now.shape == before.shape:
            self._resting.start()
        else:
            self._end()

    def _on_rest(self) -> None:
        if QApplication.mouseButtons() != Qt.MouseButton.NoButton:
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
        if not isinstance(slot, Slot) or slot.what != POINTS or Placed.of(slot.layer) == value:
            return
        self._undoing = True
        try:
            value.give_to(slot.layer)
        finally:
            self._undoing = False
