"""What draws with a pointer that is pressed, moved and released: what all tools have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

from napari_hmrf.tissue.drawing.drawing import Drawing
from napari_hmrf.tissue.drawing.marks import Mark, Point

#: Where the tissue seen at a point is when nothing moves; None if there is none.
Origin = Callable[[Point], Point | None]


def unmoved(point: Point) -> Point | None:
    """The `Origin` of tissue that is seen where it is."""
    return point


class History(Protocol):
    """A drawing as it is now, and the steps that led there."""

    @property
    def drawing(self) -> Drawing:
        """As it is now, an edit in progress included."""

    @property
    def in_progress(self) -> bool:
        """Whether an edit was begun and not ended."""

    @property
    def undo_word(self) -> str:
        """What was done last; empty if nothing."""

    def do(self, drawing: Drawing, word: str) -> None:
        """Make one step, said in the past tense."""

    def begin(self, word: str) -> None:
        """Begin an edit that takes a while."""

    def update(self, drawing: Drawing) -> None:
        """Go on with it."""

    def end(self, word: str = "") -> None:
        """End it; it is one step."""

    def cancel(self) -> None:
        """Drop it: all is as before."""


class Hand:
    """A tool that draws on a history; each press to release is one step that can be undone.

    Parameters
    ----------
    history : History
        What is drawn on.
    spacing : sequence of float, shape (2,)
        Size of a pixel in (row, col) direction.

    Attributes
    ----------
    selected : int or None
        The number of the mark made or taken hold of last.
    """

    def __init__(self, history: History, spacing: Sequence[float] = (1.0, 1.0)) -> None:
        self._history = history
        self._spacing = (float(spacing[0]), float(spacing[1]))
        self._holds = False
        self._selected: int | None = None
        self._ours = Drawing()

    @property
    def holding(self) -> bool:
        """Whether something is held."""
        return self._holds and self._history.in_progress

    @property
    def pending(self) -> Point | None:
        """A place that was clicked, and waits for another one."""
        return None

    @property
    def selected(self) -> int | None:
        """The number of the mark made or taken hold of last; None once something else was done."""
        if self._history.drawing is not self._ours:
            self._selected = None
        return self._selected

    @property
    def mark(self) -> Mark | None:
        """The mark that is selected."""
        number = self.selected
        return None if number is None else self._history.drawing.marks[number]

    @property
    def how(self) -> Any:
        """How the selected mark was made, as `press` takes it; None if none is selected."""
        return None

    def press(self, point: Point, reach: float, how: Any, came_from: Origin = unmoved) -> bool:
        """Begin.

        Parameters
        ----------
        point : (float, float)
            Of the picture as it is seen, (row, col) in pixels.
        reach : float
            How near to what can be picked up is near enough, in the unit of the spacing.
        how : Grip or Paint
            How new marks are made.
        came_from : callable
            Where the tissue seen at a point is when nothing moves; None if there is none.

        Returns
        -------
        bool
            Whether there was anything to take hold of, so that a drag begins.
        """
        raise NotImplementedError

    def move(self, point: Point) -> None:
        """Go on to a point; nothing happens unless something is held."""
        raise NotImplementedError

    def release(self) -> str:
        """Let go; what was done, as one step that can be undone, or nothing."""
        raise NotImplementedError

    def cancel(self) -> bool:
        """Let go, and have everything as it was before; whether anything was held."""
        if not self.holding:
            self._holds = False
            return False
        number = self._selected_before()
        self._holds = False
        self._history.cancel()
        self.select(number)
        return True

    def select(self, number: int | None) -> None:
        """Have a mark be the one that is changed or removed next."""
        self._ours, self._selected = self._history.drawing, number

    def remove(self) -> bool:
        """Remove the mark that is selected; whether there was one."""
        self.release()
        number = self.selected
        if number is None:
            return False
        word = f"removed {name_of(self._history.drawing.marks[number])}"
        self.select(None)
        self._history.do(self._history.drawing.without(number), word)
        return True

    def change(self, **values: Any) -> bool:
        """Make the selected mark in another way, such as with another confidence.

        Returns
        -------
        bool
            Whether that made a difference.

        Raises
        ------
        ProblemError
            If a value is out of range.
        """
        mark, number = self.mark, self.selected
        if mark is None or number is None or self.holding:
            return False
        changed = self._changed(mark, values)
        if changed == mark:
            return False
        drawing = self._history.drawing.replaced(number, changed)
        self._ours = drawing  # before those who listen ask what is selected
        self._history.do(drawing, f"changed {name_of(changed)}")
        return True

    def _changed(self, mark: Mark, values: dict[str, Any]) -> Mark:
        return replace(mark, **values)

    def _selected_before(self) -> int | None:
        """What is selected when what is held is given up."""
        return None

    def _show(self, drawing: Drawing, number: int) -> None:
        self._ours, self._selected = drawing, number
        self._history.update(drawing)
        # The same drawing stays the one it was.
        self._ours = self._history.drawing


def name_of(mark: Mark) -> str:
    """What a mark is, with its article: "an arrow"."""
    kind = type(mark).__name__.lower()
    return f"an {kind}" if kind == "arrow" else f"a {kind}"
