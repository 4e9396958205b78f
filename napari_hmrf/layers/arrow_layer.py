"""How drawn arrows look: as lines, of which a Vectors layer can hold any number.

An arrow is a line from where tissue was to where it goes, with two barbs; around its head lies the
outline of the patch that it holds. A landmark has a cross at its base, too. What speaks of one
direction only has a double arrow along that through its patch. What is selected has another
colour.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.label_colours import DRAWN, SELECTED
from napari_hmrf.layers.result_layers import LayerData, layer_on
from napari_hmrf.tissue.drawing import Arrow, Drawing, Landmark, Stroke

FloatArray = npt.NDArray[np.float32]

#: (start, step) of each line, and its colour.
Lines = tuple[FloatArray, FloatArray]

NAME = "Motion"
#: The outline of a patch of radius 1, around its middle.
_ANGLES = np.linspace(0, 2 * np.pi, 21)
TURN = np.stack([np.sin(_ANGLES), np.cos(_ANGLES)], axis=-1)
#: Length of the barbs and of a pin's cross, in radii of the patch.
_BARB = 0.5
#: How far a double arrow goes, in radii of the patch, and the length of its barbs in parts of that.
_BEYOND, _TIP = 1.4, 0.25


def arrow_lines(
    drawing: Drawing,
    spacing: tuple[float, float],
    selected: int | None = None,
) -> Lines:
    """Lines that show a drawing's arrows and landmarks.

    Parameters
    ----------
    drawing : Drawing
    spacing : (float, float)
        Size of a pixel in (row, col) direction.
    selected : int, optional
        The number of the mark that is highlighted.

    Returns
    -------
    lines : ndarray, shape (N, 2, 2), float32
        (start, step) in pixels.
    colours : ndarray, shape (N, 4), float32
        Red, green, blue and opacity of each, 0 to 1.
    """
    marks = [
        (mark, number == selected)
        for number, mark in enumerate(drawing.marks)
        if not isinstance(mark, Stroke)
    ]
    return coloured(
        (_lines_of(mark, spacing), SELECTED if chosen else DRAWN) for mark, chosen in marks
    )


def coloured(parts: Iterable[tuple[npt.NDArray[Any], Sequence[float]]]) -> Lines:
    """Lines of several colours together: (start, step) of some, and their colour."""
    lines, colours = [np.zeros((0, 2, 2))], [np.zeros((0, 4))]
    for drawn, colour in parts:
        lines.append(drawn)
        colours.append(np.tile(colour, (len(drawn), 1)))
    return np.concatenate(lines).astype(np.float32), np.concatenate(colours).astype(np.float32)


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
    return layer_on(frame, np.zeros((0, 2, 2)), NAME, known, look, "vectors")


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
    return _at_each(at, [(-along, 2 * along), *barbs])


def barbed(
    at: npt.NDArray[Any], by: npt.NDArray[Any], back: npt.NDArray[Any] | float
) -> npt.NDArray[np.float64]:
    """Arrows: shafts, and two barbs at the head of each.

    Parameters
    ----------
    at, by : ndarray, shape (N, 2)
        Where they begin, and how far they go, which is not nowhere; in the unit of the spacing.
    back : float or ndarray, shape (N, 1)
        How far the barbs go back along the shaft.

    Returns
    -------
    ndarray, shape (3 N, 2, 2), float64
        (start, step) of each line, in the unit of the spacing.
    """
    along = by / np.linalg.norm(by, axis=-1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    barbs = [np.stack([at + by, -back * (along + side * 0.5 * across)], axis=1) for side in (-1, 1)]
    return np.concatenate([np.stack([at, by], axis=1), *barbs])


def crosses(at: npt.NDArray[Any], arms: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """(start, step) of two lines through each of some places, (N, 2), along two `arms`, (2, 2)."""
    return _at_each(at, [(-arm, 2 * arm) for arm in arms])


def _at_each(at: npt.NDArray[Any], lines: Iterable[Any]) -> npt.NDArray[np.float64]:
    """The same lines, (start, step) each, at each of some places."""
    return np.concatenate(
        [np.stack([at + start, np.broadcast_to(step, at.shape)], axis=1) for start, step in lines]
    )


def _lines_of(mark: Arrow | Landmark, spacing: tuple[float, float]) -> npt.NDArray[np.float64]:
    """(start, step) of every line, in pixels."""
    arrow = mark.arrow(spacing) if isinstance(mark, Landmark) else mark
    size, radius, length = np.array(spacing), arrow.radius, math.hypot(*arrow.by)
    base, by = np.array([arrow.at]) * size, np.array([arrow.by])
    head, barb = base + by, _BARB * radius
    outline = head + radius * TURN
    parts = [np.stack([outline[:-1], np.diff(outline, axis=0)], axis=1)]
    if length > 0.1 * radius:
        parts.append(barbed(base, by, min(barb, 0.5 * length)))
    elif arrow.components == "both":  # held in place
        parts.append(crosses(head, barb * np.eye(2)))
    if arrow.components != "both":
        axis = ("row", "col").index(arrow.components)
        parts.append(double_arrows(head, axis, _BEYOND * radius))
    if isinstance(mark, Landmark):  # its base is a place, too
        parts.append(crosses(base, 0.5 * barb * np.eye(2)))
    lines: npt.NDArray[np.float64] = np.concatenate(parts) / size
    return lines
