"""The layer *Painted*: what brushes have painted, moved with the tissue."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Layer, Vectors

from napari_hmrf.layers.paint_layer import number_of, painted_layer
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.viewer_layers import (
    overwrite,
    same_selection,
    still_there,
    update_layer,
)
from napari_hmrf.study.study import Grid
from napari_hmrf.tissue.drawing import Drawing, Stroke
from napari_hmrf.tissue.drawing.canvas import common, distance_to
from napari_hmrf.tissue.drawing.marks import Point


class PaintedLayer:
    """A Labels layer below the arrows, made when something is painted first.

    A touch of the brush is shown where it is, and moved with the tissue once that has followed.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer
        self._layer: Any = None
        self._frame: Frame | None = None
        self._picture: npt.NDArray[np.uint8] | None = None
        self._touches: list[_Touch] = []
        self._tissues: dict[int, Any] = {}

    @property
    def layer(self) -> Any:
        """The layer, if it is in the viewer."""
        return still_there(self._viewer, self._layer)

    def show(
        self,
        grid: Grid,
        painted: npt.NDArray[np.uint8] | None,
        drawing: Drawing,
        stroke: Stroke | None,
        tissues: dict[int, Any],
    ) -> None:
        """Show what was painted, and on top the touches that are not yet a part of it.

        Parameters
        ----------
        grid : Grid
        painted : ndarray of uint8, shape (H, W), or None
            As it has moved; None if nothing is painted.
        drawing : Drawing
            Of which it is.
        stroke : Stroke, optional
            What is being painted.
        tissues : dict of int to colour
            Of each tissue's label.
        """
        if stroke is None:
            self._touches.clear()
        known = _length_of(drawing, stroke)
        self._touches = [touch for touch in self._touches if touch.places > known]
        if painted is None and not self._touches:
            self._picture = None
            if self.layer is not None and self._layer.data.any():
                self._put(grid, np.zeros(grid.shape, np.uint8), tissues)
            return
        picture = np.zeros(grid.shape, np.uint8) if painted is None else painted
        for touch in self._touches:
            touch.draw(picture, grid)
        self._put(grid, picture, tissues)

    def touch(self, stroke: Stroke, begin: Point, end: Point) -> None:
        """Take in where the brush has been, for `show` and `show_touches`.

        Parameters
        ----------
        stroke : Stroke
            So far.
        begin, end : (float, float)
            Of this touch, where it is seen, (row, col) in pixels.
        """
        self._touches.append(_Touch(sum(map(len, stroke.lines)), stroke, begin, end))

    def show_touches(self, grid: Grid, tissues: dict[int, Any]) -> None:
        """Show what was taken in, on top of what is shown."""
        picture = self._picture
        if picture is None or picture.shape != grid.shape:
            picture = np.zeros(grid.shape, np.uint8)
        for touch in self._touches:
            touch.draw(picture, grid)
        self._put(grid, picture, tissues)

    def forget(self) -> None:
        """Go over to another slice: nothing of this one is shown any more."""
        self._touches.clear()
        self._picture = None
        layer = self.layer
        if layer is not None and layer.data.any():
            layer.data = np.zeros_like(layer.data)

    def remove(self) -> None:
        """Take the layer out of the viewer."""
        self.forget()
        if self.layer is not None:
            self._viewer.layers.remove(self._layer)
        self._layer = self._frame = None

    def _put(self, grid: Grid, picture: npt.NDArray[np.uint8], tissues: dict[int, Any]) -> None:
        self._picture = picture
        frame, layer = grid.place, self.layer
        if layer is None or layer.ndim != frame.ndim:
            if layer is not None:
                self._viewer.layers.remove(layer)
            layer = self._layer = Layer.create(*painted_layer(frame, picture.copy(), tissues))
            layer.editable = False
            self._tissues = tissues
            _insert_below_lines(self._viewer, layer)
        elif frame == self._frame and tissues == self._tissues:
            data = frame.put_image(picture)
            if not overwrite(self._viewer, layer, data):
                layer.data = data.copy()
        else:
            made = painted_layer(frame, picture, tissues)
            update_layer(layer, made)
            layer.colormap = made.attributes["colormap"]
            self._tissues = tissues
        self._frame = frame


def _insert_below_lines(viewer: Any, layer: Any) -> None:
    """Add a layer below all lines."""
    layers = viewer.layers
    above = [at for at, each in enumerate(layers) if isinstance(each, Vectors)]
    with same_selection(viewer):
        layers.insert(min([len(layers), *above]), layer)


@dataclass(frozen=True)
class _Touch:
    """Where a brush has been: from one place to another, of how many its stroke has `places`."""

    places: int
    stroke: Stroke
    begin: Point
    end: Point

    def draw(self, picture: npt.NDArray[np.uint8], grid: Grid) -> None:
        """Draw it, in place."""
        stroke, begin, end = self.stroke, self.begin, self.end
        down, along = size = grid.spacing[0], grid.spacing[1]
        reach = stroke.radius / down, stroke.radius / along
        box = common(
            (
                int(min(begin[0], end[0]) - reach[0]),
                int(max(begin[0], end[0]) + reach[0]) + 2,
                int(min(begin[1], end[1]) - reach[1]),
                int(max(begin[1], end[1]) + reach[1]) + 2,
            ),
            (0, grid.shape[0], 0, grid.shape[1]),
        )
        part = picture[box[0] : box[1], box[2] : box[3]]
        under = distance_to(((begin, end),), stroke.radius, size, box) <= stroke.radius
        part[under] = number_of(stroke.action, stroke.confidence, stroke.label)


def _length_of(drawing: Drawing, stroke: Stroke | None) -> int:
    """How many places of a stroke that goes on a drawing knows already."""
    if stroke is None:
        return 0
    for mark in reversed(drawing.marks):
        if isinstance(mark, Stroke) and stroke.added_to(mark) is not None:
            return sum(map(len, mark.lines))
    return 0
