"""Going back and forth between drawings."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from psygnal import Signal

from napari_hmrf.drawing.drawing import Drawing


class _Step(NamedTuple):
    """A drawing, and in a word what was done to it next, or to reach it."""

    drawing: Drawing
    word: str


class History:
    """The drawing as it is now, and those it can go back to and on to.

    Drawings do not change, so that what comes back is exactly what was there.

    Parameters
    ----------
    drawing : Drawing, optional
        To begin with.
    depth : int
        How many steps are kept; the oldest are forgotten.

    Attributes
    ----------
    changed : Signal(Drawing)
        Emitted with the drawing whenever it is another.
    """

    changed = Signal(Drawing)

    def __init__(self, drawing: Drawing | None = None, depth: int = 500) -> None:
        self._drawing = drawing or Drawing()
        self._past: deque[_Step] = deque(maxlen=depth)
        self._future: list[_Step] = []
        self._begun: _Step | None = None

    @property
    def drawing(self) -> Drawing:
        """As it is now, an edit in progress included."""
        return self._drawing

    @property
    def in_progress(self) -> bool:
        """Whether an edit was begun and not ended."""
        return self._begun is not None

    @property
    def undo_word(self) -> str:
        """What `undo` would take back, such as "moved an arrow"; empty if nothing."""
        if self._begun is not None and self._begun.drawing != self._drawing:
            return self._begun.word
        return self._past[-1].word if self._past else ""

    @property
    def redo_word(self) -> str:
        """What `redo` would do again; empty if nothing."""
        return self._future[-1].word if self._future else ""

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
        self.end()
        self._begun = _Step(self._drawing, word)

    def update(self, drawing: Drawing) -> None:
        """Go on with the edit in progress.

        Raises
        ------
        RuntimeError
            If none was begun.
        """
        if self._begun is None:
            raise RuntimeError("no edit was begun; call begin() first, or do()")
        self._show(drawing)

    def end(self, word: str = "") -> None:
        """End the edit in progress, if there is one; it can be undone from now on.

        Parameters
        ----------
        word : str, optional
            What was done, if that turned out to be something else than was begun.
        """
        begun, self._begun = self._begun, None
        if begun is not None and begun.drawing != self._drawing:
            self._past.append(begun._replace(word=word or begun.word))
            self._future.clear()

    def cancel(self) -> None:
        """Drop the edit in progress: the drawing is as before it, and nothing is to be undone."""
        begun, self._begun = self._begun, None
        if begun is not None:
            self._show(begun.drawing)

    def undo(self) -> str:
        """Go one step back, ending an edit in progress first.

        Returns
        -------
        str
            What was taken back; empty if there was nothing.
        """
        self.end()
        if not self._past:
            return ""
        step = self._past.pop()
        self._future.append(_Step(self._drawing, step.word))
        self._show(step.drawing)
        return step.word

    def redo(self) -> str:
        """Go one step on again, ending an edit in progress first.

        Returns
        -------
        str
            What was done again; empty if there was nothing.
        """
        self.end()
        if not self._future:
            return ""
        step = self._future.pop()
        self._past.append(_Step(self._drawing, step.word))
        self._show(step.drawing)
        return step.word

    def _show(self, drawing: Drawing) -> None:
        if drawing != self._drawing:
            self._drawing = drawing
            self.changed.emit(drawing)
