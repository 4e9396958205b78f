"""Painting strokes with a pointer: what the tissue under the brush does, or is."""

from __future__ import annotations

import math
from dataclasses import replace

from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.drawing.canvas import covers, refuse_open_line
from napari_hmrf.tissue.drawing.marks import Action, Mark, Point, Stroke, between
from napari_hmrf.ui.motion.hands import Hand, Origin, unmoved

#: The brush must have moved on by this part of its radius until that is a place of its own.
_STEP = 0.1
#: What was painted, for the words of the steps.
WORDS: dict[Action, str] = {
    "pin": "held tissue",
    "free": "freed tissue",
    "move": "painted a push",
    "expand": "painted what grows",
    "confidence": "painted confidence",
    "tissue": "painted tissue",
}
_PUSHED = "pushed what was painted"


class Brush(Hand):
    """Paints strokes; where the selected one is gone over with the same paint, it is continued.

    What moves by a step is dragged instead, once it is painted: the step leads where it is let go.

    That tissue moves meanwhile does not lead the brush astray.
    """

    #: Where the tissue under the brush was, as it was seen when the button was pressed.
    _origin: Origin
    #: Where a stroke that moves was taken hold of, and its step then.
    _dragged: tuple[Point, Point] | None = None

    def press(self, point: Point, reach: float, how: Stroke, came_from: Origin = unmoved) -> bool:
        """Touch tissue with the brush; where there is none, the place itself is meant."""
        self.release()
        self._origin, self._dragged = came_from, None
        drawing, at, stroke = self._model.drawing, self._place(point), self.mark
        word = WORDS[how.action]
        if not isinstance(stroke, Stroke) or not covers(stroke, at, self._spacing):
            stroke = None
        if stroke is not None and stroke.action == how.action == "move":
            self._dragged = (point, stroke.by)
            self._model.begin_drawing(_PUSHED)
        elif stroke is not None and replace(how, lines=stroke.lines) == stroke:
            self._model.begin_drawing(word)
            self._remake(stroke.again(at))
        else:
            self._model.begin_drawing(word)
            self._show(drawing.with_mark(replace(how, lines=((at,),))), len(drawing.marks))
        return True

    def move(self, point: Point) -> None:
        """Go on to a point; nothing happens unless the brush is down."""
        stroke = self.mark
        if not self.holding or not isinstance(stroke, Stroke):
            return
        if self._dragged is not None:
            start, by = self._dragged
            more = between(start, point, self._spacing)
            self._remake(replace(stroke, by=tuple(map(sum, zip(by, more, strict=True)))))
            return
        at, last = self._place(point), stroke.lines[-1][-1]
        if math.hypot(*between(last, at, self._spacing)) >= _STEP * stroke.radius:
            self._remake(stroke.onward(at))

    def release(self) -> str:
        """Lift the brush; as in `Hand`."""
        stroke = self.mark
        if self.holding and isinstance(stroke, Stroke) and stroke.action == "expand":
            try:
                refuse_open_line(stroke, self._spacing, self._shape)
            except ProblemError:
                self.cancel()
                raise
        return super().release()

    def _changed(self, mark: Mark, how: Stroke) -> Mark:
        """The brush may change its size from stroke to stroke: that is no change of the last."""
        if not isinstance(mark, Stroke):
            return mark
        return replace(how, lines=mark.lines, radius=mark.radius)

    def _place(self, point: Point) -> Point:
        before = self._origin(point)
        return point if before is None else before
