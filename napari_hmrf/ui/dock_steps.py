"""Tables, curves and choices among the steps that are undone, by buttons and keys."""

from __future__ import annotations

from functools import partial
from typing import Any

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.edit_history import CHOICE, CURVE, DRAWING, MODEL, Slot, ViewerSteps
from napari_hmrf.layers.metadata import change
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.choices import Choices
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.events import Listening
from napari_hmrf.ui.messages import WELCOME

#: Of the viewer, and no layer.
_THE_MODEL = Slot(MODEL, "")
#: What is done to the model and to the choices of an image, in words; the first that differs says
#: it, and how it is solved in detail is no step.
_WORDS = {
    "model": "chose another model",
    "plane": "chose another plane",
    "poisson": "changed Poisson's ratio",
    "tissue": "chose what says how stiff tissue is",
    "boundary": "chose another boundary",
    "confidence": "chose what says how sure the boundary is",
    "border": "changed whether the dark border is tissue",
    "edge": "changed whether the edge is held",
    "extent": "changed between slice and volume",
}


class DockSteps:
    """Makes a step of each edit of what is chosen in a dock, and shows there what is undone.

    Whatever is edited is read as it is now.

    Parameters
    ----------
    form : DockForm
        Of the dock.
    choices : Choices
        Likewise.
    steps : ViewerSteps
        Of the viewer.
    """

    def __init__(self, form: DockForm, choices: Choices, steps: ViewerSteps) -> None:
        self._form, self._choices, self._steps = form, choices, steps
        self._model = steps.edits
        form.model.values = self._model.get(_THE_MODEL, {})  # of a dock that was closed
        for table in form.tables:
            table.changed.connect(lambda by_itself: self._keep(self._tables, by_itself))
        fields = (form.image, *choices.fields.values(), form.model, form.model.in_detail)
        for field in fields:
            field.changed.connect(self.note, max_args=0)
        choices.settled.connect(partial(self.note, by_itself=True))
        form.tissue.editor.plot.edited.connect(self._take_curve)
        form.tissue.editor.plot.settled.connect(self._model.end)
        form.footer.undo.changed.connect(lambda _: steps.undo())
        form.footer.redo.changed.connect(lambda _: steps.redo())
        self._heard = Listening(
            (self._model.changed, self._on_undone), (self._model.moved, self.show)
        )
        steps.bind_keys(self)
        self.note(by_itself=True)
        self.show()

    def release(self) -> None:
        """The dock is closed, or its window is gone."""
        self._steps.unbind_keys(self)
        self._heard.release()

    def show(self) -> None:
        """Show what there is to take back, and to do again."""
        self._form.footer.show_steps(self._steps)

    def note(self, by_itself: bool = False) -> None:
        """Keep what is edited now; what comes `by_itself` is no step."""
        choice = Slot(CHOICE, self._form.image.value), self._choices.values
        model = _THE_MODEL, self._form.model.values
        self._keep([*self._tables, choice, model], by_itself)

    def _keep(self, edited: list[tuple[Slot, Any]], by_itself: bool) -> None:
        for slot, now in () if self._choices.by_itself else edited:
            if slot.layer is None or now == (before := self._model.open(slot, now)):
                continue
            word = "" if by_itself else _step(slot, before, now)
            if word:
                self._model.do(slot, now, word)
            else:
                self._model.amend(slot, now)

    @property
    def _tables(self) -> list[tuple[Slot, Any]]:
        return [(Slot(each.role, each.layer), each.contents) for each in self._form.tables]

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
        form = self._form
        if slot.what == DRAWING and slot.layer is form.image.value:
            return
        with self._choices.nobody_chooses():
            if slot.what in (DRAWING, CHOICE) and slot.layer in form.image.offered:
                form.image.value = slot.layer
            if slot == _THE_MODEL:
                form.model.values = value
            elif slot.what == CHOICE:
                self._choices.values = value
            elif slot == self._curve_slot:
                form.tissue.go_by(value)
            for table in form.tables:
                if slot == Slot(table.role, table.layer):
                    table.contents = value


def _step(slot: Slot, before: Any, now: Any) -> str:
    """What was done, in words; "" if it is no step."""
    if slot.what in (MODEL, CHOICE):
        changed = [name for name in now if before[name] != now[name]]
        return next((word for name, word in _WORDS.items() if name in changed), "")
    return change(before, now, slot.layer.name)
