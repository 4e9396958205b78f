"""Undo and redo in the dock *Deform tissue*."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from napari_hmrf.layers.edit_history import DRAWING, Slot, ViewerSteps
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE
from napari_hmrf.ui.deform_form import Face
from napari_hmrf.ui.dock_life import Life
from napari_hmrf.ui.event_wait import Listening
from napari_hmrf.ui.point_steps import PointSteps
from napari_hmrf.ui.table_steps import CurveSteps, TableSteps

#: Whose drawings are taken back here, too.
_GRAB = "in 'Grab and pull'"


class AskedHere:
    """The steps of a viewer, as the buttons and keys of one dock have them go back and forth.

    Whatever dock a step was made in, the one it was taken back in says so.

    Parameters
    ----------
    steps : ViewerSteps
    say : callable
        Called with what was done.
    """

    def __init__(self, steps: ViewerSteps, say: Callable[[str], None]) -> None:
        self._steps, self._say = steps, say
        self.edits = steps.edits

    def undo(self) -> None:
        """Take back what was done last."""
        self._ask(self._steps.undo)

    def redo(self) -> None:
        """Do again what was taken back."""
        self._ask(self._steps.redo)

    def _ask(self, go: Callable[[], None]) -> None:
        said: list[tuple[str, Any]] = []

        def hear(sentence: str, slot: Any) -> None:
            said.append((sentence, slot))

        self._steps.said.connect(hear)
        try:
            go()
        finally:
            self._steps.said.disconnect(hear)
        if not said:
            self._say(f"Took back what was half done, {_GRAB}.")
        elif _is_drawing(said[-1][1]):
            self._say(_drawn(said[-1][0]))


class DockSteps:
    """Has the tables, the curve and the landmarks of the dock undone, by its buttons and keys.

    Parameters
    ----------
    face : Face
        Of the dock.
    steps : ViewerSteps
    points : PointSteps
        Of the viewer, both.
    life : Life
        Of the dock.
    say : callable
        Called with what was done.
    """

    def __init__(
        self,
        face: Face,
        steps: ViewerSteps,
        points: PointSteps,
        life: Life,
        say: Callable[[str], None],
    ) -> None:
        self._buttons, self._steps, self._life, self._say = face.footer.steps, steps, life, say
        self.steps = AskedHere(steps, say)
        tissue, boundary = face.tissue, face.boundary
        self._tables = (
            TableSteps(TISSUE, tissue.painted, tissue.table, steps),
            TableSteps(BOUNDARY, boundary.painted, boundary.table, steps),
        )
        self._curve = CurveSteps(tissue.curve, partial(setattr, tissue.choice, "value"), steps)
        tissue.choice.changed.connect(self._curve.look)
        self._landmarks = boundary.landmarks
        self._points = points
        self._landmarks.edited.connect(self._on_landmarks)
        self._on_landmarks()
        self._buttons.undo.changed.connect(self.steps.undo)
        self._buttons.redo.changed.connect(self.steps.redo)
        steps.edits.moved.connect(self._show)
        steps.said.connect(self._on_said)
        self._listening = Listening()
        self._listen()
        self._show()

    def come(self) -> None:
        """The dock is there: have the keys."""
        self._steps.bind_keys(self)
        self._listen()
        self._curve.catch_up()
        self._on_landmarks()

    def leave(self) -> None:
        """The dock is gone."""
        self._steps.unbind_keys(self)
        self._listening.release()
        self._curve.leave()
        # Where a process ends, the timers of what all docks share are gone before its windows.
        if not self._life.over:
            self._points.listen(self, ())

    def interrupt(self) -> bool:
        """Nothing here is ever half done."""
        return False

    def _listen(self) -> None:
        """Show what is undone; a dock that is closed leaves that to the others."""
        self._listening.release()
        changed = self._steps.edits.changed
        shown = (*self._tables, self._curve)
        self._listening = Listening(*((changed, each.show) for each in shown))

    def _on_landmarks(self) -> None:
        if not self._life.away:
            self._points.listen(self, self._landmarks.layers)

    def _show(self) -> None:
        if not self._life.away:
            self._buttons.show(self._steps)

    def _on_said(self, sentence: str, slot: Any) -> None:
        if self._life.away:
            return
        if not _is_drawing(slot):
            self._say(sentence)
        elif not self._buttons.undo.native.visibleRegion().isEmpty():  # a tab in front
            self._say(_drawn(sentence))


def _drawn(sentence: str) -> str:
    return f"{sentence.rstrip('.')}, {_GRAB}."


def _is_drawing(slot: Any) -> bool:
    return isinstance(slot, Slot) and slot.what == DRAWING
