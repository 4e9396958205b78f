"""Copying the same pixels out of several layers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
from napari.layers import Vectors

from napari_hmrf.errors import ProblemError
from napari_hmrf.layers.frame import Frame
from napari_hmrf.layers.view import describe, full_resolution


def plane_shape(layer: Any, frame: Frame) -> tuple[int, int]:
    """Rows and columns of a layer's slice."""
    if isinstance(layer, Vectors):
        raise ProblemError(
            describe(layer),
            "has no pixels. Choose an image, or paint the tissue in a Labels layer.",
        )
    shape = full_resolution(layer).shape
    return int(shape[frame.plane[0]]), int(shape[frame.plane[1]])


def take_slice(
    layer: Any, own: Frame, reference: Any, frame: Frame, shape: tuple[int, int]
) -> npt.NDArray[Any]:
    """Copy the slice of a layer that covers the same pixels as the reference's."""
    check_place(layer, own, reference, frame, shape)
    own_shape = plane_shape(layer, own)
    if own_shape != shape:
        raise ProblemError(
            describe(layer),
            f"has {own_shape[0]} x {own_shape[1]} pixels in this slice, but {describe(reference)} "
            f"has {shape[0]} x {shape[1]}. Choose layers of the same size, or resample one.",
        )
    return copy_slice(layer, own)


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
        raise ProblemError(
            describe(layer), f"could not be read: {reason}. Check the file it comes from."
        ) from error
    hidden = int(np.ma.getmaskarray(picture).sum()) if isinstance(picture, np.ma.MaskedArray) else 0
    if hidden:
        raise ProblemError(
            describe(layer),
            f"is a masked array with {hidden} masked values in this slice, and a mask would be "
            "lost. Fill them with a value (0 is where there is no tissue).",
        )
    return np.asarray(picture)


def check_place(
    layer: Any, own: Frame, reference: Any, frame: Frame, shape: tuple[int, int]
) -> None:
    """Refuse a layer that does not lie where the reference does."""
    if not frame.same_place(own, shape):
        raise ProblemError(
            describe(layer),
            f"lies elsewhere than {describe(reference)}: their scale, translation, rotation, "
            "shear, affine or units differ. Give both the same transform, or resample one.",
        )


@contextmanager
def naming(**layers: Any) -> Iterator[None]:
    """Let errors about y, c, m or the spacing name the layer these came from."""
    try:
        yield
    except ProblemError as error:
        layer = layers.get(error.field)
        if layer is None:
            raise
        raise ProblemError(describe(layer), error.message) from error
