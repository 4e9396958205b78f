"""Painting strokes with a pointer: what the tissue under the brush does, or is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.drawing.canvas import refuse_open_line
from napari_hmrf.tissue.drawing.marks import Action, Components, Mark, Point, Stroke
from napari_hmrf.tissue.drawing.tool import Hand, History, Origin, unmoved

#: The brush must have moved on by this part of its radius until that is a place of its own.
_STEP = 0.1
#: What was painted, for the words of the steps.
WORDS: dict[Action, str] = {
    "pin": "pinned tissue",
    "free": "freed tissue",
    "move": "painted a move",
    "expand": "painted what expands",
    "confidence": "painted confidence",
    "tissue": "painted tissue",
}


@dataclass(frozen=True)
class Paint:
    """How new strokes are made; as in `Stroke`."""

    action: Action
    radius: float
    by: Point = (0.0, 0.0)
    amount: float = 0.0
    confidence: float = 1.0
    softness: float = 0.0
    label: int = 0
    components: Components = "both"

    @classmethod
    def of(cls, stroke: Stroke) -> Paint:
        """How a stroke was made."""
        return cls(**{field.name: getattr(stroke, field.name) for field in fields(cls)})

    def stroke(self, at: Point) -> Stroke:
        """A touch of the brush."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return Stroke(lines=((at,),), **values)


class Brush(Hand):
    """Paints strokes; where the selected one is gone over with the same paint, it is continued.

    What moves by a step is dragged instead, once it is painted: the step leads where it is let go.

    What is under the brush is the tissue as it was seen when the button was pressed: that it moves
    meanwhile does not lead the brush astray.

    Parameters
    ----------
    history : History
        What is drawn on.
    spacing : sequence of float, shape (2,)
        Size of a pixel in (row, col) direction.
    shape : (int, int)
        Of the image.
    """

    def __init__(
        self,
        history: History,
        spacing: Sequence[float] = (1.0, 1.0),
        shape: tuple[int, int] = (1, 1),
    ) -> None:
        super().__init__(history, spacing)
        self._shape = shape
        self._origin: Origin = unmoved
        self._new = False
        # Where a stroke that moves was taken hold of, and its step then.
        self._dragged: tuple[Point, Point] | None = None

    @property
    def how(self) -> Paint | None:
        """How the selected stroke was made."""
        mark = self.mark
        return Paint.of(mark) if isinstance(mark, Stroke) else None

    def press(self, point: Point, reach: float, how: Paint, came_from: Origin = unmoved) -> bool:
        """Touch tissue with the brush; where there is none, the place itself is meant."""
        self.release()
        self._origin, self._holds = came_from, True
        drawing, at = self._history.drawing, self._place(point)
        before, number = self.mark, self.selected
        covered = isinstance(before, Stroke) and before.distance(at, self._spacing) <= before.radius
        self._dragged = None
        if covered and isinstance(before, Stroke) and before.action == how.action == "move":
            self._dragged, self._new = (point, before.by), False
            self._history.begin("pushed what was painted")
            return True
        self._history.begin(WORDS[how.action])
        if covered and isinstance(before, Stroke) and Paint.of(before) == how:
            assert number is not None
            self._new = False
            self._show(drawing.replaced(number, before.again(at)), number)
        else:
            self._new = True
            self._show(drawing.with_mark(how.stroke(at)), len(drawing.marks))
        return True

    def move(self, point: Point) -> None:
        """Go on to a point; nothing happens unless the brush is down."""
        stroke, number = self.mark, self.selected
        if not self.holding or number is None or not isinstance(stroke, Stroke):
            return
        if self._dragged is not None:
            start, by = self._dragged
            down, along = (
                step + (now - was) * size
                for step, now, was, size in zip(by, point, start, self._spacing, strict=True)
            )
            pushed = replace(stroke, by=(down, along))
            self._show(self._history.drawing.replaced(number, pushed), number)
            return
        at, last = self._place(point), stroke.lines[-1][-1]
        steps = ((a - b) * size for a, b, size in zip(at, last, self._spacing, strict=True))
        if math.hypot(*steps) >= _STEP * stroke.radius:
            self._show(self._history.drawing.replaced(number, stroke.onward(at)), number)

    def release(self) -> str:
        """Lift the brush.

        Raises
        ------
        ProblemError
            If what is to expand is an open line; nothing has changed then.
        """
        if not self.holding:
            self._holds = False
            return ""
        stroke = self.mark
        if isinstance(stroke, Stroke) and stroke.action == "expand":
            try:
                refuse_open_line(stroke, self._spacing, self._shape)
            except ProblemError:
                self.cancel()
                raise
        self._holds = False
        self._history.end()
        return self._history.undo_word

    def _changed(self, mark: Mark, values: dict[str, Any]) -> Mark:
        """The brush may change its size from stroke to stroke: that is no change of the last."""
        if not isinstance(mark, Stroke):
            return mark
        changed = replace(mark, **{**values, "radius": mark.radius})
        if changed.action == "expand":
            refuse_open_line(changed, self._spacing, self._shape)
        return changed

    def _selected_before(self) -> int | None:
        return None if self._new else self._selected

    def _place(self, point: Point) -> Point:
        before = self._origin(point)
        return point if before is None else before
