"""Visible slice of a layer in a viewer: its place and its pixels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Points, Shapes, Vectors

from napari_hmrf.errors import HmrfError, LayerError
from napari_hmrf.field.drawn_slice import pixel_drawn, sliders_at
from napari_hmrf.field.frame import Frame, as_tuples, is_flat
from napari_hmrf.field.units import unit_factor


@dataclass(frozen=True)
class View:
    """Visible slice of a viewer: a copy of the parts of its `Dims` that select a slice.

    Attributes
    ----------
    displayed : tuple of int
        Displayed world axes, in the order (rows, columns).
    point : tuple of float
        World coordinates of the slice, along every axis.
    units : tuple of str, optional
        Units of `point`, if the viewer has units.
    sliders : tuple of (float, float)
        Start and step of the slider of each axis; empty without a viewer.
    volume : bool
        True if the whole volume is selected, instead of the visible slice.
    """

    displayed: tuple[int, ...]
    point: tuple[float, ...]
    units: tuple[str, ...] | None = None
    sliders: tuple[tuple[float, float], ...] = field(default=(), compare=False)
    volume: bool = False

    @classmethod
    def of(cls, dims: Any, volume: bool = False) -> View:
        """Return the view of a viewer's dims."""
        units = getattr(dims, "units", None)
        return cls(
            tuple(int(axis) for axis in dims.displayed),
            tuple(float(value) for value in dims.point),
            None if units is None else tuple(str(unit) for unit in units),
            tuple((float(span.start), float(span.step)) for span in dims.range),
            volume,
        )

    def factors(self, layer: Any) -> npt.NDArray[np.float64]:
        """Return the factors from the viewer's units to those of a layer or frame, by axis."""
        if self.units is None:
            return np.ones(layer.ndim)
        units = zip(self.units[-layer.ndim :], layer.units, strict=True)
        return np.array([unit_factor(unit, str(to)) for unit, to in units])

    def sliders_of(self, layer: Any) -> tuple[tuple[float, float], ...]:
        """Return start and step of the slider of each axis of a layer, in the layer's units."""
        sliders = zip(self.sliders[-layer.ndim :], self.factors(layer).tolist(), strict=False)
        return tuple((start * factor, step * factor) for (start, step), factor in sliders)

    def pixel(self, layer: Any, position: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return the pixel of a layer or frame that is drawn at a position in world coordinates."""
        world = np.nan_to_num(np.asarray(position)[-layer.ndim :] * self.factors(layer))
        return pixel_drawn(matrix_of(layer), self._drawn(layer), world)

    def point_at(self, layer: Any, pixel: npt.ArrayLike) -> dict[int, float]:
        """Return the slider positions, by world axis, that show a pixel of a layer or frame.

        Only axes that are not displayed have a slider.
        """
        positions = sliders_at(matrix_of(layer), self._drawn(layer), pixel)
        missing, factors = len(self.point) - layer.ndim, self.factors(layer)
        return {axis + missing: at / factors[axis] for axis, at in positions.items()}

    def tilts(self, layer: Any) -> bool:
        """Return whether a layer or frame is tilted out of its slices, which napari ignores."""
        linear, drawn = matrix_of(layer)[:-1, :-1], self._drawn(layer)
        others = [axis for axis in range(layer.ndim) if axis not in drawn]
        mixed = np.abs(linear[np.ix_(others, drawn)]).max(initial=0)
        return bool(mixed > 1e-6 * np.abs(linear).max())

    def _drawn(self, layer: Any) -> list[int]:
        missing = len(self.point) - layer.ndim
        return [axis - missing for axis in self.displayed if axis >= missing]


def matrix_of(layer: Any) -> npt.NDArray[np.float64]:
    """Return the homogeneous matrix from the pixels of a layer or frame to the world."""
    if isinstance(layer, Frame):
        return np.array(layer.matrix)
    ndim = int(layer.ndim)
    corners = np.concatenate([np.zeros((1, ndim)), np.eye(ndim)])
    origin, *ends = (np.asarray(layer.data_to_world(corner), float) for corner in corners)
    matrix = np.eye(ndim + 1)
    matrix[:ndim, :ndim] = np.stack(ends, axis=1) - origin[:, None]
    matrix[:ndim, ndim] = origin
    return matrix


def frame_of(layer: Any, view: View | None = None) -> Frame:
    """Return the frame of the visible slice of a layer, or of its whole volume.

    Parameters
    ----------
    layer : napari.layers.Layer
    view : View, optional
        Visible slice; by default the first slice, along the last two axes.

    Raises
    ------
    ProblemError
        If the transform of the layer is invalid; or if the viewer shows the layer at an angle,
        along an axis that the layer lacks, or beyond its ends.
    """
    matrix = matrix_of(layer)
    if not np.isfinite(matrix).all() or is_flat(matrix[:-1, :-1]):
        raise LayerError(
            layer,
            "has a scale, translation, rotation or affine that holds NaN or infinity, or is "
            "singular. Set an invertible transform.",
        )
    plane = _axes_of(layer, view)
    index = _index_on(layer, matrix, plane, view)
    units = [str(layer.units[axis]) for axis in plane]
    if np.isnan([unit_factor(unit, units[-1]) for unit in units]).any():
        raise LayerError(
            layer,
            f"measures its axes in {' and '.join(dict.fromkeys(units))}. Give each a unit of "
            "length.",
        )
    return Frame(
        plane=plane,
        index=index,
        scale=as_tuples(layer.scale),
        translate=as_tuples(layer.translate),
        rotate=as_tuples(layer.rotate),
        shear=as_tuples(layer.shear),
        affine=as_tuples(layer.affine.affine_matrix),
        units=tuple(str(unit) for unit in layer.units),
        axis_labels=tuple(str(label) for label in layer.axis_labels),
        matrix=as_tuples(matrix),
        sliders=() if view is None else view.sliders_of(layer),
    )


def _axes_of(layer: Any, view: View | None) -> tuple[int, ...]:
    """Return the axes of a layer that form its volume, or that are shown as rows and columns."""
    ndim = int(layer.ndim)
    if view is None:
        return ndim - 2, ndim - 1
    if view.volume:
        if ndim < 3:
            raise LayerError(layer, "is not a volume. Choose one, or deform one slice at a time.")
        return ndim - 3, ndim - 2, ndim - 1
    missing = len(view.point) - ndim
    rows, cols = (axis - missing for axis in view.displayed[-2:])
    if min(rows, cols) < 0:
        raise LayerError(
            layer,
            f"has {ndim} axes, but lacks the one that the viewer shows as world axis "
            f"{min(view.displayed[-2:])}. Show its own axes (the roll button below the canvas).",
        )
    return rows, cols


def _index_on(
    layer: Any, matrix: npt.NDArray[np.float64], plane: tuple[int, ...], view: View | None
) -> tuple[int, ...]:
    """Return the index of the visible slice along the axes of a layer; 0 along those of `plane`."""
    ndim = int(layer.ndim)
    index, others = [0] * ndim, [axis for axis in range(ndim) if axis not in plane]
    if view is None or not others:
        return tuple(index)
    size, extents = np.abs(matrix[:-1, :-1]).max(), layer_extents(layer)
    if np.abs(matrix[np.ix_(others, plane)]).max() > 1e-9 * size:
        whole = "choose 'the whole volume', " if extents[-3:-2] > (1,) and not view.volume else ""
        raise LayerError(
            layer,
            "is shown at an angle: its rotation or affine mixes the axes of the slice with the "
            f"others. To deform it, {whole}show the axes of its acquisition, or resample it.",
        )
    pixel = view.pixel(layer, view.point)
    for axis in others:
        index[axis] = int(pixel[axis])
        if extents and not 0 <= index[axis] < extents[axis]:
            raise LayerError(
                layer,
                f"does not reach the visible slice, which would be slice {index[axis]} along axis "
                f"{axis}, but it has {extents[axis]}. Move the slider to a slice of this layer.",
            )
    return tuple(index)


def plane_shown(frame: Frame, view: View) -> tuple[int, int]:
    """Return the axis of a volume across which a viewer shows slices, and the visible index.

    Parameters
    ----------
    frame : Frame
        Frame of the volume.
    view : View
    """
    missing = len(view.point) - frame.ndim
    shown = {axis - missing for axis in view.displayed[-2:]}
    across = next(at for at, axis in enumerate(frame.plane) if axis not in shown)
    return across, int(view.pixel(frame, view.point)[frame.plane[across]])


def full_resolution(layer: Any) -> Any:
    """Return the data of an Image or Labels layer, at the finest level if it is multiscale."""
    return layer.data[0] if getattr(layer, "multiscale", False) else layer.data


def layer_extents(layer: Any) -> tuple[int, ...]:
    """Return the number of pixels along each axis; () for vectors, points and shapes."""
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
    """Refuse a layer that lies elsewhere than the reference, or has another size."""
    own_shape = shape if isinstance(layer, Vectors) else plane_shape(layer, own)
    if own_shape != shape or not frame.same_place(own, shape):
        own_size, size = (" x ".join(map(str, each)) for each in (own_shape, shape))
        raise LayerError(
            layer,
            f"lies elsewhere than '{reference.name}': it has {own_size} pixels, that has {size}; "
            "or their scale, translation, rotation, shear, affine or units differ. Choose another "
            "layer in its menu, or ----- for none; or resample one of them.",
        )


def copy_slice(layer: Any, own: Frame) -> npt.NDArray[Any]:
    """Copy a slice of a layer, which may be loaded lazily.

    Raises
    ------
    ProblemError
        If the slice cannot be read, or has masked pixels.
    """
    try:
        picture = own.take(full_resolution(layer))
    except Exception as error:
        # A lazy layer runs the code of its reader plugin, which may raise any exception.
        reason = str(error).rstrip(".") or type(error).__name__
        raise LayerError(
            layer, f"could not be read: {reason}. Check the file of the layer."
        ) from error
    hidden = int(np.ma.getmaskarray(picture).sum()) if isinstance(picture, np.ma.MaskedArray) else 0
    if hidden:
        raise LayerError(
            layer,
            f"is a masked array with {hidden} masked values in this slice, and the mask would be "
            "lost. Fill them with a value (0 stands for no tissue).",
        )
    return np.asarray(picture)


def fits(layer: Any, reference: Any, view: View | None = None) -> bool:
    """Return whether a layer has the pixels of a reference in the visible, else the first slice."""
    try:
        own, frame = frame_of(layer, view), frame_of(reference, view)
    except (HmrfError, ValueError):
        return view is not None and not view.volume and fits(layer, reference)
    shape = plane_shape(reference, frame)
    sized = isinstance(layer, Vectors) or plane_shape(layer, own) == shape
    return sized and frame.same_place(own, shape)
