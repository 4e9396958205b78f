"""Lines that show drawn arrows and landmarks in a Vectors layer.

A landmark also has a cross at its base, and the selected mark has another colour.
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
    drawing: Drawing, spacing: Sequence[float], selected: int | None = None, across: int = 0
) -> Lines:
    """Return the lines that show the arrows and landmarks of a drawing.

    Parameters
    ----------
    drawing : Drawing
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    selected : int, optional
        Index of the mark that is highlighted.
    across : int
        For a volume, the axis across the visible slices.

    Returns
    -------
    lines : ndarray, shape (N, 2, n), float32
        (start, step) in pixels.
    colours : ndarray, shape (N, 4), float32
        Red, green, blue and opacity of each line, 0 to 1.
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
            )
            parts.append((lines, SELECTED if number == selected else DRAWN))
    return coloured(parts, len(spacing))


def arrow_layer(frame: Frame, shape: tuple[int, ...]) -> LayerData:
    """Return an empty Vectors layer for arrows, on the pixels of a frame."""
    look = {
        "vector_style": "line",
        "opacity": 1.0,
        "edge_color": np.array(DRAWN),
        "edge_width": max(shape) / 220,
        "ndim": frame.ndim,  # napari cannot derive it from an empty array
    }
    known = {"kind": "drawing", "slice": frame.slice_name}
    return layer_on(frame, np.zeros((0, 2, len(frame.plane))), NAME, known, look, "vectors")
