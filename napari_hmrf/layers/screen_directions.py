"""Which way rows and columns run in a viewer, and which side of the patient is at each edge."""

from __future__ import annotations

from typing import Any, NamedTuple

from napari_hmrf.field.directions import Directions
from napari_hmrf.field.frame import PATIENT_AXES, Frame
from napari_hmrf.layers.compat import camera_of


def ways_of(frame: Frame, viewer: Any) -> Directions:
    """The directions of a slice in a viewer, which may itself be turned upside down.

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
    """The side of the patient beyond each edge of the canvas: a letter, or "" if unknown."""

    top: str = ""
    bottom: str = ""
    left: str = ""
    right: str = ""

    @classmethod
    def of(cls, image: Any, viewer: Any) -> Sides:
        """Those of the slice of an image that a viewer shows, however it is turned; none in 3-D."""
        dims = viewer.dims
        if image is None or dims.ndisplay != 2:
            return cls()
        labels = ("",) * (dims.ndim - image.ndim) + image.axis_labels
        ends = [PATIENT_AXES.get(labels[axis], ("", "")) for axis in dims.displayed]
        down, right = (str(way) for way in camera_of(viewer).orientation2d)
        bottom, top = ends[0] if down == "down" else ends[0][::-1]
        end, begin = ends[1] if right == "right" else ends[1][::-1]
        return cls(top, bottom, begin, end)
