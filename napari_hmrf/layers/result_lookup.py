"""Results among a viewer's layers, found by what their metadata say, and what they belong to."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Image

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.metadata import IMAGE, TISSUE, known_of, role_of, rows_of
from napari_hmrf.layers.pixel_copy import copy_slice, plane_shape
from napari_hmrf.layers.result_layers import Answer
from napari_hmrf.layers.slice_view import View, frame_of, layer_extents


def result_of(layer: Any) -> Answer | None:
    """The result that a layer of arrows holds; None if it holds none."""
    known = known_of(layer)
    answer = known.get("answer")
    return answer if isinstance(answer, Answer) and known.get("kind") == "arrows" else None


def source_of(layers: Iterable[Any], result: Answer) -> Any:
    """Find the image that a result deforms: by its name, else one that lies where it does."""
    images = [layer for layer in layers if can_be_source(layer, result)]
    named = [layer for layer in images if layer.name == result.source]
    meant = [layer for layer in images if role_of(layer) == IMAGE]
    return next(iter([*named, *meant, *images]), None)


def can_be_source(layer: Any, result: Answer) -> bool:
    """Whether a layer is an image on the pixels of a result, and not itself made of one."""
    own = isinstance(layer, Image) and "kind" not in known_of(layer)
    return own and frame_in(layer, result) is not None


def tissue_of(layers: Iterable[Any], result: Answer) -> Any:
    """Find the layer that says how stiff the tissue of a result is, or None.

    That is one of labels with a table, or one of stiffness.
    """
    tissues = [layer for layer in layers if role_of(layer) == TISSUE]
    described = [each for each in tissues if isinstance(each, Image) or rows_of(each, TISSUE)]
    return next((each for each in reversed(described) if frame_in(each, result)), None)


def frame_in(layer: Any, result: Answer) -> Frame | None:
    """The frame of the slice of a layer that lies on a result's pixels; None if none does."""
    try:
        own = frame_of(layer)
        more = own.ndim - result.frame.ndim
        plane = tuple(axis + more for axis in result.frame.plane)
        index = ((0,) * more + result.frame.index)[-own.ndim :]
        if min(plane) < 0:
            return None
        # A layer may be of that one slice alone.
        sizes = layer_extents(layer)
        index = tuple(min(at, size - 1) for at, size in zip(index, sizes, strict=True))
        own = replace(own, plane=(plane[0], plane[1]), index=index)
        fits = plane_shape(layer, own) == result.shape
        return own if fits and result.frame.same_place(own, result.shape) else None
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


def place_at(layer: Any, result: Answer, position: Any, view: View) -> tuple[float, float] | None:
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
    (float, float) or None
        (row, col), whole numbers at the middle of a pixel.
    """
    point = np.asarray(position, dtype=float)[-layer.ndim :]
    if len(point) < layer.ndim:
        return None
    seen = layer.world_to_data(np.nan_to_num(point * view.factors(layer)))
    found = np.asarray(seen, dtype=float)
    index = np.floor(np.nan_to_num(found) + 0.5)
    frame = result.frame
    if any(index[axis] != frame.index[axis] for axis in frame.others):
        return None
    rows, cols = frame.plane
    inside = 0 <= index[rows] < result.shape[0] and 0 <= index[cols] < result.shape[1]
    return (float(found[rows]), float(found[cols])) if inside else None


def slices_apart(layer: Any, result: Answer, view: View) -> tuple[str, str] | None:
    """The names of the slice of a result and of the one that is shown, if they are two.

    Parameters
    ----------
    layer : napari.layers.Layer
        That holds the result.
    result : Answer
    view : View
        What the viewer shows.
    """
    if result.frame.ndim < 3 or len(view.displayed) != 2:
        return None
    try:
        shown = frame_of(layer, view)
    except (ProblemError, ValueError):
        return None
    frame = result.frame
    if shown.plane != frame.plane or shown.index == frame.index:
        return None
    return replace(frame, sliders=shown.sliders).slice_seen, shown.slice_seen
