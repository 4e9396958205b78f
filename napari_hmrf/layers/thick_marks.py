"""Marks of single pixels, drawn thick enough to be seen at a low zoom."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.compat import camera_of

#: Smallest width of a mark, in screen pixels.
_WIDTH = 3.0


def half_widths(viewer: Any, frame: Frame) -> tuple[int, ...]:
    """Return by how many pixels a mark must extend along each axis of a layer to be visible.

    Marks extend along displayed axes only.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    frame : Frame
        Frame of the layer.
    """
    sizes = np.linalg.norm(np.array(frame.matrix)[:-1, :-1], axis=0)
    zoom, dims = float(camera_of(viewer).zoom), viewer.dims
    shown = {axis - dims.ndim + frame.ndim for axis in dims.displayed}
    return tuple(
        math.ceil(max(_WIDTH / (zoom * size) - 1, 0) / 2) if axis in shown else 0
        for axis, size in enumerate(sizes.tolist())
    )


def thickened(marks: npt.NDArray[Any], widths: Sequence[int]) -> npt.NDArray[Any]:
    """Return marks that extend by a number of pixels along each axis.

    Parameters
    ----------
    marks : ndarray
        Image with values above 0 at the marks.
    widths : sequence of int
        Result of `half_widths`.
    """
    axes = range(marks.ndim)
    box = []
    for axis in axes:
        there = np.flatnonzero(marks.any(axis=tuple({*axes} - {axis})))
        if not len(there):
            return marks
        box.append(slice(max(there[0] - widths[axis], 0), there[-1] + widths[axis] + 1))
    thick = marks.copy()
    near = thick[tuple(box)]  # marks are usually close to each other
    for axis, width in enumerate(widths):
        if width:
            near[...] = scipy.ndimage.maximum_filter1d(near, 2 * width + 1, axis, mode="constant")
    return thick
