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
from collections.abc import Iterable, Iterator, Sequence
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
    parts = [
        (_lines_of(mark, spacing, across), SELECTED if number == selected else DRAWN)
        for number, mark in enumerate(drawing.marks)
        if not isinstance(mark, Stroke)
    ]
    return coloured(parts, len(spacing))


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


def double_arrows(
    at: npt.NDArray[Any], along: npt.NDArray[Any], across: npt.NDArray[Any]
) -> npt.NDArray[np.float64]:
    """Lines one way with two barbs at either end: what says nothing of the other ways.

    Parameters
    ----------
    at : ndarray, shape (N, n)
        Their middles, in the unit of the spacing.
    along, across : ndarray, shape (n,)
        Half of each, and as far to the side to which the barbs point.

    Returns
    -------
    ndarray, shape (5 N, 2, n), float64
        (start, step) of each line, in the unit of the spacing.
    """
    barbs = [
        (end * along, _TIP * (side * across - end * along)) for end in (-1, 1) for side in (-1, 1)
    ]
    return _at_each(at, [(-along, 2 * along), *barbs])


def barbed(
    at: npt.NDArray[Any],
    by: npt.NDArray[Any],
    back: npt.NDArray[Any] | float,
    plane: npt.NDArray[Any],
) -> npt.NDArray[np.float64]:
    """Arrows: shafts, and two barbs at the head of each.

    Parameters
    ----------
    at, by : ndarray, shape (N, n)
        Where they begin, and how far they go, which is not straight out of the plane; in the unit
        of the spacing.
    back : float or ndarray, shape (N, 1)
        How far the barbs go back along the shaft.
    plane : ndarray, shape (2, n)
        The two ways in which the barbs lie.

    Returns
    -------
    ndarray, shape (3 N, 2, n), float64
        (start, step) of each line, in the unit of the spacing.
    """
    along = by @ plane.T
    along = along / np.linalg.norm(along, axis=-1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    tips = [-back * (along + side * 0.5 * across) @ plane for side in (-1, 1)]
    barbs = [np.stack([at + by, tip], axis=1) for tip in tips]
    return np.concatenate([np.stack([at, by], axis=1), *barbs])


def crosses(at: npt.NDArray[Any], arms: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """(start, step) of two lines through each of some places, (N, n), along two `arms`, (2, n)."""
    return _at_each(at, [(-arm, 2 * arm) for arm in arms])


def _at_each(at: npt.NDArray[Any], lines: Iterable[Any]) -> npt.NDArray[np.float64]:
    """The same lines, (start, step) each, at each of some places."""
    return np.concatenate(
        [np.stack([at + start, np.broadcast_to(step, at.shape)], axis=1) for start, step in lines]
    )


def _lines_of(
    mark: Arrow | Landmark, spacing: Sequence[float], across: int
) -> npt.NDArray[np.float64]:
    """(start, step) of every line, in pixels."""
    arrow = mark.arrow(spacing) if isinstance(mark, Landmark) else mark
    size, n = np.array(spacing), len(spacing)
    flat = [axis for axis in range(n) if n == 2 or axis != across]
    axes = np.eye(n)
    plane = axes[flat]
    base, by, radius = np.array([arrow.at]) * size, np.array([arrow.by]), arrow.radius
    head, barb, length = base + by, _BARB * radius, math.hypot(*arrow.by)
    circles = [(0.0, radius)] if n == 2 else _cuts(head[0, across], radius, size[across])
    parts = []
    for off, cut in circles:
        outline = head + off * axes[across] + cut * TURN @ plane
        parts.append(np.stack([outline[:-1], np.diff(outline, axis=0)], axis=1))
    if length > 0.1 * radius and by[:, flat].any():
        parts.append(barbed(base, by, min(barb, 0.5 * length), plane))
    elif length > 0.1 * radius:  # straight out of the slice
        parts.append(np.stack([base, by], axis=1))
    elif arrow.components == "both":  # held in place
        parts.append(crosses(head, barb * plane))
    only = {"row": n - 2, "col": n - 1}.get(arrow.components)
    if only in flat:
        way = flat.index(only)
        parts.append(double_arrows(head, *(_BEYOND * radius * plane[[way, 1 - way]])))
    if isinstance(mark, Landmark):  # its base is a place, too
        parts.append(crosses(base, 0.5 * barb * plane))
    lines: npt.NDArray[np.float64] = np.concatenate(parts) / size
    return lines


def _cuts(at: float, radius: float, step: float) -> Iterator[tuple[float, float]]:
    """How far off each slice lies that cuts a ball, and the radius of what it cuts off."""
    nearest, reach = round(at / step), int(radius / step) + 1
    for number in range(nearest - reach, nearest + reach + 1):  # slices lie at whole pixels
        off = number * step - at
        left = radius**2 - off**2
        if left > 0 or number == nearest:
            yield off, math.sqrt(max(left, (radius / 4) ** 2))
