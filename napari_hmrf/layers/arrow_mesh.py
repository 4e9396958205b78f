"""Triangles of arrows and lines: a dark outline, and a head that stays visible.

napari draws the head of an arrow as a quarter of its length, so that a short arrow looks like a
dot. It draws no outline, so that an orange arrow disappears on a red label, and a blue line on
bright tissue.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

#: Numbers of vertices and triangles with which napari draws an arrow, and a line without a head.
_ARROW, _LINE = (7, 3), (4, 2)
#: Smallest length of a head, and the half-width of each head, in widths of the shaft.
_HEAD, _HALF = 2.0, 1.0
#: Width of the outline of an arrow on each side, in widths of the shaft.
_OUTLINE = 0.3
#: The same for lines, which are thinner than arrows on the screen.
_LINE_OUTLINE = 0.5
#: Red, green and blue of the outline.
_DARK = (0.05, 0.05, 0.05)


def outlined(vertices: Array, faces: Array, colours: Array) -> tuple[Array, Array, Array] | None:
    """Return the triangles of arrows or lines with an outline, and a minimum size of the heads.

    Every tip stays in its place. An arrow that is shorter than its head is drawn as the head only.
    All outlines are drawn below all arrows or lines, so that lines that meet look continuous.

    Parameters
    ----------
    vertices : ndarray, shape (7 N, 2) or (4 N, 2)
        Corners of N arrows of napari: two at the start, four at the base of the head, and the tip;
        or corners of N lines of napari: two at the start, and two at the end.
    faces : ndarray of int, shape (3 N, 3) or (2 N, 3)
        Indices of the corners of each triangle.
    colours : ndarray, shape (3 N, 4) or (2 N, 4)
        Red, green, blue and opacity of each triangle, from 0 to 1.

    Returns
    -------
    vertices, faces, colours : ndarray, or None
        Triangles with twice as many corners, outlines first; None if the triangles represent
        neither arrows nor lines in a plane.
    """
    for (corners, triangles), draw in ((_ARROW, _outlined_arrows), (_LINE, _outlined_lines)):
        count = len(vertices) // corners
        shapes = (corners * count, 2), (triangles * count, 3), (triangles * count, 4)
        if count and (vertices.shape, faces.shape, colours.shape) == shapes:
            outline, fill = draw(np.asarray(vertices, dtype=np.float64).reshape(count, corners, 2))
            dark = np.array(colours)
            dark[:, :3] = _DARK
            return (
                np.concatenate([outline, fill]).reshape(-1, 2).astype(vertices.dtype),
                np.concatenate([faces, faces + len(vertices)]).astype(faces.dtype),
                np.concatenate([dark, colours]),
            )
    return None


def _outlined_arrows(corners: Array) -> tuple[Array, Array]:
    """Return the corners, (N, 7, 2), of the outlines and of the arrows."""
    start, tip = corners[:, :2].mean(axis=1), corners[:, 6]
    width = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=-1, keepdims=True)
    length = np.linalg.norm(tip - start, axis=-1, keepdims=True)
    # An arrow of length 0, as at 0 % of a deformation, has no direction and is not drawn.
    way = _directions(tip - start)
    head = np.maximum(0.25 * length, _HEAD * width)
    back, border, wide = np.maximum(length, head), _OUTLINE * width, _HALF * width
    # Distance from the tip to the tip of the outline, which is equally wide along all sides.
    ahead = _OUTLINE / _HALF * np.hypot(head, wide)
    longer = head + ahead + border
    wider = wide * np.divide(longer, head, out=np.ones_like(head), where=head > 0)
    outline = _arrows(
        tip + ahead * way, way, back + ahead + border, longer, 0.5 * width + border, wider
    )
    return outline, _arrows(tip, way, back, head, 0.5 * width, wide)


def _outlined_lines(corners: Array) -> tuple[Array, Array]:
    """Return the corners, (N, 4, 2), of the outlines and of the lines."""
    across = corners[:, 1] - corners[:, 0]
    border = _LINE_OUTLINE * np.linalg.norm(across, axis=-1, keepdims=True)
    ahead = border * _directions(corners[:, 2:].mean(axis=1) - corners[:, :2].mean(axis=1))
    aside = border * _directions(across)
    steps = np.stack([-ahead - aside, aside - ahead, ahead - aside, ahead + aside], axis=1)
    return corners + steps, corners


def _directions(steps: Array) -> Array:
    """Return steps, (N, 2), with length 1; a step of length 0 stays 0."""
    length = np.linalg.norm(steps, axis=-1, keepdims=True)
    ways: Array = np.divide(steps, length, out=np.zeros_like(steps), where=length > 0)
    return ways


def _arrows(tip: Array, way: Array, back: Array, head: Array, half: Array, wide: Array) -> Array:
    """Return the corners of arrows, (N, 7, 2), in the order of napari.

    Parameters
    ----------
    tip, way : ndarray, shape (N, 2)
        Tips, and directions with length 1 (or 0 for arrows that are not drawn).
    back, head : ndarray, shape (N, 1)
        Distances from the tip to the start of the shaft and to the base of the head.
    half, wide : ndarray, shape (N, 1)
        Half of the width of the shaft and of the head.
    """
    aside = np.stack([-way[:, 1], way[:, 0]], axis=-1)
    start, base = tip - back * way, tip - head * way
    shaft, sides = half * aside, wide * aside
    corners = [start - shaft, start + shaft, base - shaft, base + shaft, base - sides, base + sides]
    stacked: Array = np.stack([*corners, tip], axis=1)
    return stacked
