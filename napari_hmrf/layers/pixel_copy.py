"""Copying the same pixels out of several layers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Vectors

from napari_hmrf.errors import HmrfError
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.slice_view import View
from napari_hmrf.study.layer_names import LayerError, full_resolution


def plane_shape(layer: Any, frame: Frame) -> tuple[int, int]:
    """Rows and columns of a layer's slice."""
    if isinstance(layer, Vectors):
        raise LayerError(
            layer,
            "has no pixels. Choose an image, or paint the tissue in a Labels layer.",
        )
    shape = full_resolution(layer).shape
    return int(shape[frame.plane[0]]), int(shape[frame.plane[1]])


def check_size(
    layer: Any, own: Frame, reference: Any, frame: Frame, shape: tuple[int, int]
) -> None:
    """Refuse a layer that does not cover the same pixels as the reference."""
    check_place(layer, own, reference, frame, shape)
    if isinstance(layer, Vectors):
        return
    own_shape = plane_shape(layer, own)
    if own_shape != shape:
        raise LayerError(
            layer,
            f"has {own_shape[0]} x {own_shape[1]} pixels in this slice, but '{reference.name}' "
            f"has {shape[0]} x {shape[1]}. Choose layers of the same size, or resample one.",
        )


def copy_slice(layer: Any, own: Frame) -> npt.NDArray[Any]:
    """Copy a slice of a layer, wherever it is read from.

    Raises
    ------
    ProblemError
        If it could not be read, or pixels of it are masked.
    """
    try:
        picture = own.take(full_resolution(layer))
    except Exception as error:
        # A lazy layer runs the code of whoever reads it, which may raise anything.
        reason = str(error).rstrip(".") or type(error).__name__
        raise LayerError(
            layer, f"could not be read: {reason}. Check the file it comes from."
        ) from error
    hidden = int(np.ma.getmaskarray(picture).sum()) if isinstance(picture, np.ma.MaskedArray) else 0
    if hidden:
        raise LayerError(
            layer,
            f"is a masked array with {hidden} masked values in this slice, and a mask would be "
            "lost. Fill them with a value (0 is where there is no tissue).",
        )
    return np.asarray(picture)


def check_place(
    layer: Any, own: Frame, reference: Any, frame: Frame, shape: tuple[int, int]
) -> None:
    """Refuse a layer that does not lie where the reference does."""
    if not frame.same_place(own, shape):
        raise LayerError(
            layer,
            f"lies elsewhere than '{reference.name}': their scale, translation, rotation, "
            "shear, affine or units differ. Give both the same transform, or resample one.",
        )


def fits(layer: Any, reference: Any, view: View | None = None) -> bool:
    """Whether a layer has the pixels of a reference; True, too, of slices that it does not have."""
    try:
        own, frame = Frame.of(layer, view), Frame.of(reference, view)
    except (HmrfError, ValueError):
        return True
    shape = plane_shape(reference, frame)
    sized = isinstance(layer, Vectors) or plane_shape(layer, own) == shape
    return sized and frame.same_place(own, shape)


def nearest_paint(layer: Any, frame: Frame) -> str:
    """The nearest slice of a Labels layer that holds paint, in words; "" if none does.

    Only of arrays in memory: to look through a stack on a disk would take too long.
    """
    data = full_resolution(layer)
    if not isinstance(data, np.ndarray):
        return ""
    for axis in frame.others:
        index = frame.index
        for at in sorted(range(data.shape[axis]), key=lambda at: abs(at - index[axis])):
            there = replace(frame, index=(*index[:axis], at, *index[axis + 1 :]))
            if data[there.pixels].any():
                return there.slice_seen
    return ""
