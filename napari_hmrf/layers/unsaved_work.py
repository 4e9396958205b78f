"""What was done in a viewer since it was saved last, slice by slice, as a study is of a slice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from napari_hmrf.layers.edit_history import Slot, steps_of


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
        there = self._edits.slots
        return tuple(
            here
            for here, edited in self._before.items()
            if here in there
            and any(
                slot in there and self._edits.get(slot) != held for slot, held in edited.items()
            )
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
