"""The layer *Motion, painted*: what brushes have painted, moved with the tissue."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Layer, Vectors

from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.paint_layer import number_of, painted_layer
from napari_hmrf.layers.viewer_layers import overwrite, same_selection, still_there, update_layer
from napari_hmrf.study.study import Grid
from napari_hmrf.tissue.drawing import Drawing, Stroke
from napari_hmrf.tissue.drawing.canvas import box_of, covered
from napari_hmrf.tissue.drawing.marks import Point


class PaintedLayer:
    """A Labels layer below the arrows, there once something is painted and until it is undone.

    A touch of the brush is shown where it is, and moved with the tissue once that has followed.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer
        self._layer: Any = None
        # Where it lies and which colours it has.
        self._looks: tuple[Frame, dict[int, Any]] | None = None
        self._picture: npt.NDArray[np.uint8] | None = None
        # Each with how many places the stroke had that it is a part of.
        self._touches: list[tuple[int, Stroke]] = []

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
        self._touches = [touch for touch in self._touches if touch[0] > known]
        before, self._picture = self._picture, painted
        if painted is not None or stroke is not None:
            self.show_touches(grid, tissues)
        elif before is not None:  # what was painted here was taken back
            self.remove()

    def touch(self, stroke: Stroke, begin: Point, end: Point) -> None:
        """Take in where the brush has been, for `show` and `show_touches`.

        Parameters
        ----------
        stroke : Stroke
            So far.
        begin, end : (float, float)
            Of this touch, where it is seen, (row, col) in pixels.
        """
        touch = replace(stroke, lines=((begin, end),))
        self._touches.append((sum(map(len, stroke.lines)), touch))

    def show_touches(self, grid: Grid, tissues: dict[int, Any]) -> None:
        """Show what was taken in, on top of what is shown."""
        if self._picture is None:
            self._picture = np.zeros(grid.shape, np.uint8)
        whole = slice(0, grid.shape[0]), slice(0, grid.shape[1])
        for _, touch in self._touches:
            box = box_of(touch, grid.spacing, whole)
            number = number_of(touch.action, touch.confidence, touch.label)
            self._picture[box][covered(touch, grid.spacing, box)] = number
        self._put(grid.place, self._picture, tissues)

    def forget(self) -> None:
        """Go over to another slice: nothing of this one is shown any more."""
        self._touches.clear()
        self._picture = None
        if self.layer is not None:
            self._layer.data = np.zeros_like(self._layer.data)

    def remove(self) -> None:
        """Take the layer out of the viewer."""
        self.forget()
        if self.layer is not None:
            self._viewer.layers.remove(self._layer)
        self._layer = self._looks = None

    def _put(self, frame: Frame, picture: npt.NDArray[np.uint8], tissues: dict[int, Any]) -> None:
        layer, before, self._looks = self.layer, self._looks, (frame, tissues)
        same = layer is not None and self._looks == before
        if same and overwrite(self._viewer, layer, frame.put_image(picture)):
            return
        made = painted_layer(frame, picture.copy(), tissues)
        if layer is not None and layer.ndim == frame.ndim:
            update_layer(layer, made)
            layer.colormap = made.attributes["colormap"]
            return
        if layer is not None:
            self._viewer.layers.remove(layer)
        self._layer = Layer.create(*made)
        self._layer.editable = False
        layers = self._viewer.layers
        lines = (at for at, each in enumerate(layers) if isinstance(each, Vectors))
        with same_selection(self._viewer):
            layers.insert(next(lines, len(layers)), self._layer)


def _length_of(drawing: Drawing, stroke: Stroke | None) -> int:
    """How many places of a stroke that goes on a drawing knows already."""
    if stroke is None:
        return 0
    for mark in reversed(drawing.marks):
        if isinstance(mark, Stroke) and stroke.added_to(mark) is not None:
            return sum(map(len, mark.lines))
    return 0
