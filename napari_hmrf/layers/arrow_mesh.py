"""Triangles of the arrows of a result: a dark outline, and a head that stays visible.

napari draws the head of an arrow as a quarter of its length, so that a short arrow looks like a
dot. It draws no outline, so that an orange arrow disappears on a red label.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

#: Numbers of vertices and triangles with which napari draws an arrow.
_VERTICES, _TRIANGLES = 7, 3
#: Smallest length of a head, and the half-width of each head, in widths of the shaft.
_HEAD, _HALF = 2.0, 1.0
#: Width of the outline on each side, in widths of the shaft.
_OUTLINE = 0.3
#: Red, green and blue of the outline.
_DARK = (0.05, 0.05, 0.05)


def outlined(vertices: Array, faces: Array, colours: Array) -> tuple[Array, Array, Array] | None:
    """Return the triangles of arrows with an outline and a minimum size of the head.

    Every tip stays in its place. An arrow that is shorter than its head is drawn as the head only.

    Parameters
    ----------
    vertices : ndarray, shape (7 N, 2)
        Corners of N arrows of napari: two at the start, four at the base of the head, and the tip.
    faces : ndarray of int, shape (3 N, 3)
        Indices of the corners of each triangle.
    colours : ndarray, shape (3 N, 4)
        Red, green, blue and opacity of each triangle, from 0 to 1.

    Returns
    -------
    vertices, faces, colours : ndarray, or None
        Triangles with twice as many corners, outlines first; None if the triangles do not represent
        arrows in a plane.
    """
    count = len(vertices) // _VERTICES
    shapes = (_VERTICES * count, 2), (_TRIANGLES * count, 3), (_TRIANGLES * count, 4)
    if not count or (vertices.shape, faces.shape, colours.shape) != shapes:
        return None
    corners = np.asarray(vertices, dtype=np.float64).reshape(count, _VERTICES, 2)
    start, tip = corners[:, :2].mean(axis=1), corners[:, 6]
    width = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=-1, keepdims=True)
    length = np.linalg.norm(tip - start, axis=-1, keepdims=True)
    # An arrow of length 0, as at 0 % of a deformation, has no direction and is not drawn.
    way = np.divide(tip - start, length, out=np.zeros_like(start), where=length > 0)
    head = np.maximum(0.25 * length, _HEAD * width)
    back, border, wide = np.maximum(length, head), _OUTLINE * width, _HALF * width
    # Distance from the tip to the tip of the outline, which is equally wide along all sides.
    ahead = _OUTLINE / _HALF * np.hypot(head, wide)
    longer = head + ahead + border
    wider = wide * np.divide(longer, head, out=np.ones_like(head), where=head > 0)
    outline = _arrows(
        tip + ahead * way, way, back + ahead + border, longer, 0.5 * width + border, wider
    )
    fill = _arrows(tip, way, back, head, 0.5 * width, wide)
    dark = np.array(colours)
    dark[:, :3] = _DARK
    return (
        np.concatenate([outline, fill]).astype(vertices.dtype),
        np.concatenate([faces, faces + len(vertices)]).astype(faces.dtype),
        np.concatenate([dark, colours]),
    )


def _arrows(tip: Array, way: Array, back: Array, head: Array, half: Array, wide: Array) -> Array:
    """Return the corners of arrows in the order of napari.

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
    stacked: Array = np.stack([*corners, tip], axis=1).reshape(-1, 2)
    return stacked
