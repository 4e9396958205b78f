"""Undo and redo of all edits in a viewer, and their key bindings."""

from __future__ import annotations

import itertools
import weakref
from contextlib import ExitStack, suppress
from typing import Any, Literal

from napari.layers import Labels
from psygnal import Signal

from napari_hmrf.layers.compat import paint_steps, unwrapped
from napari_hmrf.layers.metadata import BOUNDARY, TISSUE, store_table
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.viewer_layers import layers_of, shared
from napari_hmrf.study.edit_history import Step
from napari_hmrf.study.session import Part, Session
from napari_hmrf.tissue.row_table import RowTable

#: Name of the method for each key. In napari, Ctrl+Y switches between the 2-D and the 3-D view.
KEYS = {"Control-Z": "undo", "Control-Shift-Z": "redo"}
# Counter of brush strokes in napari's Labels layers, common to all viewers.
_strokes = itertools.count(1)


class ViewerUndo:
    """Undo and redo for the `Session` of a viewer; `undo_of` returns the viewer's instance.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    session : Session
    message : Signal(str, object)
        Emitted after undo or redo, with a sentence for the user and the `Step`, or None if there
        was no step.
    """

    message = Signal(str, object)

    def __init__(self, viewer: Any) -> None:
        self.session = Session()
        self._layers = layers_of(viewer)
        self._viewer = self._layers.viewer
        # Docks that have bound the keys.
        self._owners: weakref.WeakSet[object] = weakref.WeakSet()
        # Stacks that unbind the keys of the viewer and of the active layer.
        self._keys, self._of_layer = ExitStack(), ExitStack()
        self.session.changed.connect(self._on_changed)
        viewer.layers.events.removed.connect(self._on_removed)

    def undo(self) -> None:
        """Undo the last step, and show its image and slice."""
        self._go("undo", "Undid")

    def redo(self) -> None:
        """Redo the most recently undone step, and show its image and slice."""
        self._go("redo", "Redid")

    def tooltips(self, image: Any = None) -> tuple[str, str]:
        """Return the tooltips of undo and redo, with the next step and the key.

        A step that changes another image than `image` is named with that image.
        """
        undo, redo = self.session.next_undo, self.session.next_redo
        first, second = self._tip("undo", undo, image), self._tip("redo", redo, image)
        return f"{first} (Ctrl+Z)", f"{second} (Ctrl+Shift+Z)"

    def bind_keys(self, owner: object) -> None:
        """Bind undo and redo to their keys.

        While a Labels layer is active, napari binds the same keys to its own undo of paint. These
        key bindings are replaced, and brush strokes in the layer are recorded as steps of the
        model.

        Parameters
        ----------
        owner : object
            Object that uses the keys. The keys remain bound until all owners have called
            `unbind_keys`.
        """
        bound = bool(self._owners)
        self._owners.add(owner)
        if bound:
            return
        self._keys.close()
        self._keys = self._bind(self._viewer)
        active = self._viewer.layers.selection.events.active
        active.connect(self._on_active)
        self._keys.callback(active.disconnect, self._on_active)
        self._keys.callback(lambda: self._of_layer.close())
        self._on_active()

    def unbind_keys(self, owner: object) -> None:
        """Remove an owner; if no owner is left, restore the key bindings of the viewer."""
        self._owners.discard(owner)
        if not self._owners:
            self._keys.close()

    def _bind(self, owner: Any) -> ExitStack:
        bound = ExitStack()
        for key, name in KEYS.items():
            with suppress(ValueError):  # the key is already bound by another plugin
                owner.bind_key(key, lambda _, name=name: getattr(self, name)())
                bound.callback(owner.bind_key, key, None)
        return bound

    def _on_active(self, *_: Any) -> None:
        self._of_layer.close()
        active = self._viewer.layers.selection.active
        # If napari's history of paint is not accessible, its key bindings are not replaced.
        if isinstance(active, Labels) and paint_steps(active, "undo") is not None:
            self._of_layer = self._bind(active)
            active.events.paint.connect(self._on_paint)
            self._of_layer.callback(active.events.paint.disconnect, self._on_paint)

    def _on_paint(self, event: Any) -> None:
        """Record a brush stroke in a Labels layer as a step."""
        part = Part("paint", event.source)
        self.session.setdefault(part, 0)
        # Use a global counter: with a counter per layer, a stroke after an undo would have the
        # number of the undone stroke.
        self.session.do(part, next(_strokes), f"painted in '{event.source.name}'")

    def _go(self, name: Literal["undo", "redo"], done: str) -> None:
        """Undo or redo a step, show its image, and report it; for paint, use napari's history."""
        layer, step = self._viewer.layers.selection.active, getattr(self.session, name)()
        if step is None and paint_steps(layer, name):  # painted before all steps
            self._repeat(layer, name)
            return
        if step is not None:
            part = step.part
            # napari stores at most 100 strokes, so the stroke may no longer be available.
            if part.kind == "paint" and paint_steps(part.layer, name):
                self._repeat(part.layer, name)
            self.select_image_of(part)
            self.go_to(part)
            done += self._of_image(part)
        sentence = f"There is nothing to {name}." if step is None else f"{done}: {step.word}."
        self.message.emit(sentence, step)

    def _repeat(self, layer: Any, name: str) -> None:
        """Undo or redo a stroke in a Labels layer, and show the layer, which may be hidden.

        napari does not report changes of hidden layers.
        """
        self._layers.want(layer)
        getattr(layer, name)()

    def _of_image(self, part: Part) -> str:
        """Return a phrase with the name of the image if several images were edited, or ""."""
        images = {
            each.layer for each in self.session.parts if each.kind == "drawing" and each.layer
        }
        image = self.session.image_of(part)
        return f" on '{image.name}'" if len(images) > 1 and image is not None else ""

    def _tip(self, what: str, step: Step | None, image: Any) -> str:
        if step is None:
            return f"Nothing to {what}"
        own = self.session.image_of(step.part)
        where = f" on '{own.name}'" if own is not None and own is not image else ""
        return f"{what.capitalize()}{where}: {step.word}"

    def select_image_of(self, part: Part) -> None:
        """Select the image that a part belongs to; Labels are deformed without an image."""
        image = self.session.image_of(part)
        if image is not None:
            self.session.select(None if isinstance(image, Labels) else image)

    def go_to(self, part: Part, turn: bool = False) -> None:
        """Show the slice of a part.

        Parameters
        ----------
        part : Part
        turn : bool
            If True, also change the displayed axes. If False, do nothing if other axes are
            displayed.
        """
        if len(part.plane) != 2:  # a volume is visible in every slice
            return
        dims, layer = self._viewer.dims, part.layer
        missing = dims.ndim - layer.ndim
        axes = tuple(axis + missing for axis in part.plane)
        if dims.ndisplay != 2 or axes != View.of(dims).displayed:
            if not turn:
                return
            dims.ndisplay = 2
            dims.order = (*(axis for axis in range(dims.ndim) if axis not in axes), *axes)
        there = View.of(dims).point_at(layer, part.index)
        dims.set_point([*there], [*there.values()])

    def _on_changed(self, part: Part, value: object) -> None:
        """Store a changed table in the metadata of its layer."""
        if isinstance(value, RowTable) and (part.kind == TISSUE or part.kind == BOUNDARY):
            store_table(value, part.layer, part.kind)

    def _on_removed(self, event: Any) -> None:
        self.session.remove(event.value)


def undo_of(viewer: Any) -> ViewerUndo:
    """Return the `ViewerUndo` of a viewer."""
    return shared(unwrapped(viewer), ViewerUndo)
