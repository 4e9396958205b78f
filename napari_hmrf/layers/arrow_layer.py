"""How drawn arrows look: as lines, of which a Vectors layer can hold any number.

An arrow is a line from where tissue was to where it goes, with two barbs; around its head lies the
outline of the patch that it holds. A landmark has a cross at its base, too. What speaks of one
direction only has a double arrow along that through its patch. What is not certain is paler, what
is selected has another colour.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.layers.label_colours import DRAWN, SELECTED
from napari_hmrf.layers.metadata import METADATA
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.result_layers import LayerData
from napari_hmrf.tissue.drawing import Arrow, Drawing, Landmark
from napari_hmrf.tissue.drawing.marks import Point

FloatArray = npt.NDArray[np.float32]

#: (start, step) of each line, and its colour.
Lines = tuple[FloatArray, FloatArray]

NAME = "Arrows"
#: Sides of the outline of a patch.
_SIDES = 20
#: Length of the barbs and of a pin's cross, in radii of the patch.
_BARB = 0.5
#: How far a double arrow goes, in radii of the patch, and the length of its barbs in parts of that.
_BEYOND, _TIP = 1.4, 0.25
#: How opaque what hardly counts is.
_PALEST = 0.35


def arrow_lines(
    drawing: Drawing,
    spacing: tuple[float, float],
    selected: int | None = None,
    pending: Point | None = None,
    radius: float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Lines that show a drawing's arrows and landmarks.

    Parameters
    ----------
    drawing : Drawing
    spacing : (float, float)
        Size of a pixel in (row, col) direction.
    selected : int, optional
        The number of the mark that is highlighted.
    pending : (float, float), optional
        A place that was clicked, and waits for where it should be; highlighted, too.
    radius : float
        Of what is to be there.

    Returns
    -------
    lines : ndarray, shape (N, 2, 2), float32
        (start, step) in pixels.
    colours : ndarray, shape (N, 4), float32
        Red, green, blue and opacity of each, 0 to 1.
    """
    lines: list[npt.NDArray[np.float64]] = []
    colours: list[npt.NDArray[np.float64]] = []
    marks = list(enumerate(drawing.marks))
    if pending is not None:
        marks.append((-1, Arrow(pending, (0.0, 0.0), radius)))
        selected = -1
    for number, mark in marks:
        base = np.zeros((0, 2, 2))
        if isinstance(mark, Landmark):
            mark = mark.arrow(spacing)
            base = _cross(np.array(mark.at), 0.5 * _BARB * mark.radius / np.array(spacing))
        if not isinstance(mark, Arrow):
            continue
        one_way = np.zeros((0, 2, 2))
        if mark.components != "both":
            head, axis = np.array([mark.head(spacing)]), ("row", "col").index(mark.components)
            one_way = double_arrows(head * spacing, axis, _BEYOND * mark.radius) / spacing
        drawn = np.concatenate([_lines_of(mark, spacing), one_way, base])
        colour = np.array(SELECTED if number == selected else DRAWN)
        colour[3] = _PALEST + (1 - _PALEST) * mark.confidence
        lines.append(drawn)
        colours.append(np.tile(colour, (len(drawn), 1)))
    if not lines:
        return np.zeros((0, 2, 2), np.float32), np.zeros((0, 4), np.float32)
    return (
        np.concatenate(lines).astype(np.float32),
        np.concatenate(colours).astype(np.float32),
    )


def arrow_layer(frame: Frame, shape: tuple[int, int]) -> LayerData:
    """A Vectors layer to show arrows in, still without any."""
    attributes: dict[str, Any] = {
        **frame.placement(),
        "name": NAME,
        "vector_style": "line",
        "edge_color": np.array(DRAWN),
        "edge_width": max(shape) / 220,
        "opacity": 1.0,
        "metadata": {METADATA: {"kind": "drawing", "slice": frame.slice_name}},
    }
    # napari cannot tell how many axes no arrows have.
    none = frame.put_vectors(np.zeros((0, 2, 2)))
    return LayerData(none, {**attributes, "ndim": frame.ndim}, "vectors")


def double_arrows(at: npt.NDArray[Any], axis: int, reach: float) -> npt.NDArray[np.float64]:
    """Lines along one axis with two barbs at either end: what says nothing of the other axis.

    Parameters
    ----------
    at : ndarray, shape (N, 2)
        Their middles, in the unit of the spacing.
    axis : int
        0 along the rows, 1 along the columns.
    reach : float
        Half their length, in the unit of the spacing.

    Returns
    -------
    ndarray, shape (5 N, 2, 2), float64
        (start, step) of each line, in the unit of the spacing.
    """
    along, across = reach * np.eye(2)[axis], reach * np.eye(2)[1 - axis]
    barbs = [
        (end * along, _TIP * (side * across - end * along)) for end in (-1, 1) for side in (-1, 1)
    ]
    lines = [(-along, 2 * along), *barbs]
    return np.concatenate(
        [np.stack([at + start, np.broadcast_to(step, at.shape)], axis=1) for start, step in lines]
    )


def _cross(at: npt.NDArray[np.float64], arms: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(start, step) of two lines in pixels; a landmark's base has one, as it is a place."""
    ends = np.diag(arms)
    return np.stack([at - ends, 2 * ends], axis=1)


def _lines_of(arrow: Arrow, spacing: tuple[float, float]) -> npt.NDArray[np.float64]:
    """(start, step) of every line, in pixels."""
    size = np.array(spacing)
    base, by = np.array(arrow.at) * size, np.array(arrow.by)
    head, length = base + by, math.hypot(*arrow.by)
    turn = np.linspace(0, 2 * np.pi, _SIDES + 1)
    outline = head + arrow.radius * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    starts, ends = [*outline[:-1]], [*outline[1:]]
    barb = _BARB * arrow.radius
    if length > 0.1 * arrow.radius:
        along = by / length
        across = np.array([-along[1], along[0]])
        back = min(barb, 0.5 * length)
        starts += [base, head, head]
        ends += [head, *(head - back * (along + side * 0.5 * across) for side in (-1, 1))]
    elif arrow.components == "both":  # held in place: a cross
        arms = np.diag([barb, barb])
        starts += [*(head - arms)]
        ends += [*(head + arms)]
    first, last = np.array(starts) / size, np.array(ends) / size
    return np.stack([first, last - first], axis=1)
