"""Tables, the curve and landmarks among the steps that are undone, by buttons and keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from napari_hmrf.layers.edit_history import CURVE, Owner, Slot, ViewerSteps
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, Role
from napari_hmrf.layers.table_state import Table, change
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.event_wait import Listening
from napari_hmrf.ui.label_sync import PaintedLabels
from napari_hmrf.ui.point_steps import PointSteps
from napari_hmrf.ui.step_buttons import StepKeys


class DockSteps:
    """Makes a step of each edit in a dock, and shows there what is undone.

    Parameters
    ----------
    native : QWidget
        The dock.
    form : DockForm
        Of the dock.
    steps : ViewerSteps
    points : PointSteps
        Of the viewer, both.
    owner : Owner
        Who may be in the middle of something.
    away : callable
        Whether the dock is closed, or gone.
    """

    def __init__(
        self,
        native: Any,
        form: DockForm,
        steps: ViewerSteps,
        points: PointSteps,
        owner: Owner,
        away: Callable[[], bool],
    ) -> None:
        self._form, self._steps, self._points, self._owner = form, steps, points, owner
        self._away = away
        self._edits = steps.edits
        self._undoing = False
        # Whose table was looked at last.
        self._layers: dict[Role, Any] = {}
        tissue, boundary = form.tissue, form.motion.boundary
        self._painted: dict[Role, PaintedLabels] = {
            TISSUE: tissue.painted,
            BOUNDARY: boundary.painted,
        }
        tissue.painted.changed.connect(lambda: self._on_table(TISSUE))
        boundary.painted.changed.connect(lambda: self._on_table(BOUNDARY))
        tissue.curve.changed.connect(lambda _: self._open_curve())
        tissue.choice.changed.connect(lambda _: self._open_curve())
        tissue.curve.settled.connect(self._on_curve)
        boundary.landmarks.edited.connect(self._on_landmarks)
        buttons = form.footer.steps
        buttons.undo.changed.connect(steps.undo)
        buttons.redo.changed.connect(steps.redo)
        StepKeys(native, steps)
        self._heard = Listening()
        self.come()

    def come(self) -> None:
        """The dock is there: have the keys."""
        self._heard.release()
        self._heard = Listening(
            (self._edits.changed, self._on_undone), (self._edits.moved, self.show)
        )
        self._steps.bind_keys(self._owner)
        for role in self._painted:
            self._on_table(role)
        self._open_curve()
        curve = self._form.tissue.curve
        if curve.layer is not None:  # it may have been undone while there was no dock
            slot = Slot(CURVE, curve.layer)
            self._on_undone(slot, self._edits.get(slot))
        self._on_landmarks()
        self.show()

    def leave(self, over: bool) -> None:
        """The dock is closed, or its window is over."""
        self._steps.unbind_keys(self._owner)
        self._heard.release()
        # Where a process ends, the timers of what all docks share are gone before its windows.
        if not over:
            self._points.listen(self, ())

    def show(self) -> None:
        """Show what there is to take back, and to do again."""
        if not self._away():
            self._form.footer.steps.show(self._steps)

    def _on_table(self, role: Role) -> None:
        """Keep what is done to a table; rows that come by themselves are no steps."""
        painted = self._painted[role]
        layer = painted.layer
        other, self._layers[role] = layer is not self._layers.get(role), layer
        if layer is None:
            return
        slot, now = Slot(role, layer), Table.of(layer, role)
        before = self._edits.open(slot, now)
        if now == before:
            return
        if other or painted.by_itself:
            self._edits.amend(slot, now)
        else:
            self._edits.do(slot, now, change(before, now, layer.name))

    def _open_curve(self) -> None:
        curve = self._form.tissue.curve
        if curve.layer is not None:
            self._edits.open(Slot(CURVE, curve.layer), curve.curve)

    def _on_curve(self, now: Any) -> None:
        layer = self._form.tissue.curve.layer
        if layer is not None and not self._undoing:
            self._open_curve()
            self._edits.do(Slot(CURVE, layer), now, f"changed the curve of '{layer.name}'")

    def _on_landmarks(self) -> None:
        if not self._away():
            self._points.listen(self, self._form.motion.boundary.landmarks.layers)

    def _on_undone(self, slot: Any, value: Any, _: Any = None) -> None:
        """Show what a slot holds, if it is a table that is shown, or a curve."""
        if not isinstance(slot, Slot) or self._undoing:
            return
        self._undoing = True
        try:
            if slot.what == CURVE:
                self._show_curve(slot.layer, value)
            elif slot.what in (TISSUE, BOUNDARY):
                section = self._form.tissue if slot.what == TISSUE else self._form.motion.boundary
                if section.painted.layer is slot.layer:
                    section.table.show(value)
        finally:
            self._undoing = False

    def _show_curve(self, layer: Any, value: Any) -> None:
        curve = self._form.tissue.curve
        if curve.layer is not layer:
            self._form.tissue.choice.value = layer
        if curve.layer is layer and curve.curve != value:
            curve.curve = value
