"""Overlay of paint on the image; the overlay moves with the tissue."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.live_warp import Picture
from napari_hmrf.field.motion_lines import Lines
from napari_hmrf.layers.paint_layer import painted_marks, show_painted
from napari_hmrf.study.engine import Deformation, Pictures
from napari_hmrf.study.ground import Ground
from napari_hmrf.tissue.drawing import Canvas, Drawing, Stroke
from napari_hmrf.tissue.drawing.canvas import Box


def painted_overlay(
    ground: Ground, drawing: Drawing, canvas: Canvas, window: Box | None, over: Pictures
) -> tuple[Pictures, Lines | None]:
    """Update the overlay of paint for an `Engine`, on the compute thread.

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
    pictures : Pictures
        Picture of the paint and, if confidence is painted, picture of the confidence.
    lines : Lines or None
        Marks of the paint, as returned by `painted_marks`; None if nothing is painted.
    """
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
    is_painted = bool(over) and np.asarray(over[0].image).any()
    return over, painted_marks(canvas) if is_painted else None


def painted_confidence(moved: Deformation) -> npt.NDArray[np.float32] | None:
    """Return the painted confidence of the motion, from 0 to 1, or None if none is painted."""
    return moved.overlay[1] if len(moved.overlay) > 1 else None
