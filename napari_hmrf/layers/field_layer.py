"""Layers that hold a field, of a result or of a file, and what else lies where a result does.

Of a field a few arrows are drawn, and the layer holds all of it. A result is found by what its
layer's metadata say; images, labels, points and shapes on the same tissue can be moved with it.
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
from napari_hmrf.layers.metadata import IMAGE, METADATA, TISSUE, known_of, role_of, rows_of
from napari_hmrf.layers.result_layers import ARROWS, Answer, LayerData
from napari_hmrf.layers.slice_view import View, copy_slice, frame_of, full_resolution, layer_extents

Array = npt.NDArray[Any]
#: What the metadata of a layer say that was moved.
MOVED = "moved"


def result_of(layer: Any) -> Answer | None:
    """The result that a layer of arrows holds; None if it holds none."""
    answer = known_of(layer).get("answer")
    return answer if isinstance(answer, Answer) else None


def holds_field(layer: Any) -> bool:
    """Whether a layer holds a field: one that was opened, or a result."""
    return layer is not None and ("field" in known_of(layer) or result_of(layer) is not None)


def field_of(layer: Any) -> PixelField | None:
    """The field that a layer holds; None if it holds none."""
    if not holds_field(layer):
        return None
    answer, frame = result_of(layer), frame_of(layer)
    if answer is None:
        return PixelField(known_of(layer)["field"], frame)
    there = replace(frame, plane=answer.frame.plane, index=answer.frame.index)
    return PixelField.of(answer.solution, there)


def field_layer(
    field: DisplacementField, place: Mapping[str, Any], name: str, role: str | None = None
) -> LayerData:
    """Have a layer hold a field, and draw some of its arrows.

    Parameters
    ----------
    field : DisplacementField
        In pixels, along all axes.
    place : mapping
        Where the first pixel and the others lie, as a new layer takes it.
    name : str
    role : str, optional
        What the layer is for.
    """
    arrows, step = field.arrows(ARROWS)
    known = {"field": field, **({} if role is None else {"role": role})}
    look = {"vector_style": "arrow", "edge_color": OBSERVED, "edge_width": step / 8}
    return LayerData(
        arrows, {**look, **place, "name": name, "metadata": {METADATA: known}}, "vectors"
    )


def source_of(layers: Iterable[Any], result: Answer) -> Any:
    """Find the image that a result deforms: by its name, else one that lies where it does."""
    images = (layer for layer in layers if can_be_source(layer, result))

    def likeness(image: Any) -> tuple[bool, bool]:
        return image.name == result.pictures.name, role_of(image) == IMAGE

    return max(images, key=likeness, default=None)


def can_be_source(layer: Any, result: Answer) -> bool:
    """Whether a layer is an image on the pixels of a result, and not itself made of one."""
    own = isinstance(layer, Image) and "kind" not in known_of(layer)
    return own and frame_in(layer, result) is not None


def tissue_labels(layers: Iterable[Any], result: Answer) -> Any:
    """Find the topmost layer of labels that says what the tissue of a result is, or None."""
    tissues = [layer for layer in layers if isinstance(layer, Labels) and rows_of(layer, TISSUE)]
    return next((each for each in reversed(tissues) if frame_in(each, result)), None)


def frame_in(layer: Any, result: Answer) -> Frame | None:
    """The frame of the slice of a layer that lies on a result's pixels; None if none does."""
    try:
        return result.frame.slice_in(frame_of(layer), layer_extents(layer), result.shape)
    except (ProblemError, ValueError, IndexError):
        return None


def picture_of(layer: Any, result: Answer) -> npt.NDArray[Any] | None:
    """Copy what a layer shows on a result's pixels, rows first; None if it lies elsewhere.

    Raises
    ------
    ProblemError
        If it cannot be read.
    """
    own = frame_in(layer, result)
    return None if own is None else copy_slice(layer, own)


def place_at(layer: Any, result: Answer, position: Any, view: View) -> tuple[float, ...] | None:
    """Where a point of the world lies on the pixels of a result; None beside it or its slice.

    Parameters
    ----------
    layer : napari.layers.Layer
        That holds the result.
    result : Answer
    position : sequence of float
        World coordinates, as of a viewer's cursor.
    view : View
        What the viewer shows.

    Returns
    -------
    tuple of float or None
        ([depth,] row, col), whole numbers at the middle of a pixel.
    """
    if len(position) < layer.ndim:
        return None
    return result.frame.place_of(view.pixel(layer, position), result.shape)


def can_move(layer: Any) -> bool:
    """Whether a layer can be moved with a result, and is not itself made of one."""
    return isinstance(layer, Image | Labels | Points | Shapes) and "kind" not in known_of(layer)


def mover(layer: Any, answer: Answer) -> Callable[[], LayerData]:
    """Get ready to move a layer with a result: what is returned does, on any thread.

    The layer may have other pixels than the result, and more axes, as of `OtherGrid.of`. Labels get
    no new values.

    Raises
    ------
    LayerError
        As of `OtherGrid.of`.
    """
    with naming(observed=layer):
        grid = OtherGrid.of(answer.solution, answer.frame, frame_of(layer))
    data, attributes, kind = layer.as_layer_data_tuple()
    known = {key: value for key, value in known_of(layer).items() if key != "role"}
    attributes["metadata"] = {METADATA: {**known, "kind": MOVED}}
    attributes["name"], attributes["visible"] = f"{layer.name}, moved", True
    if kind in ("image", "labels"):
        attributes["multiscale"], order = False, 0 if kind == "labels" else 1
        pixels = full_resolution(layer)
        return lambda: LayerData(grid.moved_pixels(pixels, order=order), attributes, kind)
    if kind == "points":
        return lambda: LayerData(grid.moved_points(data), attributes, kind)
    bent = [bendable(corners, each) for corners, each in zip(data, layer.shape_type, strict=True)]
    attributes["shape_type"] = [each for _, each in bent]
    return lambda: LayerData([grid.moved_points(each) for each, _ in bent], attributes, kind)
