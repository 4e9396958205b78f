"""Which slice of a layer a viewer shows, and where that lies."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.frame import Frame, as_tuples, is_flat
from napari_hmrf.field.units import unit_factor
from napari_hmrf.study.layer_names import LayerError, full_resolution


@dataclass(frozen=True)
class View:
    """What a viewer shows: a copy of the parts of its `Dims` that pick a slice.

    Attributes
    ----------
    displayed : tuple of int
        World axes drawn, in the order (rows, columns).
    point : tuple of float
        World coordinates of the slice on every axis.
    units : tuple of str, optional
        Of `point`, if the viewer has them.
    sliders : tuple of (float, float)
        Where the slider of each axis begins, and its step; it counts steps. None, if nobody looks.
    """

    displayed: tuple[int, ...]
    point: tuple[float, ...]
    units: tuple[str, ...] | None = None
    sliders: tuple[tuple[float, float], ...] = field(default=(), compare=False)

    @classmethod
    def of(cls, dims: Any) -> View:
        """Copy a viewer's dims."""
        units = getattr(dims, "units", None)
        return cls(
            tuple(int(axis) for axis in dims.displayed),
            tuple(float(value) for value in dims.point),
            None if units is None else tuple(str(unit) for unit in units),
            tuple((float(span.start), float(span.step)) for span in dims.range),
        )

    def factors(self, layer: Any) -> npt.NDArray[np.float64]:
        """How many of a layer's units make one of the viewer's, along the layer's axes."""
        if self.units is None:
            return np.ones(layer.ndim)
        units = zip(self.units[-layer.ndim :], layer.units, strict=True)
        return np.array([unit_factor(unit, str(to)) for unit, to in units])

    def sliders_of(self, layer: Any) -> tuple[tuple[float, float], ...]:
        """Where the slider of each of a layer's axes begins, and its step, in its units."""
        found = zip(self.sliders[-layer.ndim :], self.factors(layer).tolist(), strict=False)
        return tuple((start * factor, step * factor) for (start, step), factor in found)


def frame_of(layer: Any, view: View | None = None) -> Frame:
    """The slice of a layer that a viewer shows.

    Parameters
    ----------
    layer : napari.layers.Layer
    view : View, optional
        By default the last two axes, first slice.

    Raises
    ------
    ProblemError
        If the transform holds no numbers, or the viewer shows the layer at an angle, across
        an axis it lacks, or beyond its ends.
    """
    ndim = int(layer.ndim)
    corners = np.concatenate([np.zeros((1, ndim)), np.eye(ndim)])
    origin, *ends = (np.asarray(layer.data_to_world(corner), float) for corner in corners)
    matrix = np.eye(ndim + 1)
    matrix[:ndim, :ndim] = np.stack(ends, axis=1) - origin[:, None]
    matrix[:ndim, ndim] = origin
    if not np.isfinite(matrix).all() or is_flat(matrix[:-1, :-1]):
        raise LayerError(
            layer,
            "has a scale, translation, rotation or affine that holds NaN or infinity, or "
            "flattens it. Set numbers that keep its axes apart.",
        )
    plane, index = _slice_shown(layer, matrix, view)
    row_unit, col_unit = (str(layer.units[axis]) for axis in plane)
    if np.isnan(unit_factor(col_unit, row_unit)):
        raise LayerError(
            layer,
            f"measures rows in {row_unit} and columns in {col_unit}. Give both axes a unit of "
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


def _slice_shown(
    layer: Any, matrix: npt.NDArray[np.float64], view: View | None
) -> tuple[tuple[int, int], tuple[int, ...]]:
    """The layer's axes that a viewer draws as rows and columns, and its slice on the others."""
    ndim = int(layer.ndim)
    if view is None:
        return (ndim - 2, ndim - 1), (0,) * ndim
    missing = len(view.point) - ndim
    rows, cols = (axis - missing for axis in view.displayed[-2:])
    if min(rows, cols) < 0:
        raise LayerError(
            layer,
            f"has {ndim} axes, and not the one the viewer shows as world axis "
            f"{min(view.displayed[-2:])}. Show its own axes (the roll button below the canvas).",
        )
    others = [axis for axis in range(ndim) if axis not in (rows, cols)]
    size = np.abs(matrix[:-1, :-1]).max()
    if others and np.abs(matrix[np.ix_(others, [rows, cols])]).max() > 1e-9 * size:
        raise LayerError(
            layer,
            "is shown at an angle: its rotation or affine mixes the axes of the slice with the "
            "others. Show the axes it was taken in, or resample it.",
        )
    index = [0] * ndim
    if others:
        point = np.array(view.point[missing:]) * view.factors(layer)
        pixel = np.asarray(layer.world_to_data(np.nan_to_num(point)))
        extents = layer_extents(layer)
        for axis in others:
            index[axis] = round(float(pixel[axis]))
            if extents and not 0 <= index[axis] < extents[axis]:
                raise LayerError(
                    layer,
                    f"does not reach the slice shown: it would be slice {index[axis]} of its axis "
                    f"{axis}, which has {extents[axis]}. Move the slider to where it is visible.",
                )
    return (rows, cols), tuple(index)


def layer_extents(layer: Any) -> tuple[int, ...]:
    """Pixels of an image-like layer along its axes; nothing for vectors, points and shapes."""
    if layer.__class__.__name__ in ("Vectors", "Points", "Shapes"):
        return ()
    return tuple(full_resolution(layer).shape[: layer.ndim])
