"""Tables, curves and landmarks among the steps that are undone, by buttons and keys."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from napari.layers import Points, Shapes
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QApplication

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.compat import is_drawn
from napari_hmrf.layers.edit_history import CURVE, POINTS, Owner, Slot, ViewerSteps
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE
from napari_hmrf.layers.points_state import placed_in
from napari_hmrf.layers.table_state import Table, change
from napari_hmrf.tissue.stiffness_curve import StiffnessCurve
from napari_hmrf.ui.dock_form import DockForm
from napari_hmrf.ui.events import Listening, single_shot
from napari_hmrf.ui.footer import StepKeys
from napari_hmrf.ui.messages import WELCOME

#: How long points must rest until a drag of them is over, in milliseconds.
_REST = 200


class DockSteps:
    """Makes a step of each edit of what is chosen in a dock, and shows there what is undone.

    Whatever is edited is read as it is now; napari has no undo of points, or of lines.

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
        self._undoing = False
        # What was chosen when that was looked at last.
        self._known: set[Slot] = set()
        self._resting = single_shot(native, _REST, self._on_rest)
        tissue, boundary = form.tissue, form.motion.boundary
        for painted in (tissue.painted, boundary.painted):
            painted.changed.connect(lambda each=painted: self.note(each.by_itself))
        tissue.choice.changed.connect(lambda _: self.note())
        tissue.editor.plot.edited.connect(self._take_curve)
        tissue.editor.plot.settled.connect(lambda _: self._model.end())
        boundary.landmarks.edited.connect(lambda: self.note())
        buttons = form.footer.steps
        buttons.undo.changed.connect(steps.undo)
        buttons.redo.changed.connect(steps.redo)
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
        self._drop_points(set())

    def show(self) -> None:
        """Show what there is to take back, and to do again."""
        self._form.footer.steps.show(self._steps)

    def note(self, by_itself: bool = False) -> None:
        """Keep what is edited now; what comes `by_itself`, as rows for new paint do, is no step."""
        if self._undoing:
            return
        known, self._known = self._known, set()
        for slot, now in self._edited():
            self._known.add(slot)
            before = self._model.open(slot, now)
            if now == before:
                if slot.what == POINTS:
                    before.look.update(now.look)
            elif by_itself or slot not in known:
                self._model.amend(slot, now)
            else:
                self._step(slot, before, now)
        self._drop_points(self._known)

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

    def _edited(self) -> Iterator[tuple[Slot, Any]]:
        """What is chosen and can be edited, as it is now."""
        form = self._form
        for role, section in ((TISSUE, form.tissue), (BOUNDARY, form.motion.boundary)):
            if (layer := section.painted.layer) is not None:
                yield Slot(role, layer), Table.of(layer, role)
        for layer in form.motion.boundary.landmarks.layers:
            if isinstance(layer, Points | Shapes):
                yield Slot(POINTS, layer), placed_in(layer)

    def _step(self, slot: Slot, before: Any, now: Any) -> None:
        """Make a step, or go on with one: a drag is one, however many times napari tells of it."""
        model, layer = self._model, slot.layer
        if slot.what != POINTS:
            model.do(slot, now, change(before, now, layer.name))
            return
        counted = now.count != before.count
        if model.in_progress != slot or counted:
            model.begin(slot, before.change(now, layer.name))
        model.update(now)
        if counted and not is_drawn(layer):
            model.end()
        else:
            self._resting.start()

    def _drop_points(self, chosen: set[Slot]) -> None:
        """Forget points that are no landmarks: what is done to them from now on is not heard."""
        self._model.drop(
            lambda slot: isinstance(slot, Slot) and slot.what == POINTS and slot not in chosen
        )

    def _on_rest(self) -> None:
        slot = self._model.in_progress
        if not isinstance(slot, Slot) or slot.what != POINTS:
            return
        if _is_held() or is_drawn(slot.layer):
            self._resting.start()
        else:
            self._model.end()

    def _on_undone(self, slot: Any, value: Any, _: Any = None) -> None:
        """Put back what a slot holds: a table that is shown, a curve, or points."""
        if not isinstance(slot, Slot) or self._undoing:
            return
        self._undoing = True
        try:
            if slot == self._curve_slot:
                self._form.tissue.go_by(value)
            elif slot.what == POINTS and placed_in(slot.layer) != value:
                value.give_to(slot.layer)
            for section in (self._form.tissue, self._form.motion.boundary):
                if slot.what in (TISSUE, BOUNDARY) and section.painted.layer is slot.layer:
                    section.table.show(value)
        finally:
            self._undoing = False


def _is_held() -> bool:
    """Whether a button of the mouse is down."""
    return bool(QApplication.mouseButtons() != Qt.MouseButton.NoButton)
