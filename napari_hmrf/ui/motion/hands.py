"""What draws with a pointer that is pressed, moved and released: arrows and landmarks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

from napari_hmrf.study.study_model import History
from napari_hmrf.tissue.drawing.drawing import Drawing, Hit, ends_of
from napari_hmrf.tissue.drawing.marks import Arrow, Components, Landmark, Mark, Point, between

#: Where the tissue seen at a point is when nothing moves; None if there is none.
Origin = Callable[[Point], Point | None]


def unmoved(point: Point) -> Point | None:
    """The `Origin` of tissue that is seen where it is."""
    return point


class Hand:
    """What holds a tool and draws; each press to release is one step that can be undone.

    Parameters
    ----------
    history : History
        What is drawn on.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    shape : tuple of int
        Of the image.

    Attributes
    ----------
    selected : int or None
        The number of the mark made or taken hold of last.
    pending : tuple of float or None
        A place that was clicked, in the tissue at rest, and waits for another one.
    """

    pending: Point | None = None

    def __init__(
        self,
        history: History,
        spacing: Sequence[float] = (1.0, 1.0),
        shape: tuple[int, ...] = (1, 1),
    ) -> None:
        self._history = history
        self._spacing = tuple(map(float, spacing))
        self._shape = shape
        self._selected: int | None = None
        self._ours = Drawing()

    @property
    def holding(self) -> bool:
        """Whether something is held."""
        return self._history.in_progress

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

    def press(self, point: Point, reach: float, how: Any, came_from: Origin = unmoved) -> bool:
        """Begin.

        Parameters
        ----------
        point : tuple of float
            Of the picture as it is seen, in pixels.
        reach : float
            How near to what can be picked up is near enough, in the unit of the spacing.
        how : Arrow or Stroke
            A mark as new ones are to be; where it lies does not count.
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
        """Let go; what was done, as one step that can be undone, or nothing.

        Raises
        ------
        ProblemError
            If what is to expand is an open line; nothing has changed then.
        """
        step = self._history.end()
        return "" if step is None else step.word

    def cancel(self) -> bool:
        """Let go, and have everything as it was before; whether anything was held."""
        held, number = self.holding, self._selected
        if held:
            self._history.cancel()
            there = number is not None and number < len(self._history.drawing.marks)
            self.select(number if there else None)
        return held

    def select(self, number: int | None) -> None:
        """Have a mark be the one that is changed or removed next."""
        self._ours, self._selected = self._history.drawing, number

    def remove(self) -> bool:
        """Remove the mark that is selected; whether there was one."""
        mark, number = self.mark, self.selected
        if mark is None or number is None:
            return False
        self.select(None)
        self._history.do(self._history.drawing.without(number), f"removed {name_of(mark)}")
        return True

    def change(self, how: Any) -> bool:
        """Make the selected mark as another one is, but where it lies.

        Returns
        -------
        bool
            Whether that made a difference.

        Raises
        ------
        ProblemError
            If what is to expand is an open line.
        """
        mark, number = self.mark, self.selected
        if mark is None or number is None or self.holding:
            return False
        changed = self._changed(mark, how)
        if changed == mark:
            return False
        drawing = self._history.drawing.replaced(number, changed)
        self._ours = drawing  # before those who listen ask what is selected
        self._history.do(drawing, f"changed {name_of(changed)}")
        return True

    def _changed(self, mark: Any, how: Any) -> Mark:
        raise NotImplementedError

    def _show(self, drawing: Drawing, number: int, word: str = "") -> None:
        self._ours, self._selected = drawing, number
        self._history.update(drawing, word)
        # The same drawing stays the one it was.
        self._ours = self._history.drawing

    def _remake(self, mark: Mark, word: str = "") -> None:
        """Have another mark in the place of the one that is held; in a `word`, what that does."""
        if self._selected is not None:
            drawing = self._history.drawing.replaced(self._selected, mark)
            self._show(drawing, self._selected, word)


class Pull(Hand):
    """Takes hold of tissue and pulls it, or takes hold of the end of an arrow or landmark again."""

    _part: Literal["head", "base"] = "head"
    #: Where the pointer is, and how far from the end that is held.
    _at: Point = (0.0, 0.0)
    _offset: Point = (0.0, 0.0)
    #: What is done once the pointer has moved.
    _pulled = ""

    def press(self, point: Point, reach: float, how: Arrow, came_from: Origin = unmoved) -> bool:
        """Take hold of the end of an arrow, or of tissue; as in `Hand`.

        A new arrow begins where the tissue seen there is when nothing moves, and at first leaves
        it where it is seen.
        """
        self.release()
        if self._take_again(point, reach):
            return True
        at = came_from(point)
        if at is None:
            self.select(None)
            return False
        by = self._between(at, point, how.components)
        self._take_new(replace(how, at=at, by=by), point, "held a place", "drew an arrow")
        return True

    def move(self, point: Point) -> None:
        """Go on to a point; nothing happens unless something is held."""
        if not self.holding or point == self._at:
            return
        self._at, leads, mark = point, self._part == "head", self.mark
        to = tuple(x - away for x, away in zip(point, self._offset, strict=True))
        if isinstance(mark, Landmark):
            moved = replace(mark, target=to) if leads else replace(mark, source=to)
            self._remake(moved, self._pulled)
        elif isinstance(mark, Arrow):
            at, head = (mark.at, to) if leads else (to, mark.head(self._spacing))
            by = self._between(at, head, mark.components)
            self._remake(replace(mark, at=at, by=by), self._pulled)

    def _take_again(self, point: Point, reach: float) -> bool:
        """Take hold of the end of what is there; whether anything is."""
        drawing = self._history.drawing
        hit = drawing.at(point, reach, self._spacing)
        if hit is not None:
            self._take(drawing, hit, point, f"moved {name_of(drawing.marks[hit.number])}")
        return hit is not None

    def _take_new(self, mark: Arrow | Landmark, point: Point, word: str, pulled: str = "") -> None:
        """Take hold of the head of what was not there before."""
        drawing = self._history.drawing
        hit = Hit(len(drawing.marks), "head")
        self._take(drawing.with_mark(mark), hit, point, word, pulled)

    def _take(self, drawing: Drawing, hit: Hit, point: Point, word: str, pulled: str = "") -> None:
        head, base = ends_of(drawing.marks[hit.number], self._spacing)
        end = head if hit.part == "head" else base
        self._offset = tuple(x - y for x, y in zip(point, end, strict=True))
        self._part, self._at, self._pulled = hit.part, point, pulled
        self._history.begin(word)
        self._show(drawing, hit.number)

    def _changed(self, mark: Any, how: Arrow) -> Mark:
        changed: Arrow | Landmark = replace(mark, radius=how.radius, confidence=how.confidence)
        if isinstance(changed, Arrow):
            by = self._between(changed.at, changed.head(self._spacing), how.components)
            changed = replace(changed, components=how.components, by=by)
        return changed

    def _between(self, at: Point, head: Point, components: Components) -> Point:
        # Rounding of where it is seen must not move what stays.
        steps = between(at, head, self._spacing)
        *deep, row, col = (0.0 if math.isclose(0, step, abs_tol=1e-9) else step for step in steps)
        if components == "both":
            return (*deep, row, col)
        only = (row, 0.0) if components == "row" else (0.0, col)
        return (*(0.0 for _ in deep), *only)


class Pairs(Pull):
    """Two clicks make a landmark, where something is and where it should be; so does one drag.

    Its ends can be taken hold of again.
    """

    _pressed: Point | None = None

    def press(self, point: Point, reach: float, how: Arrow, came_from: Origin = unmoved) -> bool:
        """Begin a pair, or end it, or take hold of the end of an arrow or a landmark."""
        self.release()
        if self.pending is not None:
            self._place(self.pending, point, how)
            return True
        if self._take_again(point, reach):
            return True
        self.select(None)
        self.pending = came_from(point)
        if self.pending is None:
            return False
        self._pressed, self._reach, self._how = point, reach, how
        return True

    def move(self, point: Point) -> None:
        """Go on to a point; from the first click of a pair that is a drag to where it should be."""
        if self.pending is not None and self._pressed is not None:
            if math.hypot(*between(self._pressed, point, self._spacing)) <= self._reach:
                return
            self._place(self.pending, self._pressed, self._how)
        super().move(point)

    def release(self) -> str:
        """Let go; a pair whose second place was not clicked yet goes on waiting for it."""
        self._pressed = None
        return super().release()

    def cancel(self) -> bool:
        """Give up the pair that is begun, or what is held; whether there was any."""
        half, self.pending, self._pressed = self.pending, None, None
        return super().cancel() or half is not None

    def _place(self, source: Point, target: Point, how: Arrow) -> None:
        self.pending = self._pressed = None
        mark = Landmark(source, target, how.radius, how.confidence)
        self._take_new(mark, target, "placed a landmark")


def name_of(mark: Mark) -> str:
    """What a mark is, with its article: "an arrow"."""
    kind = type(mark).__name__.lower()
    return f"an {kind}" if kind == "arrow" else f"a {kind}"
