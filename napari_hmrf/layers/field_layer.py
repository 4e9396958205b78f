"""Layers that hold a displacement field, and layers that can be moved with a result.

A layer draws a few arrows of its field and holds the whole field in its metadata, either as a
result or as a field from a file. Images, labels, points and shapes on the same tissue can be moved
with a result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy.typing as npt
from napari.layers import Image, Labels, Points, Shapes

from napari_hmrf.errors import ProblemError, naming
from napari_hmrf.field.displacement_field import DisplacementField
from napari_hmrf.field.frame import Frame
from napari_hmrf.field.moved_points import bendable
from napari_hmrf.field.observation import PixelField
from napari_hmrf.field.other_grid import OtherGrid
from napari_hmrf.layers.label_colours import OBSERVED
from napari_hmrf.layers.metadata import IMAGE, METADATA, TISSUE, metadata_of, role_of, rows_of
from napari_hmrf.layers.result_layers import ARROWS, LayerData, PlacedSolution
from napari_hmrf.layers.slice_view import View, copy_slice, frame_of, full_resolution, layer_extents

Array = npt.NDArray[Any]
#: Kind, in the metadata, of a layer that was moved with a result.
MOVED = "moved"


def result_of(layer: Any) -> PlacedSolution | None:
    """Return the result that a layer of arrows holds; None if it holds none."""
    answer = metadata_of(layer).get("answer")
    return answer if isinstance(answer, PlacedSolution) else None


def holds_field(layer: Any) -> bool:
    """Return whether a layer holds a field, from a file or of a result."""
    return layer is not None and ("field" in metadata_of(layer) or result_of(layer) is not None)


def field_of(layer: Any) -> PixelField | None:
    """Return the field that a layer holds; None if it holds none."""
    if not holds_field(layer):
        return None
    answer, frame = result_of(layer), frame_of(layer)
    if answer is None:
        return PixelField(metadata_of(layer)["field"], frame)
    slice_frame = replace(frame, plane=answer.frame.plane, index=answer.frame.index)
    return PixelField.of(answer.solution, slice_frame)


def field_layer(
    field: DisplacementField, place: Mapping[str, Any], name: str, role: str | None = None
) -> LayerData:
    """Make a layer that holds a field and draws some of its arrows.

    Parameters
    ----------
    field : DisplacementField
        In pixels, along all axes.
    place : mapping
        Place of the pixels in the world, as keyword arguments of a new layer.
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
    """Find the image that a result deforms: by its name, else any image on the same pixels."""
    images = (layer for layer in layers if can_be_source(layer, result))

    def likeness(image: Any) -> tuple[bool, bool]:
        return image.name == result.pictures.name, role_of(image) == IMAGE

    return max(images, key=likeness, default=None)


def can_be_source(layer: Any, result: PlacedSolution) -> bool:
    """Return whether a layer is an image on the pixels of a result, and not itself a result."""
    is_plain_image = isinstance(layer, Image) and "kind" not in metadata_of(layer)
    return is_plain_image and frame_in(layer, result) is not None


def tissue_labels(layers: Iterable[Any], result: PlacedSolution) -> Any:
    """Find the topmost Labels layer of tissue on the pixels of a result, or None."""
    tissues = [layer for layer in layers if isinstance(layer, Labels) and rows_of(layer, TISSUE)]
    return next((each for each in reversed(tissues) if frame_in(each, result)), None)


def frame_in(layer: Any, result: PlacedSolution) -> Frame | None:
    """Return the frame of a layer's slice on the pixels of a result; None if there is none."""
    try:
        return result.frame.slice_in(frame_of(layer), layer_extents(layer), result.shape)
    except (ProblemError, ValueError, IndexError):
        return None


def picture_of(layer: Any, result: PlacedSolution) -> npt.NDArray[Any] | None:
    """Copy the slice of a layer on the pixels of a result; None if the layer lies elsewhere.

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
    """Convert a point of the world to the pixels of a result.

    Parameters
    ----------
    layer : napari.layers.Layer
        Layer that holds the result.
    result : PlacedSolution
    position : sequence of float
        World coordinates, such as those of a viewer's cursor.
    view : View
        Visible slice of the viewer.

    Returns
    -------
    tuple of float or None
        ([depth,] row, col), with whole numbers at the middle of a pixel; None outside the pixels
        or the slice of the result.
    """
    if len(position) < layer.ndim:
        return None
    return result.frame.place_of(view.pixel(layer, position), result.shape)


def can_move(layer: Any) -> bool:
    """Return whether a layer can be moved with a result, and is not itself a result."""
    return isinstance(layer, Image | Labels | Points | Shapes) and "kind" not in metadata_of(layer)


def prepare_move(layer: Any, answer: PlacedSolution) -> Callable[[], LayerData]:
    """Return a function that moves a layer with a result; it can be called on any thread.

    The layer may have other pixels than the result, and more axes, as described in `OtherGrid.of`.
    Labels are not interpolated.

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
