"""Lines that show motion which is given: arrows, double arrows, crosses and outlines of patches.

Lines are (start, step) each, shape (N, 2, n). An arrow has two barbs at its head. A double arrow
speaks of one direction only, and a cross lies where tissue stays. In a volume all but the shafts
of arrows lies in a plane, that of a slice which is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Float64Array = npt.NDArray[np.float64]
#: Lines, and the colour of each: red, green, blue and opacity, 0 to 1.
Lines = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]

_ANGLES = np.linspace(0, 2 * np.pi, 21)
#: A circle of radius 1, (row, col) around its middle.
CIRCLE = np.stack([np.sin(_ANGLES), np.cos(_ANGLES)], axis=-1)
#: Length of the barbs and of the cross where tissue is held, in radii of the patch.
_BARB = 0.5
#: How far a double arrow goes, in radii of the patch, and the length of its barbs in parts of that.
_BEYOND, _TIP = 1.4, 0.25
#: The arms of the crosses among marks.
_X = np.array([[1.0, 1.0], [1.0, -1.0]])


def coloured(parts: Iterable[tuple[Array, Sequence[float]]], axes: int = 2) -> Lines:
    """Lines of several colours together: (start, step) of some, and their colour."""
    lines, colours = [np.zeros((0, 2, axes))], [np.zeros((0, 4))]
    for drawn, colour in parts:
        lines.append(drawn)
        colours.append(np.tile(colour, (len(drawn), 1)))
    return np.concatenate(lines).astype(np.float32), np.concatenate(colours).astype(np.float32)


def along(places: Array) -> Array:
    """Lines from each of some places, (N, n), to the next."""
    return np.stack([places[:-1], np.diff(places, axis=0)], axis=1)


def patch_lines(
    at: Sequence[float],
    by: Sequence[float],
    radius: float,
    spacing: Sequence[float],
    *,
    across: int = 0,
    only: int | None = None,
    is_place: bool = False,
) -> Float64Array:
    """Lines that show how a round patch of tissue is to move.

    An arrow leads from where it was to where it goes; around its head lies the patch's outline. In
    a volume the patch is a ball: each slice shows the outline of what it cuts off that.

    Parameters
    ----------
    at : sequence of float, shape (n,)
        The middle of the patch, in pixels.
    by : sequence of float, shape (n,)
        How far it moves, in the unit of the spacing.
    radius : float
        In the unit of the spacing.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    across : int
        Of a volume: the axis across the slices that are looked at.
    only : int, optional
        The one axis of which the motion speaks.
    is_place : bool
        Whether where it was is a place that was found, and has a cross, too.

    Returns
    -------
    ndarray, shape (N, 2, n), float64
        In pixels.
    """
    size, n = np.array(spacing), len(spacing)
    flat = [axis for axis in range(n) if n == 2 or axis != across]
    axes = np.eye(n)
    plane = axes[flat]
    base, step = np.array([at]) * size, np.array([by])
    head, barb, length = base + step, _BARB * radius, math.hypot(*by)
    circles = [(0.0, radius)] if n == 2 else _cuts(head[0, across], radius, size[across])
    parts = [along(head + off * axes[across] + cut * CIRCLE @ plane) for off, cut in circles]
    if length > 0.1 * radius and step[:, flat].any():
        parts.append(barbed(base, step, min(barb, 0.5 * length), plane))
    elif length > 0.1 * radius:  # straight out of the slice
        parts.append(np.stack([base, step], axis=1))
    elif only is None:  # held in place
        parts.append(crosses(head, barb * plane))
    if only in flat:
        way = flat.index(only)
        parts.append(double_arrows(head, *(_BEYOND * radius * plane[[way, 1 - way]])))
    if is_place:
        parts.append(crosses(base, 0.5 * barb * plane))
    lines: Float64Array = np.concatenate(parts) / size
    return lines


def motion_marks(at: Array, by: Array, known: Array, apart: float) -> Float64Array:
    """Marks that say what tissue does at some places: stays, moves, or is free one way.

    In a volume they lie across its first axis.

    Parameters
    ----------
    at, by : ndarray, shape (N, n)
        The places, and how far tissue moves there, in the unit of the spacing.
    known : ndarray of bool, shape (N, n)
        Of which axes that is known.
    apart : float
        The room that each has.

    Returns
    -------
    ndarray, shape (M, 2, n), float64
        In the unit of the spacing.
    """
    plane = np.eye(at.shape[-1])[-2:]
    by = np.where(known, by, 0) @ plane.T @ plane
    both, moves = np.asarray(known.all(axis=-1)), by.any(axis=-1)
    one, reach = known[:, -2:] & ~both[:, None], 0.35 * apart * plane
    back = 0.35 * np.linalg.norm(by[moves], axis=-1, keepdims=True)
    return np.concatenate(
        [
            barbed(at[moves], by[moves], back, plane),
            crosses(at[both & ~moves], 0.2 * apart * _X @ plane),
            double_arrows(at[one[:, 0]], *reach),
            double_arrows(at[one[:, 1]], *reach[::-1]),
        ]
    )


def double_arrows(at: Array, way: Array, aside: Array) -> Float64Array:
    """Lines one way with two barbs at either end: what says nothing of the other ways.

    Parameters
    ----------
    at : ndarray, shape (N, n)
        Their middles, in the unit of the spacing.
    way, aside : ndarray, shape (n,)
        Half of each, and as far to the side to which the barbs point.

    Returns
    -------
    ndarray, shape (5 N, 2, n), float64
        In the unit of the spacing.
    """
    barbs = [(end * way, _TIP * (side * aside - end * way)) for end in (-1, 1) for side in (-1, 1)]
    return _at_each(at, [(-way, 2 * way), *barbs])


def barbed(at: Array, by: Array, back: Array | float, plane: Array) -> Float64Array:
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
        In the unit of the spacing.
    """
    way = by @ plane.T
    way = way / np.linalg.norm(way, axis=-1, keepdims=True)
    aside = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    tips = [-back * (way + side * 0.5 * aside) @ plane for side in (-1, 1)]
    barbs = [np.stack([at + by, tip], axis=1) for tip in tips]
    return np.concatenate([np.stack([at, by], axis=1), *barbs])


def crosses(at: Array, arms: Array) -> Float64Array:
    """Two lines through each of some places, (N, n), along two `arms`, (2, n)."""
    return _at_each(at, [(-arm, 2 * arm) for arm in arms])


def _at_each(at: Array, lines: Iterable[Any]) -> Float64Array:
    """The same lines, (start, step) each, at each of some places."""
    return np.concatenate(
        [np.stack([at + start, np.broadcast_to(step, at.shape)], axis=1) for start, step in lines]
    )


def _cuts(at: float, radius: float, step: float) -> Iterator[tuple[float, float]]:
    """How far off each slice lies that cuts a ball, and the radius of what it cuts off."""
    nearest, reach = round(at / step), int(radius / step) + 1
    for number in range(nearest - reach, nearest + reach + 1):  # slices lie at whole pixels
        off = number * step - at
        left = radius**2 - off**2
        if left > 0 or number == nearest:
            yield off, math.sqrt(max(left, (radius / 4) ** 2))
