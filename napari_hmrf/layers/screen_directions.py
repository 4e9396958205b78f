"""Directions of the image axes on the canvas, and sides of the patient at the canvas edges."""

from __future__ import annotations

from typing import Any, NamedTuple

from napari_hmrf.field.directions import Directions
from napari_hmrf.field.frame import PATIENT_AXES, Frame
from napari_hmrf.layers.compat import camera_of


def directions_of(frame: Frame, viewer: Any) -> Directions:
    """Return the directions of the axes of a slice on the canvas, including camera flips.

    Parameters
    ----------
    frame : Frame
    viewer : napari.Viewer or ViewerModel
    """
    drawn, missing = frame.plane[-2:], viewer.dims.ndim - frame.ndim
    if len(frame.plane) == 3:
        drawn = tuple(axis - missing for axis in viewer.dims.displayed[-2:])
    down, right = (str(way) for way in camera_of(viewer).orientation2d)
    return Directions.of(frame, drawn, (down, right))


class Sides(NamedTuple):
    """Sides of the patient at the edges of the canvas, as letters; "" if unknown."""

    top: str = ""
    bottom: str = ""
    left: str = ""
    right: str = ""

    @classmethod
    def of(cls, image: Any, viewer: Any) -> Sides:
        """Return the sides for the visible slice of an image; all sides are "" in a 3-D view."""
        dims = viewer.dims
        if image is None or dims.ndisplay != 2:
            return cls()
        labels = ("",) * (dims.ndim - image.ndim) + image.axis_labels
        ends = [PATIENT_AXES.get(labels[axis], ("", "")) for axis in dims.displayed]
        down, right = (str(way) for way in camera_of(viewer).orientation2d)
        bottom, top = ends[0] if down == "down" else ends[0][::-1]
        end, begin = ends[1] if right == "right" else ends[1][::-1]
        return cls(top, bottom, begin, end)
