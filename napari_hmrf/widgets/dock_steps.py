"""Undo and redo in the dock *Deform tissue*."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from napari_hmrf.layers.metadata import BOUNDARY, TISSUE
from napari_hmrf.layers.steps import DRAWING, Slot, ViewerSteps
from napari_hmrf.widgets.face import Face
from napari_hmrf.widgets.step_buttons import StepKeys
from napari_hmrf.widgets.table_steps import CurveSteps, TableSteps

if TYPE_CHECKING:
    from napari_hmrf.widgets.deform import DeformTissue


class DockSteps:
    """Has the tables and the curve of the dock undone, by its buttons and keys.

    Parameters
    ----------
    widget : DeformTissue
    face : Face
        Of the widget.
    steps : ViewerSteps
        Of the viewer.
    """

    def __init__(self, widget: DeformTissue, face: Face, steps: ViewerSteps) -> None:
        self._widget, self._buttons, self.steps = widget, face.footer.steps, steps
        tissue, boundary = face.tissue, face.boundary
        self._tables = (
            TableSteps(TISSUE, tissue.painted, tissue.table, steps),
            TableSteps(BOUNDARY, boundary.painted, boundary.table, steps),
        )
        self._curve = CurveSteps(tissue.curve, tissue.choice.choose, steps)
        tissue.choice.changed.connect(self._curve.look)
        self._buttons.undo.changed.connect(steps.undo)
        self._buttons.redo.changed.connect(steps.redo)
        steps.edits.moved.connect(self._show)
        steps.said.connect(self._on_said)
        StepKeys(widget.native, steps)
        self._show()

    def come(self) -> None:
        """The dock is there: have the keys."""
        self.steps.bind_keys(self)

    def leave(self) -> None:
        """The dock is gone."""
        self.steps.unbind_keys(self)

    def interrupt(self) -> bool:
        """Nothing here is ever half done."""
        return False

    def _show(self) -> None:
        if not self._widget.away:
            self._buttons.show(self.steps)

    def _on_said(self, sentence: str, slot: Any) -> None:
        if not (isinstance(slot, Slot) and slot.what == DRAWING) and not self._widget.away:
            self._widget.say(sentence)
