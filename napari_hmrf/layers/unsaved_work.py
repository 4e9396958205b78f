"""Register of the slices with unsaved edits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from napari_hmrf.layers.viewer_undo import undo_of
from napari_hmrf.study.study_model import Part


class UnsavedWork:
    """Register of the slices with edits that no file holds; `shared` returns that of a viewer.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel

    Attributes
    ----------
    paths : dict of Part to Path
        File from which a slice was opened, or to which it was saved.
    kept : dict of Part to Path
        Recovery file of a slice.
    """

    def __init__(self, viewer: Any) -> None:
        self._model = undo_of(viewer).model
        self._before: dict[Part, dict[Part, object]] = {}
        self.paths: dict[Part, Path] = {}
        self.kept: dict[Part, Path] = {}

    @property
    def slices(self) -> tuple[Part, ...]:
        """Drawings of the slices with edits that no file holds."""
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
            The edited part; without it, the slice stays unsaved even if its edits are undone.
        before : object
            Earlier value of the part.
        """
        held = object() if part is None else before
        self._before.setdefault(here, {}).setdefault(part or here, held)

    def save(self, here: Part) -> None:
        """Record that a file holds the slice, or that it is discarded."""
        self._before.pop(here, None)
