"""Visible slice of a layer in a viewer: its frame, its pixels, and its directions."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from napari.layers import Points, Shapes, Vectors

from napari_hmrf.errors import HmrfError, LayerError
from napari_hmrf.field.directions import Directions
from napari_hmrf.field.drawn_slice import pixel_drawn, sliders_at
from napari_hmrf.field.frame import PATIENT_AXES, Frame, as_tuples, is_flat
from napari_hmrf.field.units import unit_factor, unit_name
from napari_hmrf.layers.compat import camera_of
from napari_hmrf.layers.metadata import file_axes_of
from napari_hmrf.study.session import Session


@dataclass(frozen=True)
class View:
    """Visible slice of a viewer: an immutable copy of the relevant attributes of its `Dims`.

    Attributes
    ----------
    displayed : tuple of int
        Displayed world axes, in the order (rows, columns).
    point : tuple of float
        World coordinates of a point on the slice.
    units : tuple of str, optional
        Units of `point`, if the viewer has units.
    sliders : tuple of (float, float)
        Start and step of the slider of each axis; empty without a viewer.
    volume : bool
        True if the whole volume is selected instead of the visible slice.
    """

    displayed: tuple[int, ...]
    point: tuple[float, ...]
    units: tuple[str, ...] | None = None
    sliders: tuple[tuple[float, float], ...] = field(default=(), compare=False)
    volume: bool = False

    @classmethod
    def of(cls, dims: Any, volume: bool = False) -> View:
        """Return the view for the `Dims` of a viewer."""
        units = getattr(dims, "units", None)
        return cls(
            tuple(int(axis) for axis in dims.displayed),
            tuple(float(value) for value in dims.point),
            None if units is None else tuple(map(unit_name, units)),
            tuple((float(span.start), float(span.step)) for span in dims.range),
            volume,
        )

    def factors(self, layer: Any) -> npt.NDArray[np.float64]:
        """Return the factors that convert the viewer's units to those of a layer or frame."""
        if self.units is None:
            return np.ones(layer.ndim)
        units = zip(self.units[-layer.ndim :], layer.units, strict=True)
        return np.array([unit_factor(unit, unit_name(to)) for unit, to in units])

    def sliders_of(self, layer: Any) -> tuple[tuple[float, float], ...]:
        """Return the start and step of the slider for each layer axis, in the layer's units."""
        sliders = zip(self.sliders[-layer.ndim :], self.factors(layer).tolist(), strict=False)
        return tuple((start * factor, step * factor) for (start, step), factor in sliders)

    def pixel(self, layer: Any, position: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return the pixels of a layer or frame at world positions of shape (..., axes)."""
        world = np.nan_to_num(np.asarray(position)[..., -layer.ndim :] * self.factors(layer))
        return pixel_drawn(matrix_of(layer), self._drawn(layer), world)

    def point_at(self, layer: Any, pixel: npt.ArrayLike) -> dict[int, float]:
        """Return the slider positions that show a pixel of a layer or frame, by world axis.

        The result has an entry for each axis of the layer that is not displayed.
        """
        positions = sliders_at(matrix_of(layer), self._drawn(layer), pixel)
        missing, factors = len(self.point) - layer.ndim, self.factors(layer)
        return {axis + missing: at / factors[axis] for axis, at in positions.items()}

    def tilts(self, layer: Any) -> bool:
        """Return whether a layer or frame is tilted out of its slices; napari ignores the tilt."""
        linear, drawn = matrix_of(layer)[:-1, :-1], self._drawn(layer)
        others = [axis for axis in range(layer.ndim) if axis not in drawn]
        mixed = np.abs(linear[np.ix_(others, drawn)]).max(initial=0)
        return bool(mixed > 1e-6 * np.abs(linear).max())

    def _drawn(self, layer: Any) -> list[int]:
        missing = len(self.point) - layer.ndim
        return [axis - missing for axis in self.displayed if axis >= missing]


def matrix_of(layer: Any) -> npt.NDArray[np.float64]:
    """Return the homogeneous matrix that maps pixels of a layer or frame to world coordinates."""
    if isinstance(layer, Frame):
        return np.array(layer.matrix)
    ndim = int(layer.ndim)
    corners = np.concatenate([np.zeros((1, ndim)), np.eye(ndim)])
    origin, *ends = (np.asarray(layer.data_to_world(corner), float) for corner in corners)
    matrix = np.eye(ndim + 1)
    matrix[:ndim, :ndim] = np.stack(ends, axis=1) - origin[:, None]
    matrix[:ndim, ndim] = origin
    return matrix


def view_of(viewer: Any, session: Session) -> View:
    """Return the view of the visible slice, or of the volume if a volume is deformed.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    session : Session
        Session with the extent that is chosen.
    """
    return View.of(viewer.dims, session.choice.is_volume)


def frame_of(layer: Any, view: View | None = None) -> Frame:
    """Return the frame of the visible slice of a layer, or of its whole volume.

    Parameters
    ----------
    layer : napari.layers.Layer
    view : View, optional
        Visible slice; by default, the first slice along the last two axes.

    Raises
    ------
    ProblemError
        If the transform or the units of the layer are invalid, if the layer lacks a displayed axis,
        or if the visible slice is oblique to the axes of the layer or outside the layer.
    """
    matrix = matrix_of(layer)
    if not np.isfinite(matrix).all() or is_flat(matrix[:-1, :-1]):
        raise LayerError(
            layer,
            "has a scale, translation, rotation or affine that contains NaN or infinity, or is "
            "singular. Set an invertible transform.",
        )
    plane = _axes_of(layer, view)
    index = _index_on(layer, matrix, plane, view)
    units = [unit_name(layer.units[axis]) for axis in plane]
    if np.isnan([unit_factor(unit, units[-1]) for unit in units]).any():
        raise LayerError(
            layer,
            f"has axes in {' and '.join(dict.fromkeys(units))}. Use units of length for all axes.",
        )
    return Frame(
        plane=plane,
        index=index,
        scale=as_tuples(layer.scale),
        translate=as_tuples(layer.translate),
        rotate=as_tuples(layer.rotate),
        shear=as_tuples(layer.shear),
        affine=as_tuples(layer.affine.affine_matrix),
        units=tuple(map(unit_name, layer.units)),
        axis_labels=tuple(str(label) for label in layer.axis_labels),
        matrix=as_tuples(matrix),
        file_axes=file_axes_of(layer),
        sliders=() if view is None else view.sliders_of(layer),
    )


def _axes_of(layer: Any, view: View | None) -> tuple[int, ...]:
    """Return the axes of a layer's volume, or the axes displayed as rows and columns."""
    ndim = int(layer.ndim)
    if view is None:
        return ndim - 2, ndim - 1
    if view.volume:
        if ndim < 3:
            raise LayerError(layer, "is not a volume. Choose a volume, or deform single slices.")
        return ndim - 3, ndim - 2, ndim - 1
    missing = len(view.point) - ndim
    rows, cols = (axis - missing for axis in view.displayed[-2:])
    if min(rows, cols) < 0:
        raise LayerError(
            layer,
            f"has {ndim} axes, but lacks world axis {min(view.displayed[-2:])}, which the viewer "
            "shows. Show the axes of this layer (with the button below the layer list that changes "
            "the order of the axes).",
        )
    return rows, cols


def _index_on(
    layer: Any, matrix: npt.NDArray[np.float64], plane: tuple[int, ...], view: View | None
) -> tuple[int, ...]:
    """Return the index of the visible slice along each layer axis, or 0 for axes in `plane`."""
    ndim = int(layer.ndim)
    index, others = [0] * ndim, [axis for axis in range(ndim) if axis not in plane]
    if view is None or not others:
        return tuple(index)
    size, extents = np.abs(matrix[:-1, :-1]).max(), layer_extents(layer)
    if np.abs(matrix[np.ix_(others, plane)]).max() > 1e-9 * size:
        whole = "choose 'the whole volume', " if extents[-3:-2] > (1,) and not view.volume else ""
        raise LayerError(
            layer,
            "is shown at an oblique angle: its rotation or affine mixes the axes of the slice with "
            f"the other axes. To deform the layer, {whole}show the axes of its acquisition, or "
            "resample it.",
        )
    pixel = view.pixel(layer, view.point)
    for axis in others:
        index[axis] = int(pixel[axis])
        if extents and not 0 <= index[axis] < extents[axis]:
            raise LayerError(
                layer,
                f"has {extents[axis]} slices along axis {axis}, but the visible slice would be "
                f"slice {index[axis]}. Move the slider to a slice of this layer.",
            )
    return tuple(index)


def plane_shown(frame: Frame, view: View) -> tuple[int, int]:
    """Return the axis of a volume perpendicular to the visible slice, and the slice index.

    Parameters
    ----------
    frame : Frame
        Frame of the volume.
    view : View

    Returns
    -------
    across : int
        Axis perpendicular to the slice: 0, 1 or 2.
    index : int
        Index of the slice along this axis.
    """
    missing = len(view.point) - frame.ndim
    shown = {axis - missing for axis in view.displayed[-2:]}
    across = next(at for at, axis in enumerate(frame.plane) if axis not in shown)
    return across, int(view.pixel(frame, view.point)[frame.plane[across]])


def full_resolution(layer: Any) -> Any:
    """Return the data of an Image or Labels layer; for a multiscale layer, the finest level."""
    return layer.data[0] if getattr(layer, "multiscale", False) else layer.data


def layer_extents(layer: Any) -> tuple[int, ...]:
    """Return the number of pixels along each axis, or () for vectors, points and shapes."""
    if isinstance(layer, Vectors | Points | Shapes):
        return ()
    return tuple(full_resolution(layer).shape[: layer.ndim])


def plane_shape(layer: Any, frame: Frame) -> tuple[int, ...]:
    """Return the shape of a layer's slice or volume: ([planes,] rows, columns)."""
    extents = layer_extents(layer)
    if not extents:
        raise LayerError(
            layer, "has no pixels. Choose an image, or paint the tissue in a Labels layer."
        )
    return tuple(extents[axis] for axis in frame.plane)


def check_size(
    layer: Any, own: Frame, reference: Any, frame: Frame, shape: tuple[int, ...]
) -> None:
    """Raise an error if the place or size of a layer differs from that of the reference."""
    own_shape = shape if isinstance(layer, Vectors) else plane_shape(layer, own)
    if own_shape != shape or not frame.same_place(own, shape):
        own_size, size = (" x ".join(map(str, each)) for each in (own_shape, shape))
        raise LayerError(
            layer,
            f"is not on the grid of '{reference.name}'. The layers have {own_size} and {size} "
            "pixels; if these are equal, the scale, translation, rotation, shear, affine or units "
            "differ. Choose another layer in its menu, or ----- for no layer; or resample one of "
            "the layers.",
        )


def copy_slice(layer: Any, own: Frame) -> npt.NDArray[Any]:
    """Copy a slice of a layer, which may be loaded lazily.

    Raises
    ------
    ProblemError
        If the slice cannot be read, or contains masked pixels.
    """
    try:
        picture = own.take(full_resolution(layer))
    except Exception as error:
        # Loading a lazy layer runs code of a reader plugin, which can raise any exception.
        reason = str(error).rstrip(".") or type(error).__name__
        raise LayerError(
            layer, f"could not be read: {reason}. Check the file of the layer."
        ) from error
    hidden = int(np.ma.getmaskarray(picture).sum()) if isinstance(picture, np.ma.MaskedArray) else 0
    if hidden:
        raise LayerError(
            layer,
            f"is a masked array with {hidden} masked values in this slice, and masks are not "
            "supported. Replace the masked values with a number (0 if there is no tissue).",
        )
    return np.asarray(picture)


def fits(layer: Any, reference: Any, view: View | None = None) -> bool:
    """Return whether a layer has the same grid as a reference layer.

    The visible slices are compared or, if this is not possible, the first slices.
    """
    try:
        own, frame = frame_of(layer, view), frame_of(reference, view)
    except (HmrfError, ValueError):
        return view is not None and not view.volume and fits(layer, reference)
    shape = plane_shape(reference, frame)
    sized = isinstance(layer, Vectors) or plane_shape(layer, own) == shape
    return sized and frame.same_place(own, shape)


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
