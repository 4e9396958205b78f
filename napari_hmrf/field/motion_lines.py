"""Lines that show prescribed motion: arrows, double arrows, crosses and outlines of patches.

Lines are arrays of (start, step), shape (N, 2, n). An arrow, with two barbs at its head, shows a
displacement. A double arrow shows that only one component is prescribed. A cross shows that tissue
is fixed. In a volume all lines except the shafts of arrows are in the plane of a slice.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Float64Array = npt.NDArray[np.float64]
#: Lines, (N, 2, n), and their colours, (N, 4): red, green, blue and opacity, from 0 to 1.
Lines = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]

_ANGLES = np.linspace(0, 2 * np.pi, 21)
#: Points (row, col) on a circle of radius 1 around the origin.
CIRCLE = np.stack([np.sin(_ANGLES), np.cos(_ANGLES)], axis=-1)
#: Length of the barbs, and half-width of the cross on fixed tissue, in radii of the patch.
_BARB = 0.5
#: Half-length of a double arrow, in radii of the patch; its barbs, relative to the half-length.
_BEYOND, _TIP = 1.4, 0.25
#: Largest radius of a circle of uncertainty, relative to the longest side of the image.
_LARGEST_SPREAD = 0.5
#: Directions of the arms of the crosses in `motion_marks`.
_X = np.array([[1.0, 1.0], [1.0, -1.0]])


def coloured(parts: Iterable[tuple[Array, Sequence[float]]], axes: int = 2) -> Lines:
    """Concatenate groups of lines that each have one colour.

    Parameters
    ----------
    parts : iterable of (ndarray, sequence of float)
        Lines of each group, shape (N, 2, n), and their colour (red, green, blue, opacity).
    axes : int
        Number n of axes.

    Returns
    -------
    lines : ndarray, shape (M, 2, n), float32
    colours : ndarray, shape (M, 4), float32
    """
    lines, colours = [np.zeros((0, 2, axes))], [np.zeros((0, 4))]
    for drawn, colour in parts:
        lines.append(drawn)
        colours.append(np.tile(colour, (len(drawn), 1)))
    return np.concatenate(lines).astype(np.float32), np.concatenate(colours).astype(np.float32)


def along(places: Array) -> Array:
    """Connect consecutive points, shape (N, n), by N - 1 lines."""
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
    spread: float = 0.0,
    shape: Sequence[int] | None = None,
) -> Float64Array:
    """Return lines that show the prescribed motion of a round patch of tissue.

    An arrow points from the centre of the patch to its moved position, and the outline of the patch
    surrounds the head of the arrow. In a volume the patch is a ball, and each slice shows the
    circle in which the slice intersects the ball.

    Parameters
    ----------
    at : sequence of float, shape (n,)
        Centre of the patch, in pixels.
    by : sequence of float, shape (n,)
        Displacement of the patch, in the unit of the spacing.
    radius : float
        Radius of the patch, in the unit of the spacing.
    spacing : sequence of float, shape (n,)
        Size of a pixel along each axis.
    across : int
        Axis perpendicular to the displayed slices, for a volume.
    only : int, optional
        Axis of the prescribed component, if only one component is prescribed.
    is_place : bool
        If True, the start of the arrow is also marked with a cross, as for a landmark.
    spread : float
        Standard deviation of the moved position, in the unit of the spacing. Above 0, the outline
        has this radius, or half the longest side of the image if this is smaller.
    shape : sequence of int, shape (n,), optional
        Shape of the image; by default, the size of the outline is not limited.

    Returns
    -------
    ndarray, shape (N, 2, n), float64
        Lines in pixels.
    """
    size, n = np.array(spacing), len(spacing)
    flat = [axis for axis in range(n) if n == 2 or axis != across]
    axes = np.eye(n)
    plane = axes[flat]
    base, step = np.array([at]) * size, np.array([by])
    head, barb, length = base + step, _BARB * radius, math.hypot(*by)
    outline, planes = spread or radius, None
    if shape is not None:
        sides = size * shape
        most = _LARGEST_SPREAD * sides.max() if spread else np.linalg.norm(sides)
        outline, planes = min(outline, float(most)), shape[across]
    circles = [(0.0, outline)]
    if n == 3:
        circles = [*_cuts(head[0, across], outline, size[across], planes)]
    parts = [along(head + off * axes[across] + cut * CIRCLE @ plane) for off, cut in circles]
    if length > 0.1 * radius and step[:, flat].any():
        parts.append(barbed(base, step, min(barb, 0.5 * length), plane))
    elif length > 0.1 * radius:  # perpendicular to the slice
        parts.append(np.stack([base, step], axis=1))
    elif only is None:  # fixed
        parts.append(crosses(head, barb * plane))
    if only in flat:
        way = flat.index(only)
        parts.append(double_arrows(head, *(_BEYOND * radius * plane[[way, 1 - way]])))
    if is_place:
        parts.append(crosses(base, 0.5 * barb * plane))
    lines: Float64Array = np.concatenate(parts) / size
    return lines


def motion_marks(at: Array, by: Array, known: Array, apart: float) -> Float64Array:
    """Return a mark for the prescribed motion of each site: an arrow, a cross or a double arrow.

    In a volume the marks are in planes perpendicular to the first axis.

    Parameters
    ----------
    at, by : ndarray, shape (N, n)
        Positions and displacements of the sites, in the unit of the spacing.
    known : ndarray of bool, shape (N, n)
        Mask of the prescribed components.
    apart : float
        Distance between neighbouring marks, in the unit of the spacing.

    Returns
    -------
    ndarray, shape (M, 2, n), float64
        Lines in the unit of the spacing.
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
    """Return lines with two barbs at each end, which mark motion with one prescribed component.

    Parameters
    ----------
    at : ndarray, shape (N, n)
        Centres of the lines, in the unit of the spacing.
    way, aside : ndarray, shape (n,)
        Half of each line, and a perpendicular vector of equal length in the plane of the barbs.

    Returns
    -------
    ndarray, shape (5 N, 2, n), float64
        Lines in the unit of the spacing.
    """
    barbs = [(end * way, _TIP * (side * aside - end * way)) for end in (-1, 1) for side in (-1, 1)]
    return _at_each(at, [(-way, 2 * way), *barbs])


def barbed(at: Array, by: Array, back: Array | float, plane: Array) -> Float64Array:
    """Return the lines of arrows, each with a shaft and two barbs.

    Parameters
    ----------
    at, by : ndarray, shape (N, n)
        Starts and steps of the arrows, in the unit of the spacing. No step may be perpendicular to
        the plane.
    back : float or ndarray, shape (N, 1)
        Length of the barbs along the shaft, in the unit of the spacing.
    plane : ndarray, shape (2, n)
        Orthonormal vectors of the plane of the barbs.

    Returns
    -------
    ndarray, shape (3 N, 2, n), float64
        Lines in the unit of the spacing.
    """
    way = by @ plane.T
    way = way / np.linalg.norm(way, axis=-1, keepdims=True)
    aside = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    tips = [-back * (way + side * 0.5 * aside) @ plane for side in (-1, 1)]
    barbs = [np.stack([at + by, tip], axis=1) for tip in tips]
    return np.concatenate([np.stack([at, by], axis=1), *barbs])


def crosses(at: Array, arms: Array) -> Float64Array:
    """Return two lines through each point `at`, (N, n), along the two `arms`, (2, n)."""
    return _at_each(at, [(-arm, 2 * arm) for arm in arms])


def _at_each(at: Array, lines: Iterable[Any]) -> Float64Array:
    """Repeat lines, given as (start, step), at each point `at`, (N, n)."""
    return np.concatenate(
        [np.stack([at + start, np.broadcast_to(step, at.shape)], axis=1) for start, step in lines]
    )


def _cuts(
    at: float, radius: float, step: float, planes: int | None
) -> Iterator[tuple[float, float]]:
    """Yield, for each slice of a ball, the offset from the centre and the radius of the circle.

    With a number of `planes`, only the slices of the volume and the nearest slice are yielded.
    """
    nearest, reach = round(at / step), int(radius / step) + 1
    first, last = nearest - reach, nearest + reach
    if planes is not None:
        first, last = min(max(first, 0), nearest), max(min(last, planes - 1), nearest)
    for number in range(first, last + 1):
        off = number * step - at
        left = radius**2 - off**2
        if left > 0 or number == nearest:
            yield off, math.sqrt(max(left, (radius / 4) ** 2))
