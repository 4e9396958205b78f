"""Painting strokes with a pointer: what the tissue under the brush does, or is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.drawing.canvas import covers, refuse_open_line
from napari_hmrf.tissue.drawing.hands import Hand, History, Origin, unmoved
from napari_hmrf.tissue.drawing.marks import Action, Mark, Point, Stroke

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


_PUSHED = "pushed what was painted"


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

    #: Where a stroke that moves was taken hold of, and its step then.
    _dragged: tuple[Point, Point] | None = None

    def __init__(
        self,
        history: History,
        spacing: Sequence[float] = (1.0, 1.0),
        shape: tuple[int, int] = (1, 1),
    ) -> None:
        super().__init__(history, spacing)
        self._shape = shape
        self._origin: Origin = unmoved

    def press(self, point: Point, reach: float, how: Stroke, came_from: Origin = unmoved) -> bool:
        """Touch tissue with the brush; where there is none, the place itself is meant."""
        self.release()
        self._origin, self._holds = came_from, True
        self._new, self._dragged = False, None
        drawing, at, stroke = self._history.drawing, self._place(point), self.mark
        word = WORDS[how.action]
        covered = isinstance(stroke, Stroke) and covers(stroke, at, self._spacing)
        if covered and isinstance(stroke, Stroke) and stroke.action == how.action == "move":
            self._dragged = (point, stroke.by)
            self._history.begin(_PUSHED)
        elif covered and isinstance(stroke, Stroke) and replace(how, lines=stroke.lines) == stroke:
            self._history.begin(word)
            self._remake(stroke.again(at))
        else:
            self._new = True
            self._history.begin(word)
            self._show(drawing.with_mark(replace(how, lines=((at,),))), len(drawing.marks))
        return True

    def move(self, point: Point) -> None:
        """Go on to a point; nothing happens unless the brush is down."""
        stroke = self.mark
        if not self.holding or not isinstance(stroke, Stroke):
            return
        if self._dragged is not None:
            start, by = self._dragged
            down, along = (
                step + (now - was) * size
                for step, now, was, size in zip(by, point, start, self._spacing, strict=True)
            )
            self._remake(replace(stroke, by=(down, along)))
            return
        at, last = self._place(point), stroke.lines[-1][-1]
        steps = ((a - b) * size for a, b, size in zip(at, last, self._spacing, strict=True))
        if math.hypot(*steps) >= _STEP * stroke.radius:
            self._remake(stroke.onward(at))

    def _word(self) -> str:
        stroke = self.mark
        if not isinstance(stroke, Stroke):
            return ""
        if stroke.action == "expand":
            try:
                refuse_open_line(stroke, self._spacing, self._shape)
            except ProblemError:
                self.cancel()
                raise
        return _PUSHED if self._dragged else WORDS[stroke.action]

    def _changed(self, mark: Mark, how: Stroke) -> Mark:
        """The brush may change its size from stroke to stroke: that is no change of the last."""
        if not isinstance(mark, Stroke):
            return mark
        changed = replace(how, lines=mark.lines, radius=mark.radius)
        if changed.action == "expand":
            refuse_open_line(changed, self._spacing, self._shape)
        return changed

    def _place(self, point: Point) -> Point:
        before = self._origin(point)
        return point if before is None else before
