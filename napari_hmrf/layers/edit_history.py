"""All edits of ours in a viewer, in the order they were made: undo, redo, their keys, and files.

What was edited since it was saved last is known slice by slice, as a study is of a slice.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, NamedTuple

from napari.layers import Labels
from psygnal import Signal

from napari_hmrf.field.frame import SlicePlace
from napari_hmrf.layers.compat import paint_steps, unwrapped
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.viewer_layers import shared
from napari_hmrf.study.study_model import Step, StudyModel

#: Keys, and what they do.
KEYS = {"Control-Z": "undo", "Control-Shift-Z": "redo", "Control-Y": "redo"}
#: What a slot with a drawing is called; those with tables are called by the role of their layer.
DRAWING = "drawing"
#: And that with the curve by which an image's intensity says how stiff tissue is.
CURVE = "curve"
#: And that with what says so: a layer, or its brightness.
CHOICE = "choice"
#: And that of a viewer with what tissue is taken to be.
MODEL = "model"
#: And that with the number of strokes that napari's brush has painted in a layer.
PAINT = "paint"


class Slot(NamedTuple):
    """Something of a layer that is edited.

    Attributes
    ----------
    what : str
        `DRAWING`, or "tissue" or "boundary" for the layer's table, or whatever else there will be.
    layer : napari.layers.Layer
        With it goes all that is edited of it.
    place : SlicePlace, optional
        Of a drawing, and of what was painted in a slice at once.
    """

    what: str
    layer: Any
    place: SlicePlace | None = None


class ViewerSteps:
    """The steps of a viewer; have them from `steps_of`.

    To have something else undone, open a `Slot` in `edits`, do steps, and show what
    `edits.changed` brings back. Values must not change once they are given.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    edits : StudyModel
        By `Slot`.
    said : Signal(str, object)
        What was taken back or done again, in words, and the `Step`, or None if there was none.
    """

    said = Signal(str, object)

    def __init__(self, viewer: Any) -> None:
        self.edits = StudyModel()
        self._viewer = weakref.proxy(viewer)
        # Who has the keys, as long as it is kept anywhere.
        self._owner: Callable[[], Any] = lambda: None
        # What is done to leave the keys, of all layers and of the active one, as they were.
        self._keys, self._of_layer = ExitStack(), ExitStack()
        self.edits.changed.connect(self._on_changed)
        viewer.layers.events.removed.connect(self._on_removed)

    def undo(self) -> None:
        """Take back what was done last, and go to where that was."""
        if not self._before_us("undo", self.edits.next_undo):
            self._tell("undo", "Took back", self.edits.undo(), "There is nothing to take back.")

    def redo(self) -> None:
        """Do again what was taken back last, and go to where that is."""
        if not self._before_us("redo", self.edits.next_redo):
            self._tell("redo", "Did again", self.edits.redo(), "There is nothing to do again.")

    @property
    def tooltips(self) -> tuple[str, str]:
        """What `undo` and `redo` would do, for their buttons; each ends with its key."""
        undo, redo = self.edits.next_undo, self.edits.next_redo
        return f"{_tip('take back', undo)} (Ctrl+Z)", f"{_tip('do again', redo)} (Ctrl+Shift+Z)"

    def bind_keys(self, owner: Any) -> None:
        """Undo and redo by keys, wherever no layer has others for them.

        napari binds them to paint wherever a Labels layer is the active one; there its strokes
        become steps of ours.

        Parameters
        ----------
        owner : object
            Who has the keys from now on, in place of who had them before.
        """
        self._keys.close()
        self._owner = weakref.ref(owner)
        self._keys = self._bind(self._viewer)
        active = self._viewer.layers.selection.events.active
        active.connect(self._on_active)
        self._keys.callback(active.disconnect, self._on_active)
        self._keys.callback(lambda: self._of_layer.close())
        self._on_active()

    def unbind_keys(self, owner: Any) -> None:
        """Leave the viewer's keys as they were, unless somebody else has them by now."""
        if self._owner() is owner:
            self._keys.close()

    def _bind(self, owner: Any) -> ExitStack:
        bound = ExitStack()
        for key, name in KEYS.items():
            with suppress(ValueError):  # somebody else's
                owner.bind_key(key, lambda _, name=name: getattr(self, name)())
                bound.callback(owner.bind_key, key, None)
        return bound

    def _on_active(self, *_: Any) -> None:
        self._of_layer.close()
        active = self._viewer.layers.selection.active
        # Without its history napari keeps the keys, and all is as it is without us.
        if isinstance(active, Labels) and paint_steps(active, "undo") is not None:
            self._of_layer = self._bind(active)
            active.events.paint.connect(self._on_paint)
            self._of_layer.callback(active.events.paint.disconnect, self._on_paint)

    def _on_paint(self, event: Any) -> None:
        """Have a stroke of napari's brush be a step among the others."""
        slot = Slot(PAINT, event.source)
        strokes = self.edits.open(slot, 0)
        self.edits.do(slot, strokes + 1, f"painted in '{event.source.name}'")

    def _before_us(self, name: str, step: Step | None) -> bool:
        """Take back, or do again, paint of the active layer that was there before anybody asked."""
        layer = self._viewer.layers.selection.active
        known = step is None and bool(paint_steps(layer, name))
        if known:
            getattr(layer, name)()
        return known

    def _tell(self, name: str, what: str, step: Step | None, nothing: str) -> None:
        """Show and say what was taken back or done again; paint napari has to."""
        if step is not None:
            slot: Any = step.slot
            if slot.what == PAINT and paint_steps(slot.layer, name):  # it keeps a hundred at most
                getattr(slot.layer, name)()
            self.go_to(slot)
            what += self._of_image(slot)
        self.said.emit(nothing if step is None else f"{what}: {step.word}.", step)

    def _of_image(self, slot: Any) -> str:
        """Say of which image something is, where several were worked on."""
        images = {each.layer for each in self.edits.slots if each.what == DRAWING}
        said = len(images) > 1 and slot.what in (DRAWING, CHOICE)
        return f" on '{slot.layer.name}'" if said else ""

    def go_to(self, slot: Any, turn: bool = False) -> None:
        """Show the slice that something was drawn on; only with `turn` if other axes are shown."""
        if slot.place is None or len(slot.place.plane) == 3:  # a volume is in each of its slices
            return
        plane, index = slot.place.plane, slot.place.index
        dims, layer = self._viewer.dims, slot.layer
        missing = dims.ndim - layer.ndim
        axes = tuple(axis + missing for axis in plane)
        if dims.ndisplay != 2 or axes != View.of(dims).displayed:
            if not turn:
                return
            dims.ndisplay = 2
            dims.order = (*(axis for axis in range(dims.ndim) if axis not in axes), *axes)
        there = View.of(dims).point_at(layer, index)
        dims.set_point([*there], [*there.values()])

    def _on_changed(self, slot: Any, value: Any) -> None:
        """Have the layer carry its table; whoever shows it listens for itself."""
        if slot.what in (TISSUE, BOUNDARY):
            value.give_to(slot.layer, slot.what)

    def _on_removed(self, event: Any) -> None:
        gone = event.value
        self.edits.drop(lambda slot: slot.layer is gone)


def _tip(what: str, step: Step | None) -> str:
    return f"Nothing to {what}" if step is None else f"{what.capitalize()}: {step.word}"


def steps_of(viewer: Any) -> ViewerSteps:
    """The steps of a viewer; the same ones for all that edit in it."""
    return shared(unwrapped(viewer), ViewerSteps)


class UnsavedWork:
    """Knows which slices no file holds as they are; of a viewer there is one (`shared`).

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    paths : dict of Slot to Path
        The file that holds a slice as it was, of those that were saved or opened.
    kept : dict of Slot to Path
        The file that a slice is kept in against a crash.
    """

    def __init__(self, viewer: Any) -> None:
        self._edits = steps_of(viewer).edits
        self._before: dict[Slot, dict[Slot, Any]] = {}
        self.paths: dict[Slot, Path] = {}
        self.kept: dict[Slot, Path] = {}

    @property
    def slices(self) -> tuple[Slot, ...]:
        """The drawings of the slices on which something is other than in any file."""
        now = {slot: self._edits.get(slot) for slot in self._edits.slots}
        return tuple(
            here
            for here, edited in self._before.items()
            if here in now and any(slot in now and now[slot] != edited[slot] for slot in edited)
        )

    def note(self, here: Slot, slot: Slot | None = None, before: Any = None) -> None:
        """Something is edited on a slice.

        Parameters
        ----------
        here : Slot
            The drawing of the slice.
        slot : Slot, optional
            What is edited; without, the slice is unsaved until it is saved, whatever is taken back.
        before : object
            What that held.
        """
        held = object() if slot is None else before
        self._before.setdefault(here, {}).setdefault(slot or here, held)

    def save(self, here: Slot) -> None:
        """A slice is in a file as it is now, or is not wanted any more."""
        self._before.pop(here, None)
