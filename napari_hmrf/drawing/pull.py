"""Drawing arrows with a pointer: pressed, moved, released."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from napari_hmrf.drawing.drawing import Drawing, Hit
from napari_hmrf.drawing.history import History
from napari_hmrf.drawing.marks import Arrow, Components, Landmark, Point

DREW, MOVED, HELD = "drew an arrow", "moved an arrow", "held a place"
REMOVED, CHANGED = "removed an arrow", "changed an arrow"


@dataclass(frozen=True)
class Grip:
    """How new arrows take hold of tissue; as in `Arrow`."""

    radius: float
    confidence: float = 1.0
    components: Components = "both"


class Pull:
    """Takes hold of tissue and pulls it, or takes hold of an arrow's end again.

    Parameters
    ----------
    history : History
        What is drawn on.
    spacing : sequence of float, shape (2,)
        Size of a pixel in (row, col) direction.

    Attributes
    ----------
    selected : int or None
        The number of the arrow taken hold of last.
    """

    def __init__(self, history: History, spacing: Sequence[float] = (1.0, 1.0)) -> None:
        self._history = history
        self._spacing = tuple(spacing)
        self._held: Hit | None = None
        self._offset: Point = (0.0, 0.0)
        self._begun: Point = (0.0, 0.0)
        self._new = self._moved = False
        self._selected: int | None = None
        self._ours = Drawing()

    @property
    def holding(self) -> bool:
        """Whether something is held."""
        return self._held is not None and self._history.in_progress

    @property
    def selected(self) -> int | None:
        """The number of the arrow taken hold of last; None once something else was done."""
        if self._history.drawing is not self._ours:
            self._selected = None
        return self._selected

    @property
    def arrow(self) -> Arrow | Landmark | None:
        """The mark that is selected."""
        if self.selected is None:
            return None
        mark = self._history.drawing.marks[self.selected]
        return mark if isinstance(mark, Arrow | Landmark) else None

    def press(
        self,
        point: Point,
        reach: float,
        grip: Grip,
        came_from: Callable[[Point], Point | None] = lambda point: point,
    ) -> bool:
        """Take hold of the end of an arrow, or of tissue.

        Parameters
        ----------
        point : (float, float)
            Of the picture as it is seen, (row, col) in pixels.
        reach : float
            How near an arrow's end is near enough, in the unit of the spacing.
        grip : Grip
            How a new arrow takes hold.
        came_from : callable
            Where the tissue seen at a point is when nothing moves; None if there is none. A new
            arrow begins there, and at first leaves the tissue where it is seen.

        Returns
        -------
        bool
            Whether there was anything to take hold of.
        """
        self.release()
        drawing = self._history.drawing
        hit = drawing.at(point, reach, self._spacing)
        self._new = hit is None
        if hit is None:
            at = came_from(point)
            if at is None:
                self.select(None)
                return False
            arrow = Arrow(
                at, self._between(at, point, grip.components), grip.radius, grip.confidence,
                grip.components,
            )  # fmt: skip
            self._history.begin(DREW)
            hit, drawing = Hit(len(drawing.marks), "head"), drawing.with_mark(arrow)
        else:
            self._history.begin(MOVED)
        self._held, self._moved, self._begun = hit, False, point
        end = self._end(drawing.marks[hit.number], hit.part)
        self._offset = (point[0] - end[0], point[1] - end[1])
        self._show(drawing, hit.number)
        return True

    def move(self, point: Point) -> None:
        """Go on to a point; nothing happens unless something is held."""
        if not self.holding or self._held is None:
            return
        number, part = self._held
        to = (point[0] - self._offset[0], point[1] - self._offset[1])
        mark = self._history.drawing.marks[number]
        self._moved = self._moved or point != self._begun
        if isinstance(mark, Landmark):
            mark = replace(mark, target=to) if part == "head" else replace(mark, source=to)
        elif isinstance(mark, Arrow):
            at, head = (mark.at, to) if part == "head" else (to, mark.head(self._spacing))
            mark = replace(mark, at=at, by=self._between(at, head, mark.components))
        self._show(self._history.drawing.replaced(number, mark), number)

    def release(self) -> str:
        """Let go; what was done, as one step that can be undone, or nothing."""
        if not self.holding:
            self._held = None
            return ""
        self._held = None
        word = (DREW if self._moved else HELD) if self._new else MOVED
        self._history.end(word)
        return word if self._new or self._moved else ""

    def cancel(self) -> bool:
        """Let go, and have everything as it was before; whether anything was held."""
        if not self.holding:
            return False
        number = None if self._new or self._held is None else self._held.number
        self._held = None
        self._history.cancel()
        self.select(number)
        return True

    def select(self, number: int | None) -> None:
        """Have an arrow be the one that is changed or removed next."""
        self._ours, self._selected = self._history.drawing, number

    def remove(self) -> bool:
        """Remove the arrow that is selected; whether there was one."""
        self.release()
        number = self.selected
        if number is None:
            return False
        self._history.do(self._history.drawing.without(number), REMOVED)
        return True

    def change(self, **values: Any) -> bool:
        """Give the arrow that is selected another radius, confidence or components.

        Returns
        -------
        bool
            Whether that made a difference.

        Raises
        ------
        ProblemError
            If a value is out of range.
        """
        mark, number = self.arrow, self.selected
        if mark is None or number is None or self.holding:
            return False
        if isinstance(mark, Landmark):
            values.pop("components", None)
        changed = replace(mark, **values)
        if isinstance(changed, Arrow):
            by = self._between(changed.at, changed.head(self._spacing), changed.components)
            changed = replace(changed, by=by)
        if changed == mark:
            return False
        drawing = self._history.drawing.replaced(number, changed)
        self._ours = drawing  # before those who listen ask what is selected
        self._history.do(drawing, CHANGED)
        return True

    def _show(self, drawing: Drawing, number: int) -> None:
        self._ours, self._selected = drawing, number
        self._history.update(drawing)
        # The same drawing stays the one it was.
        self._ours = self._history.drawing

    def _end(self, mark: Any, part: str) -> Point:
        if isinstance(mark, Landmark):
            return mark.target if part == "head" else mark.source
        end: Point = mark.head(self._spacing) if part == "head" else mark.at
        return end

    def _between(self, at: Point, head: Point, components: Components) -> Point:
        row, col = (
            (to - start) * size for start, to, size in zip(at, head, self._spacing, strict=True)
        )
        # Rounding of where it is seen must not move what stays.
        row, col = (0.0 if math.isclose(0, step, abs_tol=1e-9) else step for step in (row, col))
        return (0.0 if components == "col" else row, 0.0 if components == "row" else col)
