"""The keys of undo and redo in a viewer, and beside those that napari has for paint."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

from napari.layers import Labels

from napari_hmrf.layers.compat import paint_steps
from napari_hmrf.study.study_model import StudyModel

#: Keys, and what they do.
KEYS = {"Control-Z": "undo", "Control-Shift-Z": "redo", "Control-Y": "redo"}


class UndoKeys:
    """Have what was done last taken back, by the same keys for paint and for all else.

    napari binds them to paint wherever a Labels layer is the active one. There they take back
    paint unless an edit of ours came after it, or no paint is left.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    edits : StudyModel
        Ours.
    go : mapping of str to callable
        Ours, by "undo" and "redo".
    """

    def __init__(
        self,
        viewer: Any,
        edits: StudyModel,
        go: dict[str, Callable[[], None]],
    ) -> None:
        self._edits, self._go = edits, go
        self._bound: list[tuple[Any, str]] = []
        self._layer: weakref.ref[Any] | None = None
        #: Whether what was done last was an edit of ours.
        self._ours = False
        for key, name in KEYS.items():
            self._bind(viewer, key, name)
        edits.moved.connect(self._on_moved)
        self._viewer = weakref.ref(viewer)
        viewer.layers.selection.events.active.connect(self._on_active)
        self._on_active()

    def release(self) -> None:
        """Leave all keys as they were."""
        self._leave()
        self._edits.moved.disconnect(self._on_moved)
        viewer = self._viewer()
        if viewer is not None:
            viewer.layers.selection.events.active.disconnect(self._on_active)
        for owner, key in self._bound:
            owner.bind_key(key, None)
        self._bound.clear()

    def _bind(self, owner: Any, key: str, name: str) -> None:
        def answer(owner: Any) -> None:
            self._choose(owner, name)

        try:
            owner.bind_key(key, answer)
        except ValueError:  # somebody else's
            return
        self._bound.append((owner, key))

    def _on_active(self, *_: Any) -> None:
        viewer = self._viewer()
        active = None if viewer is None else viewer.layers.selection.active
        self._leave()
        # Without its history napari keeps the keys, and all is as it is without us.
        if not isinstance(active, Labels) or paint_steps(active, "undo") is None:
            return
        self._layer = weakref.ref(active)
        active.events.paint.connect(self._on_paint)
        for key, name in KEYS.items():
            self._bind(active, key, name)

    def _leave(self) -> None:
        """Let go of the layer that was the active one."""
        layer, self._layer = None if self._layer is None else self._layer(), None
        if layer is None:
            return
        layer.events.paint.disconnect(self._on_paint)
        for owner, key in self._bound:
            if owner is layer:
                layer.bind_key(key, None)
        self._bound = [each for each in self._bound if each[0] is not layer]

    def _choose(self, owner: Any, name: str) -> None:
        """Take back, or do again, what is ours, or a layer's paint."""
        step = self._edits.next_undo
        later = name == "undo" and self._ours and step is not None
        if paint_steps(owner, name) and not later:
            getattr(owner, name)()
        else:
            self._go[name]()

    def _on_moved(self) -> None:
        # Something new leaves nothing to be done again.
        self._ours = self._edits.next_undo is not None and self._edits.next_redo is None

    def _on_paint(self, *_: Any) -> None:
        self._ours = False
