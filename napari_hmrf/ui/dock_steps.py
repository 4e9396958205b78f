"""Tables, curves and choices among the steps that are undone, by buttons and keys."""

from __future__ import annotations

from typing import Any

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.edit_history import CHOICE, CURVE, DRAWING, MODEL, Owner, Slot, ViewerSteps
from napari_hmrf.layers.metadata import change
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.events import Listening
from napari_hmrf.ui.footer import StepKeys
from napari_hmrf.ui.messages import WELCOME
from napari_hmrf.ui.tissue_form import BRIGHTNESS

#: Of the viewer, and no layer.
_THE_MODEL = Slot(MODEL, "")


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
        # Whether something is put back, which is no step.
        self._going = False
        for table in form.tables:
            table.changed.connect(self.note)
        for choice in (form.image, tissue.choice, form.model, form.model.in_detail):
            choice.changed.connect(self.note, max_args=0)
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
        for slot, now in () if self._going else self._edited:
            if slot.layer is None or now == (before := self._model.open(slot, now)):
                continue
            word = "" if by_itself else _step(slot, before, now)
            if word:
                self._model.do(slot, now, word)
            else:
                self._model.amend(slot, now)

    @property
    def _edited(self) -> list[tuple[Slot, Any]]:
        form = self._form
        tables = [(Slot(table.role, table.layer), table.contents) for table in form.tables]
        choice = Slot(CHOICE, form.image.value), form.tissue.choice.value
        return [*tables, choice, (_THE_MODEL, form.model.values)]

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
        known = model.open(slot, curve)
        if self.curve is None:
            self._form.tissue.go_by(known)
        if known != curve:
            if model.in_progress != slot:
                model.begin(slot, f"changed the curve of '{slot.layer.name}'")
            model.update(curve)

    @property
    def _curve_slot(self) -> Slot:
        return Slot(CURVE, self._form.image.value)

    def _on_undone(self, slot: Any, value: Any, _: Any = None) -> None:
        """Put back what is shown of it here, and choose the image it is of."""
        form, tissue = self._form, self._form.tissue
        if slot.what == DRAWING and slot.layer is form.image.value:
            return
        going, self._going = self._going, True
        if slot.what in (DRAWING, CHOICE) and slot.layer in form.image.offered:
            form.image.value = slot.layer
        if slot == _THE_MODEL:
            form.model.values = value
        elif slot.what == CHOICE:
            tissue.choice.value = value if value in tissue.choice.choices else None
        elif slot == self._curve_slot:
            tissue.go_by(value)
        for table in form.tables:
            if slot == Slot(table.role, table.layer):
                table.contents = value
        self._going = going
        self.note(by_itself=True)


def _step(slot: Slot, before: Any, now: Any) -> str:
    """What was done, in words; "" if it is no step."""
    if slot == _THE_MODEL:
        same = all(before[name] == now[name] for name in ("model", "plane"))
        return "" if same else "chose another model"
    if slot.what == CHOICE:
        return "chose what says how stiff tissue is" if BRIGHTNESS in (before, now) else ""
    return change(before, now, slot.layer.name)
