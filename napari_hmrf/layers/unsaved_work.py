"""Register of slices with unsaved edits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.study.study_model import Part


class UnsavedWork:
    """Register of slices with unsaved edits; `shared` returns the register of a viewer.

    Slices are identified by their drawings.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    paths : dict of Part to Path
        Path from which each slice was opened, or to which it was saved.
    saved_files : dict of Part to Path
        Path of the recovery file of each slice.
    """

    def __init__(self, viewer: Any) -> None:
        self._model = undo_of(viewer).model
        self._before: dict[Part, dict[Part, object]] = {}
        self.paths: dict[Part, Path] = {}
        self.saved_files: dict[Part, Path] = {}

    @property
    def slices(self) -> tuple[Part, ...]:
        """Slices with unsaved edits, identified by their drawings."""
        now = {part: self._model.get(part) for part in self._model.parts}
        return tuple(
            here
            for here, edited in self._before.items()
            if here in now and any(part in now and now[part] != edited[part] for part in edited)
        )

    def note(self, here: Part, part: Part | None = None, before: object = None) -> None:
        """Record an edit of a slice.

        Parameters
        ----------
        here : Part
            Drawing of the slice.
        part : Part, optional
            Edited part. If not given, the slice is considered unsaved even if all edits are undone.
        before : object
            Value of the part before the edit.
        """
        value = object() if part is None else before
        self._before.setdefault(here, {}).setdefault(part or here, value)

    def save(self, here: Part) -> None:
        """Record that the edits of a slice were saved or discarded."""
        self._before.pop(here, None)
