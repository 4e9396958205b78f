"""Brush tool: paints strokes that prescribe the motion or the kind of tissue."""

from __future__ import annotations

import math
from dataclasses import replace

from napari_hmrf.errors import ProblemError
from napari_hmrf.tissue.drawing.canvas import covers, refuse_open_line
from napari_hmrf.tissue.drawing.marks import Action, Mark, Point, Stroke, between
from napari_hmrf.ui.motion.hands import Hand, Origin, unmoved

#: Smallest distance between two points of a stroke, as a part of the brush's radius.
_STEP = 0.1
#: Names of the undo steps, by the action of the brush.
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
    """Brush that paints strokes; going over the selected stroke with the same paint continues it.

    A selected stroke that moves tissue is dragged instead, which changes its displacement.

    Strokes are placed on the undeformed tissue, even while the tissue moves.
    """

    #: Map from a visible place to that of the undeformed tissue, as of the button press.
    _origin: Origin
    #: Place where a moving stroke was picked up, and its displacement then; None if none is.
    _dragged: tuple[Point, Point] | None = None

    def press(self, point: Point, reach: float, how: Stroke, came_from: Origin = unmoved) -> bool:
        """Begin, continue or drag a stroke; outside tissue, it starts at the visible place."""
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
        """Continue to a point; without effect unless the brush is down."""
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
        """Apply the settings of the brush to a stroke, but keep its path and its radius."""
        if not isinstance(mark, Stroke):
            return mark
        return replace(how, lines=mark.lines, radius=mark.radius)

    def _place(self, point: Point) -> Point:
        before = self._origin(point)
        return point if before is None else before
