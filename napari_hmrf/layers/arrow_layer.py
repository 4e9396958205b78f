"""How drawn arrows look: as lines, of which a Vectors layer can hold any number.

A landmark has a cross at its base, too, and what is selected has another colour.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from napari_hmrf.field.frame import Frame
from napari_hmrf.field.motion_lines import Lines, coloured, patch_lines
from napari_hmrf.layers.label_colours import DRAWN, SELECTED
from napari_hmrf.layers.result_layers import LayerData, layer_on
from napari_hmrf.tissue.drawing import Drawing, Landmark, Stroke

NAME = "Motion"


def arrow_lines(
    drawing: Drawing, spacing: Sequence[float], selected: int | None = None, across: int = 0
) -> Lines:
    """Lines that show a drawing's arrows and landmarks.

    Parameters
    ----------
    drawing : Drawing
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    selected : int, optional
        The number of the mark that is highlighted.
    across : int
        Of a volume: the axis across the slices that are looked at.

    Returns
    -------
    lines : ndarray, shape (N, 2, n), float32
        (start, step) in pixels.
    colours : ndarray, shape (N, 4), float32
        Red, green, blue and opacity of each, 0 to 1.
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
    """A Vectors layer to show arrows in, still without any."""
    look = {
        "vector_style": "line",
        "opacity": 1.0,
        "edge_color": np.array(DRAWN),
        "edge_width": max(shape) / 220,
        "ndim": frame.ndim,  # napari cannot tell how many axes no arrows have
    }
    known = {"kind": "drawing", "slice": frame.slice_name}
    return layer_on(frame, np.zeros((0, 2, len(frame.plane))), NAME, known, look, "vectors")
