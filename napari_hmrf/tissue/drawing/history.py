"""Going back and forth between drawings."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

from psygnal import Signal

from napari_hmrf.tissue.drawing.drawing import Drawing
from napari_hmrf.tissue.drawing.edits import DEPTH, Edits


class History:
    """A drawing as it is now, among all that is edited in turn.

    Drawings do not change, so that what comes back is exactly what was there.

    Parameters
    ----------
    drawing : Drawing, optional
        To begin with.
    depth : int
        How many steps are kept; the oldest are forgotten.
    edits : Edits, optional
        The steps of all that is edited; by default the drawing is all.
    slot : hashable
        The drawing's own, among them.

    Attributes
    ----------
    changed : Signal(Drawing)
        Emitted with the drawing whenever it is another.
    """

    changed = Signal(Drawing)

    def __init__(
        self,
        drawing: Drawing | None = None,
        depth: int = DEPTH,
        edits: Edits | None = None,
        slot: Hashable = "drawing",
    ) -> None:
        self.edits = Edits(depth) if edits is None else edits
        self.slot = slot
        self._first = drawing or Drawing()
        self.edits.open(slot, self._first)
        self.edits.changed.connect(self._on_changed)

    @property
    def drawing(self) -> Drawing:
        """As it is now, an edit in progress included."""
        drawing: Drawing = self.edits.get(self.slot, self._first)
        return drawing

    @property
    def in_progress(self) -> bool:
        """Whether an edit of this drawing was begun and not ended."""
        return self.slot in self.edits and self.edits.in_progress == self.slot

    @property
    def undo_word(self) -> str:
        """What `undo` would take back, such as "moved an arrow"; empty if nothing."""
        step = self.edits.next_undo
        return step.word if step is not None else ""

    @property
    def redo_word(self) -> str:
        """What `redo` would do again; empty if nothing."""
        step = self.edits.next_redo
        return step.word if step is not None else ""

    def do(self, drawing: Drawing, word: str) -> None:
        """Make one step; an edit in progress ends before it.

        Parameters
        ----------
        drawing : Drawing
            As it is from now on. If it is the same as before, there is no step.
        word : str
            What was done, in the past tense: "removed an arrow".
        """
        self.begin(word)
        self.update(drawing)
        self.end()

    def begin(self, word: str) -> None:
        """Begin an edit that takes a while, as a drag does: however it goes on, it is one step."""
        self.edits.open(self.slot, self._first)
        self.edits.begin(self.slot, word)

    def update(self, drawing: Drawing) -> None:
        """Go on with the edit in progress.

        Raises
        ------
        RuntimeError
            If none was begun.
        """
        if not self.in_progress:
            raise RuntimeError("no edit was begun; call begin() first, or do()")
        self.edits.update(drawing)

    def end(self, word: str = "") -> None:
        """End the edit in progress, if there is one; it can be undone from now on.

        Parameters
        ----------
        word : str, optional
            What was done, if that turned out to be something else than was begun.
        """
        if self.in_progress:
            self.edits.end(word)

    def cancel(self) -> None:
        """Drop the edit in progress: the drawing is as before it, and nothing is to be undone."""
        if self.in_progress:
            self.edits.cancel()

    def undo(self) -> str:
        """Go one step back, whatever it was a step of; an edit in progress ends first.

        Returns
        -------
        str
            What was taken back; empty if there was nothing.
        """
        step = self.edits.undo()
        return "" if step is None else step.word

    def redo(self) -> str:
        """Go one step on again, whatever it was a step of; an edit in progress ends first.

        Returns
        -------
        str
            What was done again; empty if there was nothing.
        """
        step = self.edits.redo()
        return "" if step is None else step.word

    def _on_changed(self, slot: Hashable, value: Any) -> None:
        if slot == self.slot:
            self.changed.emit(value)
