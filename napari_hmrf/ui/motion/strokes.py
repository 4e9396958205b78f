"""What brushes have painted, as it is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from napari_hmrf.layers.paint_layer import number_of
from napari_hmrf.study.study import Grid
from napari_hmrf.tissue.drawing import Drawing, Stroke
from napari_hmrf.tissue.drawing.canvas import box_of, covered
from napari_hmrf.tissue.drawing.marks import Point

Picture = npt.NDArray[np.uint8]


class Painting:
    """What was painted, moved with the tissue, and touches of the brush that did not move yet.

    Attributes
    ----------
    picture : ndarray of uint8, shape (H, W), or None
        As of `show_painted`; None if nothing is painted.
    """

    def __init__(self) -> None:
        self.picture: Picture | None = None
        # Each with how many places the stroke had that it is a part of.
        self._touches: list[tuple[int, Stroke]] = []

    def take(
        self, grid: Grid, painted: Picture | None, drawing: Drawing, stroke: Stroke | None
    ) -> None:
        """Have what was painted be another, with the touches on top that are not a part of it yet.

        Parameters
        ----------
        grid : Grid
        painted : ndarray of uint8, shape (H, W), or None
            As it has moved; None if nothing is painted.
        drawing : Drawing
            Of which it is.
        stroke : Stroke, optional
            What is being painted.
        """
        if stroke is None:
            self._touches.clear()
        known = _length_of(drawing, stroke)
        self._touches = [touch for touch in self._touches if touch[0] > known]
        self.picture = painted
        if stroke is not None:
            self.draw(grid)

    def touch(self, stroke: Stroke, begin: Point, end: Point) -> None:
        """Take in where the brush has been, for `draw`.

        Parameters
        ----------
        stroke : Stroke
            So far.
        begin, end : (float, float)
            Of this touch, where it is seen, (row, col) in pixels.
        """
        touch = replace(stroke, lines=((begin, end),))
        self._touches.append((sum(map(len, stroke.lines)), touch))

    def draw(self, grid: Grid) -> None:
        """Draw the touches into the picture."""
        if self.picture is None:
            self.picture = np.zeros(grid.shape, np.uint8)
        whole = slice(0, grid.shape[0]), slice(0, grid.shape[1])
        for _, touch in self._touches:
            box = box_of(touch, grid.spacing, whole)
            number = number_of(touch.action, touch.label)
            self.picture[box][covered(touch, grid.spacing, box)] = number

    def forget(self) -> None:
        """Go over to another slice, of which nothing is painted."""
        self._touches.clear()
        self.picture = None


def _length_of(drawing: Drawing, stroke: Stroke | None) -> int:
    """How many places of a stroke that goes on a drawing knows already."""
    if stroke is None:
        return 0
    for mark in reversed(drawing.marks):
        if isinstance(mark, Stroke) and stroke.added_to(mark) is not None:
            return sum(map(len, mark.lines))
    return 0
