"""Lines of sight in napari's 3-D view, and the plane that a layer is cut by."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.frame import Frame
from napari_hmrf.field.volume_preview import CutPlane
from napari_hmrf.layers.slice_view import View
from napari_hmrf.tissue.drawing.marks import Point

Array = npt.NDArray[np.float64]
#: Distance between the points of a line at which tissue is looked up, in voxels.
_STEP = 0.5
#: Component of a direction below which a line is parallel to a face, in voxels.
_ALONG = 1e-12


@dataclass(frozen=True, eq=False)
class LineOfSight:
    """Line from the camera through a point of the canvas, in voxels of a volume.

    Attributes
    ----------
    start : ndarray, shape (3,)
        Point on the line, in voxels.
    ahead : ndarray, shape (3,)
        Unit vector away from the camera, in the unit of the spacing.
    spacing : ndarray, shape (3,)
        Size of a voxel along each axis.
    unit : float
        Length of one unit of the viewer, in the unit of the spacing.
    """

    start: Array
    ahead: Array
    spacing: Array
    unit: float = 1.0

    @classmethod
    def of(cls, event: Any, layer: Any, frame: Frame, view: View) -> LineOfSight | None:
        """Return the line at the mouse, or None if the view does not show the axes of the volume.

        Parameters
        ----------
        event : napari mouse event
        layer : napari.layers.Layer
            Layer on the grid of the volume.
        frame : Frame
            Frame of the volume.
        view : View
        """
        direction = getattr(event, "view_direction", None)
        return cls.through(event.position, direction, layer, frame, view)

    @classmethod
    def through(
        cls, position: Any, direction: Any, layer: Any, frame: Frame, view: View
    ) -> LineOfSight | None:
        """Return the line through a point, or None if the view does not show the volume.

        Parameters
        ----------
        position : sequence of float
            World coordinates of a point on the line.
        direction : sequence of float, optional
            Direction away from the camera in world coordinates; None in a 2-D view.
        layer, frame, view
            As for `of`.
        """
        if direction is None or not shows_volume(frame, view):
            return None
        plane, position = list(frame.plane), np.asarray(position, dtype=float)
        start = view.pixel(layer, position)[plane]
        end = view.pixel(layer, position + np.asarray(direction))[plane]
        spacing = np.array(frame.spacing)
        step = (end - start) * spacing
        unit = float(np.linalg.norm(step))
        return cls(start, step / unit, spacing, unit) if unit > 0 else None

    @property
    def step(self) -> Array:
        """Vector along the line of unit length, in voxels."""
        return self.ahead / self.spacing

    def nearest(self, points: Iterable[Point], reach: float) -> Point | None:
        """Return the point nearest to the line, or None if none is within `reach`."""
        away = {point: self._distance(point) for point in points}
        found = min(away, key=lambda point: away[point], default=None)
        return found if found is not None and away[found] <= reach else None

    def is_hidden(self, point: Point, seen: Point, margin: float) -> bool:
        """Return whether a point lies behind the point that is seen, by more than a margin.

        The margin is in the unit of the spacing.
        """
        behind = (np.asarray(point) - np.asarray(seen)) * self.spacing
        return float(behind @ self.ahead) > margin

    def beside(self, point: Point, ahead: Array) -> Point:
        """Return the point of the line on the plane through a point, perpendicular to `ahead`."""
        from_start = (np.asarray(point) - self.start) * self.spacing
        along = float(from_start @ ahead) / float(self.ahead @ ahead)
        return _as_point(self.start + self.step * along)

    def points_in(self, shape: Sequence[int]) -> Array:
        """Return points of the line inside a volume, (N, 3), from the camera onwards."""
        # A line along a face of the volume has no ends across this face.
        step = np.where(np.abs(self.step) < _ALONG, _ALONG, self.step)
        low, high = -0.5 - self.start, np.asarray(shape) - 0.5 - self.start
        ends = np.sort(np.stack([low, high]) / step, axis=0)
        first, last = float(ends[0].max()), float(ends[1].min())
        if not first < last:
            return np.empty((0, 3))
        count = math.ceil((last - first) * float(np.linalg.norm(self.step)) / _STEP)
        along = np.linspace(first, last, count + 1)
        return self.start + along[:, np.newaxis] * self.step

    def visible_points(self, layer: Any, cut: CutPlane | None, shape: Sequence[int]) -> Array:
        """Return the points, (N, 3), at which a visible volume can be seen, from the camera on.

        Parameters
        ----------
        layer : napari.layers.Image
            Visible layer on the grid of the volume.
        cut : CutPlane, optional
            Plane that the layer is cut by; see `cut_of`.
        shape : sequence of int
            Shape of the volume.
        """
        if cut is None:
            points = self.points_in(shape)
            return points[_is_drawn(layer, points, shape)]
        met = cut.meets(self.start, self.step)
        points = np.empty((0, 3)) if met is None else np.asarray(met)[np.newaxis]
        return points[((points >= -0.5) & (points <= np.array(shape) - 0.5)).all(axis=1)]

    def _distance(self, point: Point) -> float:
        away = (np.asarray(point) - self.start) * self.spacing
        return float(np.linalg.norm(away - self.ahead * float(away @ self.ahead)))


@dataclass(eq=False)
class DepthDrag:
    """Drag parallel to the screen, at a depth that can be changed.

    Attributes
    ----------
    begin : tuple of float
        Point that was grabbed, in voxels.
    line : LineOfSight
        Line of sight at the mouse.
    depth : float
        Distance that the point has moved away from the camera, in the unit of the spacing.
    """

    begin: Point
    line: LineOfSight
    depth: float = 0.0

    def __post_init__(self) -> None:
        self._ahead = self.line.ahead

    @property
    def point(self) -> Point:
        """Position of the grabbed point, in voxels."""
        at = np.asarray(self.begin) + self._ahead * self.depth / self.line.spacing
        return self.line.beside(_as_point(at), self._ahead)

    def push(self, steps: float) -> None:
        """Move the point away from the camera by a number of voxels."""
        self.depth += steps * float(self.line.spacing.min())


def shows_volume(frame: Frame, view: View) -> bool:
    """Return whether a 3-D view shows the three axes of a volume."""
    missing = len(view.point) - frame.ndim
    shown = sorted(axis - missing for axis in view.displayed)
    return len(frame.plane) == 3 and shown == sorted(frame.plane)


def cut_of(layer: Any, frame: Frame, view: View) -> CutPlane | None:
    """Return the plane that a layer shows in a 3-D view, or None if it shows its whole volume.

    Parameters
    ----------
    layer : napari.layers.Layer
        Layer on the grid of the volume.
    frame : Frame
        Frame of the volume.
    view : View
    """
    if str(getattr(layer, "depiction", "volume")) != "plane" or not shows_volume(frame, view):
        return None
    missing, plane = len(view.point) - frame.ndim, layer.plane
    # napari stores the plane in the order of the displayed axes.
    order = [view.displayed.index(axis + missing) for axis in frame.plane]
    position, normal = (
        tuple(float(each[at]) for at in order) for each in (plane.position, plane.normal)
    )
    return CutPlane(position, normal, float(plane.thickness))


def _is_drawn(layer: Any, points: Array, shape: Sequence[int]) -> npt.NDArray[np.bool_]:
    """Return which points, (N, 3), napari draws; others are below the threshold of a surface."""
    data = layer.data
    if str(layer.rendering) != "iso" or np.shape(data) != tuple(shape):
        return np.ones(len(points), bool)
    voxels = np.clip(np.rint(points).astype(np.intp), 0, np.array(shape) - 1)
    drawn: npt.NDArray[np.bool_] = np.asarray(data)[tuple(voxels.T)] >= layer.iso_threshold
    return drawn


def _as_point(values: Array) -> Point:
    return tuple(values.tolist())
