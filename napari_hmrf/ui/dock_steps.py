"""Tables and curves among the steps that are undone, by buttons and keys."""

from __future__ import annotations

from typing import Any

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.edit_history import CURVE, DRAWING, Owner, Slot, ViewerSteps
from napari_hmrf.layers.metadata import change
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.events import Listening
from napari_hmrf.ui.footer import StepKeys
from napari_hmrf.ui.messages import WELCOME


class DockSteps:
    """Makes a step of each edit of what is chosen in a dock, and shows there what is undone.

    Whatever is edited is read as it is now.

    Parameters
    ----------
    native : QWidget
        The dock.
    form : DockForm
        Of the dock.
    steps : ViewerSteps
        Of the viewer.
    owner : Owner
        Who may be in the middle of something.
    """

    def __init__(self, native: Any, form: DockForm, steps: ViewerSteps, owner: Owner) -> None:
        self._form, self._steps, self._owner = form, steps, owner
        self._model = steps.edits
        tissue = form.tissue
        self._tables = (tissue.table, form.motion.boundary.table)
        for table in self._tables:
            table.changed.connect(self.note)
        tissue.editor.plot.edited.connect(self._take_curve)
        tissue.editor.plot.settled.connect(lambda _: self._model.end())
        form.footer.undo.changed.connect(lambda _: steps.choose("undo"))
        form.footer.redo.changed.connect(lambda _: steps.choose("redo"))
        StepKeys(native, steps)
        self._heard = Listening(
            (self._model.changed, self._on_undone), (self._model.moved, self.show)
        )
        steps.bind_keys(owner)
        self.note()
        self.show()

    def release(self) -> None:
        """The dock is closed, or its window is gone."""
        self._steps.unbind_keys(self._owner)
        self._heard.release()

    def show(self) -> None:
        """Show what there is to take back, and to do again."""
        self._form.footer.show_steps(self._steps)

    def note(self, by_itself: bool = False) -> None:
        """Keep what is edited now; what comes `by_itself`, as rows for new paint do, is no step."""
        for table in self._tables:
            slot, now = Slot(table.role, table.layer), table.contents
            if slot.layer is None or now == (before := self._model.open(slot, now)):
                continue
            if by_itself:
                self._model.amend(slot, now)
            else:
                self._model.do(slot, now, change(before, now, slot.layer.name))

    @property
    def curve(self) -> StiffnessCurve | None:
        """The curve by which the image's brightness is its tissue, if it is; to be set, too."""
        return self._form.tissue.curve

    @curve.setter
    def curve(self, curve: StiffnessCurve | None) -> None:
        if curve is not None:
            self._take_curve(curve)
            self._model.end()
        elif self.curve is not None:
            self._form.tissue.choice.value = None

    def _take_curve(self, curve: StiffnessCurve) -> None:
        """Have the image go by a curve: its first, or a step that is not over yet."""
        slot, model = self._curve_slot, self._model
        if slot.layer is None:
            raise HmrfError(WELCOME)
        if model.open(slot, curve) != curve:
            if model.in_progress != slot:
                model.begin(slot, f"changed the curve of '{slot.layer.name}'")
            model.update(curve)
        else:
            self._form.tissue.go_by(curve)

    @property
    def _curve_slot(self) -> Slot:
        return Slot(CURVE, self._form.image.value)

    def _on_undone(self, slot: Any, value: Any, _: Any = None) -> None:
        """Put back a table that is shown, or a curve; and choose the image that is drawn on."""
        if slot.what == DRAWING and slot.layer in self._form.image.offered:
            self._form.image.value = slot.layer
        if slot == self._curve_slot:
            self._form.tissue.go_by(value)
        for table in self._tables:
            if slot == Slot(table.role, table.layer):
                table.contents = value
