"""How drawn arrows look: as lines, of which a Vectors layer can hold any number.

An arrow is a line from where tissue was to where it goes, with two barbs; around its head lies the
outline of the patch that it holds. A landmark has a cross at its base, too. What speaks of one
direction only has a double arrow along that through its patch. What is selected has another
colour.

In a volume the patch is a ball: each slice shows the outline of what it cuts off that. All but the
shaft of an arrow lies in the slices that are looked at.
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
    spacing: Sequence[float],
    selected: int | None = None,
    across: int = 0,
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
    marks = [
        (mark, number == selected)
        for number, mark in enumerate(drawing.marks)
        if not isinstance(mark, Stroke)
    ]
    return coloured(
        (
            (_lines_of(mark, spacing, across), SELECTED if chosen else DRAWN)
            for mark, chosen in marks
        ),
        len(spacing),
    )


def coloured(parts: Iterable[tuple[npt.NDArray[Any], Sequence[float]]], axes: int = 2) -> Lines:
    """Lines of several colours together: (start, step) of some, and their colour."""
    lines, colours = [np.zeros((0, 2, axes))], [np.zeros((0, 4))]
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
    return layer_on(frame, np.zeros((0, 2, len(frame.plane))), NAME, known, look, "vectors")


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


def deep(
    lines: npt.NDArray[Any], across: int, depth: float | npt.NDArray[Any]
) -> npt.NDArray[np.float64]:
    """Lines of slices, (N, 2, 2), in their volume, where they lie so deep."""
    found: npt.NDArray[np.float64] = np.insert(lines.astype(float), across, 0.0, axis=-1)
    found[:, 0, across] = depth
    return found


def _lines_of(
    mark: Arrow | Landmark, spacing: Sequence[float], across: int
) -> npt.NDArray[np.float64]:
    """(start, step) of every line, in pixels."""
    arrow = mark.arrow(spacing) if isinstance(mark, Landmark) else mark
    size = np.array(spacing)
    base, by, radius = np.array(arrow.at) * size, np.array(arrow.by), arrow.radius
    n = len(size)
    flat = [axis for axis in range(n) if n == 2 or axis != across]
    only = {"row": n - 2, "col": n - 1}.get(arrow.components)
    way = flat.index(only) if only in flat else None
    there, held = _flat_lines(mark, arrow, base[flat], by[flat], way)
    if n == 2:
        return _lines([_circle(base + by, radius), there, held], size)
    low, high = base[across], base[across] + by[across]
    parts = [deep(there, across, low), deep(held, across, high)]
    parts[0][:1, 1, across] = by[across]  # the shaft leads all the way
    # Slices lie at whole pixels; the ball is as large in each as that cuts off it.
    nearest = round(high / size[across])
    reach = int(radius / size[across]) + 1
    for number in range(nearest - reach, nearest + reach + 1):
        left = radius**2 - (number * size[across] - high) ** 2
        if left > 0 or number == nearest:
            circle = _circle((base + by)[flat], math.sqrt(max(left, (radius / 4) ** 2)))
            parts.append(deep(circle, across, number * size[across]))
    return _lines(parts, size)


def _lines(
    parts: Sequence[npt.NDArray[np.float64]], size: npt.NDArray[Any]
) -> npt.NDArray[np.float64]:
    """Lines in lengths, as ones in pixels."""
    lines: npt.NDArray[np.float64] = np.concatenate(parts) / size
    return lines


def _circle(at: npt.NDArray[Any], radius: float) -> npt.NDArray[np.float64]:
    """(start, step) around a place, in lengths."""
    outline = at + radius * TURN
    return np.stack([outline[:-1], np.diff(outline, axis=0)], axis=1)


def _flat_lines(
    mark: Arrow | Landmark,
    arrow: Arrow,
    at: npt.NDArray[Any],
    step: npt.NDArray[Any],
    way: int | None,
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """What lies where an arrow begins, shaft first, and at its head; `way`: all it speaks of."""
    base, by, radius, length = at[None], step[None], arrow.radius, math.hypot(*arrow.by)
    head, barb = base + by, _BARB * radius
    there, held = [np.zeros((0, 2, 2))], [np.zeros((0, 2, 2))]
    if length > 0.1 * radius and step.any():
        shaft, *barbs = barbed(base, by, min(barb, 0.5 * length))[:, None]
        there.append(shaft)
        held += barbs
    elif length > 0.1 * radius:  # straight out of the slice
        there.append(np.stack([base, by], axis=1))
    elif arrow.components == "both":  # held in place
        held.append(crosses(head, barb * np.eye(2)))
    if way is not None:
        held.append(double_arrows(head, way, _BEYOND * radius))
    if isinstance(mark, Landmark):  # its base is a place, too
        there.append(crosses(base, 0.5 * barb * np.eye(2)))
    return np.concatenate(there), np.concatenate(held)
