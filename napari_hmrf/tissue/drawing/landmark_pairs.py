"""Placing landmarks with a pointer: where something is, then where it should be."""

from __future__ import annotations

import math
from typing import Any

from napari_hmrf.tissue.drawing.marks import Landmark, Mark, Point
from napari_hmrf.tissue.drawing.pull import Grip, Pull
from napari_hmrf.tissue.drawing.tool import Origin, unmoved

PLACED = "placed a landmark"


class Pairs(Pull):
    """Two clicks make a landmark, and so does one drag; its ends can be taken hold of again.

    Attributes
    ----------
    pending : (float, float) or None
        Where the first click of a pair was, in the tissue at rest.
    """

    def __init__(self, history: Any, spacing: Any = (1.0, 1.0)) -> None:
        super().__init__(history, spacing)
        self._half: Point | None = None
        self._pressed: Point | None = None
        self._reach = 0.0
        self._how = Grip(1.0)

    @property
    def pending(self) -> Point | None:
        """Where the first click of a pair was; None if no pair is begun."""
        return self._half

    def press(self, point: Point, reach: float, how: Grip, came_from: Origin = unmoved) -> bool:
        """Begin a pair, or end it, or take hold of the end of an arrow or a landmark."""
        self.release()
        drawing = self._history.drawing
        if self._half is not None:
            self._place(self._half, point, how)
            return True
        hit = drawing.at(point, reach, self._spacing)
        if hit is not None:
            self._hold(drawing, hit, point)
            return True
        self.select(None)
        self._half = came_from(point)
        if self._half is None:
            return False
        self._pressed, self._reach, self._how = point, reach, how
        return True

    def move(self, point: Point) -> None:
        """Go on to a point; from the first click of a pair that is a drag to where it should be."""
        if self._half is None or self._pressed is None:
            super().move(point)
            return
        away = math.dist(*(self._lengths(place) for place in (point, self._pressed)))
        if away > self._reach:
            self._place(self._half, self._pressed, self._how)
            super().move(point)

    def release(self) -> str:
        """Let go; a pair whose second place was not clicked yet goes on waiting for it."""
        self._pressed = None
        return super().release()

    def cancel(self) -> bool:
        """Give up the pair that is begun, or what is held; whether there was any."""
        half, self._half, self._pressed = self._half, None, None
        return super().cancel() or half is not None

    def _place(self, source: Point, target: Point, how: Grip) -> None:
        self._half = self._pressed = None
        self._hold_new(Landmark(source, target, how.radius, how.confidence), target, PLACED)

    def _word(self, mark: Mark) -> str:
        return PLACED if self._new else super()._word(mark)

    def _lengths(self, place: Point) -> Point:
        return place[0] * self._spacing[0], place[1] * self._spacing[1]
