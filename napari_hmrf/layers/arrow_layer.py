"""Display of drawn arrows and landmarks as lines in a Vectors layer.

The base of a landmark is marked with a cross, and the selected mark has a different colour. The
circle at the target of a landmark shows its standard deviation, or the patch of an exact landmark.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from napari_hmrf.field.frame import Frame
from napari_hmrf.field.motion_lines import Lines, coloured, patch_lines
from napari_hmrf.layers.label_colours import DRAWN, SELECTED
from napari_hmrf.layers.result_layers import LayerData, layer_on
from napari_hmrf.tissue.drawing import Drawing, Landmark, Stroke

#: Name of the layer.
NAME = "Motion"


def arrow_lines(
    drawing: Drawing,
    spacing: Sequence[float],
    selected: int | None = None,
    across: int = 0,
    shape: Sequence[int] | None = None,
) -> Lines:
    """Return the lines that display the arrows and landmarks of a drawing.

    Parameters
    ----------
    drawing : Drawing
    spacing : sequence of float, shape (n,)
        Pixel size along each axis.
    selected : int, optional
        Index of the mark to highlight.
    across : int
        Axis of a volume perpendicular to the visible slices; ignored in 2-D.
    shape : sequence of int, shape (n,), optional
        Shape of the image, which limits the size of the outlines; by default, there is no limit.

    Returns
    -------
    lines : ndarray, shape (N, 2, n), float32
        Start and vector of each line, in pixels.
    colours : ndarray, shape (N, 4), float32
        Red, green, blue and opacity of each line, from 0 to 1.
    """
    parts = []
    for number, mark in enumerate(drawing.marks):
        if not isinstance(mark, Stroke):
            arrow = mark.arrow(spacing) if isinstance(mark, Landmark) else mark
            lines = patch_lines(
                arrow.at,
                arrow.by,
                arrow.radius,
                spacing,
                across=across,
                only={"row": len(spacing) - 2, "col": len(spacing) - 1}.get(arrow.components),
                is_place=isinstance(mark, Landmark),
                spread=mark.sd if isinstance(mark, Landmark) else 0.0,
                shape=shape,
            )
            parts.append((lines, SELECTED if number == selected else DRAWN))
    return coloured(parts, len(spacing))


def arrow_layer(frame: Frame, shape: tuple[int, ...]) -> LayerData:
    """Return the data of an empty Vectors layer for arrows, with the transform of a frame."""
    look = {
        "vector_style": "line",
        "opacity": 1.0,
        "edge_color": np.array(DRAWN),
        "edge_width": max(shape) / 220,
        "ndim": frame.ndim,  # napari cannot infer this from an empty array
    }
    known = {"kind": "drawing", "slice": frame.slice_name}
    return layer_on(frame, np.zeros((0, 2, len(frame.plane))), NAME, known, look, "vectors")
