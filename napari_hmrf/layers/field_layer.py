"""Layers that contain a displacement field, and layers that can be deformed with a result.

A layer with a field displays some arrows of the field. The complete field is in the metadata of the
layer, either as a result or as a field from a file. A result can also deform other layers of the
same tissue: images, labels, points and shapes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy.typing as npt
from napari.layers import Image, Labels, Points, Shapes

from napari_hmrf.errors import ProblemError, naming
from napari_hmrf.field.displacement_field import Field
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.moved_points import bendable
from napari_hmrf.layers.label_colours import OBSERVED
from napari_hmrf.layers.metadata import IMAGE, METADATA, TISSUE, metadata_of, role_of, rows_of
from napari_hmrf.layers.result_layers import ARROWS, LayerData, PlacedSolution
from napari_hmrf.layers.slice_view import View, copy_slice, frame_of, full_resolution, layer_extents
from napari_hmrf.results.observation import PixelField
from napari_hmrf.results.other_grid import OtherGrid

Array = npt.NDArray[Any]
#: Metadata kind of a layer that was deformed with a result.
MOVED = "moved"


def result_of(layer: Any) -> PlacedSolution | None:
    """Return the result stored in the metadata of an arrow layer, or None."""
    answer = metadata_of(layer).get("answer")
    return answer if isinstance(answer, PlacedSolution) else None


def holds_field(layer: Any) -> bool:
    """Return whether a layer contains a displacement field, from a file or from a result."""
    return layer is not None and ("field" in metadata_of(layer) or result_of(layer) is not None)


def field_of(layer: Any) -> PixelField | None:
    """Return the displacement field stored in the metadata of a layer, or None."""
    if not holds_field(layer):
        return None
    answer, frame = result_of(layer), frame_of(layer)
    if answer is None:
        return PixelField(metadata_of(layer)["field"], frame)
    slice_frame = replace(frame, plane=answer.frame.plane, index=answer.frame.index)
    return PixelField.of(answer.solution, slice_frame)


def field_layer(
    field: Field, place: Mapping[str, Any], name: str, role: str | None = None
) -> LayerData:
    """Create a layer that contains a displacement field and displays some of its arrows.

    Parameters
    ----------
    field : Field
        Field in pixels, with one component per axis.
    place : mapping
        Transform from pixels to world coordinates, as keyword arguments of a new layer.
    name : str
    role : str, optional
        Role of the layer, for its metadata.
    """
    arrows, step = field.arrows(ARROWS)
    known = {"field": field, **({} if role is None else {"role": role})}
    look = {"vector_style": "arrow", "edge_color": OBSERVED, "edge_width": step / 8}
    return LayerData(
        arrows, {**look, **place, "name": name, "metadata": {METADATA: known}}, "vectors"
    )


def source_of(layers: Iterable[Any], result: PlacedSolution) -> Any:
    """Return the image that a result deforms, or else another image on its grid, or None.

    The deformed image is identified by its name.
    """
    images = (layer for layer in layers if can_be_source(layer, result))

    def likeness(image: Any) -> tuple[bool, bool]:
        return image.name == result.pictures.name, role_of(image) == IMAGE

    return max(images, key=likeness, default=None)


def can_be_source(layer: Any, result: PlacedSolution) -> bool:
    """Return whether a layer is an image on the grid of a result, and not a result itself."""
    is_plain_image = isinstance(layer, Image) and "kind" not in metadata_of(layer)
    return is_plain_image and frame_in(layer, result) is not None


def tissue_labels(layers: Iterable[Any], result: PlacedSolution) -> Any:
    """Return the topmost tissue layer on the grid of a result, or None."""
    tissues = [layer for layer in layers if isinstance(layer, Labels) and rows_of(layer, TISSUE)]
    return next((each for each in reversed(tissues) if frame_in(each, result)), None)


def frame_in(layer: Any, result: PlacedSolution) -> Frame | None:
    """Return the frame of a layer's slice on the grid of a result, or None if there is none."""
    try:
        return result.frame.slice_in(frame_of(layer), layer_extents(layer), result.shape)
    except (ProblemError, ValueError, IndexError):
        return None


def picture_of(layer: Any, result: PlacedSolution) -> npt.NDArray[Any] | None:
    """Return a copy of a layer's slice on the grid of a result, or None if there is none.

    Raises
    ------
    ProblemError
        If the layer cannot be read.
    """
    slice_frame = frame_in(layer, result)
    return None if slice_frame is None else copy_slice(layer, slice_frame)


def place_at(
    layer: Any, result: PlacedSolution, position: Any, view: View
) -> tuple[float, ...] | None:
    """Convert world coordinates to pixel coordinates of a result.

    Parameters
    ----------
    layer : napari.layers.Layer
        Layer that contains the result.
    result : PlacedSolution
    position : sequence of float
        World coordinates, such as those of a viewer's cursor.
    view : View
        Visible slice of the viewer.

    Returns
    -------
    tuple of float or None
        ([plane,] row, col), with integers at pixel centres; None if the position is outside the
        grid or the slice of the result.
    """
    if len(position) < layer.ndim:
        return None
    return result.frame.place_of(view.pixel(layer, position), result.shape)


def can_move(layer: Any) -> bool:
    """Return whether a layer can be deformed with a result, and is not a result itself."""
    return isinstance(layer, Image | Labels | Points | Shapes) and "kind" not in metadata_of(layer)


def prepare_move(layer: Any, answer: PlacedSolution) -> Callable[[], LayerData]:
    """Return a function that deforms a layer with a result.

    The layer may have a different grid from the result, and more axes; see `OtherGrid.of`. Labels
    are not interpolated.

    Returns
    -------
    callable
        Function without arguments that returns the data of the deformed layer. It can be called on
        any thread.

    Raises
    ------
    LayerError
        As for `OtherGrid.of`.
    """
    with naming(observed=layer):
        grid = OtherGrid.of(answer.solution, answer.frame, frame_of(layer))
    data, attributes, kind = layer.as_layer_data_tuple()
    known = {key: value for key, value in metadata_of(layer).items() if key != "role"}
    attributes["metadata"] = {METADATA: {**known, "kind": MOVED}}
    attributes["name"], attributes["visible"] = f"{layer.name}, moved", True
    if kind in ("image", "labels"):
        attributes["multiscale"], order = False, 0 if kind == "labels" else 1
        pixels = full_resolution(layer)
        return lambda: LayerData(grid.moved_pixels(pixels, order=order), attributes, kind)
    if kind == "points":
        return lambda: LayerData(grid.moved_points(data), attributes, kind)
    bent_shapes = [
        bendable(corners, each) for corners, each in zip(data, layer.shape_type, strict=True)
    ]
    attributes["shape_type"] = [each for _, each in bent_shapes]
    return lambda: LayerData([grid.moved_points(each) for each, _ in bent_shapes], attributes, kind)
