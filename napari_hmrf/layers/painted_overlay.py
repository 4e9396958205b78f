"""Overlay of paint on the image; the overlay moves with the tissue."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.live_warp import Picture
from napari_hmrf.field.motion_lines import Lines
from napari_hmrf.layers.paint_layer import painted_marks, show_painted
from napari_hmrf.study.engine import Deformation, Pictures
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue.drawing import Canvas, Drawing, Stroke
from napari_hmrf.tissue.drawing.canvas import Box


class ShownDeformation(NamedTuple):
    """Deformation with the marks of its paint.

    Attributes
    ----------
    moved : Deformation
    marks : Lines, optional
        Lines as returned by `painted_marks`; None if nothing is painted.
    """

    moved: Deformation
    marks: Lines | None = None

    @property
    def confidence(self) -> npt.NDArray[np.float32] | None:
        """Painted confidence of the motion, from 0 to 1, or None if no confidence is painted."""
        return self.moved.overlay[1] if len(self.moved.overlay) > 1 else None


class PaintedOverlay:
    """Overlay of paint for an `Engine`, for use on the compute thread only."""

    def __init__(self) -> None:
        self._canvas: Canvas | None = None

    def __call__(
        self, ground: Ground, drawing: Drawing, canvas: Canvas, window: Box | None, over: Pictures
    ) -> Pictures:
        """Update the pictures of the overlay.

        Parameters
        ----------
        ground : Ground
            Study without its drawing.
        drawing : Drawing
        canvas : Canvas
            Canvas with the paint of the drawing.
        window : Box, optional
            Region of pixels that have changed; None if no pixels have changed.
        over : Pictures
            Pictures of the previous drawing, which are updated in place.

        Returns
        -------
        Pictures
            Picture of the paint and, if confidence is painted, picture of the confidence.
        """
        self._canvas = canvas
        actions = {mark.action for mark in drawing.marks if isinstance(mark, Stroke)}
        if not over and actions:
            over, window = (Picture(np.zeros(canvas.shape, np.uint8), order=0),), canvas.whole
        if "confidence" not in actions:
            over = over if len(over) < 2 else over[:1]
        elif len(over) < 2:
            # Order 0, so that confidence is not interpolated into sites without confidence.
            confidence = Picture(np.zeros(canvas.shape, np.float32), order=0)
            over, window = (*over, confidence), canvas.whole
        if over and window is not None:
            show_painted(canvas, ground.base, window, *(np.asarray(each.image) for each in over))
        return over

    def with_marks(self, moved: Deformation) -> ShownDeformation:
        """Return a deformation with the marks of the current paint."""
        if self._canvas is None or not moved.overlay or not moved.overlay[0].any():
            return ShownDeformation(moved)
        return ShownDeformation(moved, painted_marks(self._canvas))
