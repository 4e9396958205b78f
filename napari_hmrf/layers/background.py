"""Painting the dark surroundings of an image as no tissue, so that nobody has to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.layers.edit_history import Place
from napari_hmrf.layers.metadata import TISSUE
from napari_hmrf.layers.pixel_copy import copy_slice, plane_shape, take_slice
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.table_state import Table
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.tissue.boundary_rules import Material
from napari_hmrf.tissue.surroundings import background_of


@dataclass(frozen=True, eq=False)
class Filling:
    """What was painted as no tissue at once.

    Attributes
    ----------
    pixels : tuple of ndarray of int, shape (N,)
        Of each axis of the layer; they were unpainted.
    material : Material
        What they are now.
    new : bool
        Whether the material was not in the table before.
    place : Place
        The slice.
    """

    pixels: tuple[npt.NDArray[Any], ...]
    material: Material
    new: bool
    place: Place

    def paint(self, layer: Any) -> None:
        """Paint those that are unpainted; napari remembers it as a stroke of its own."""
        self._exchange(layer, 0, self.material.label)

    def erase(self, layer: Any) -> None:
        """Have those that still are as they were painted be unpainted again."""
        self._exchange(layer, self.material.label, 0)

    def _exchange(self, layer: Any, before: int, after: int) -> None:
        if not layer.visible:
            # What napari shows of a hidden layer is as it was, and it would paint there, too.
            layer.set_view_slice()
        there = np.asarray(layer.data[self.pixels]) == before
        layer.data_setitem(tuple(axis[there] for axis in self.pixels), after)


def unpainted_background(
    image: Any, tissue: Any, view: View | None = None
) -> tuple[npt.NDArray[Any], ...]:
    """Find the dark surroundings in the slice that is shown, where nothing is painted yet.

    Parameters
    ----------
    image : napari.layers.Image
    tissue : napari.layers.Labels
        In the image's place.
    view : View, optional

    Returns
    -------
    tuple of ndarray of int, shape (N,)
        Of each axis of `tissue`: where the pixels lie.

    Raises
    ------
    ProblemError
        If there are none, or the layers do not lie on the same pixels.
    """
    frame, own = Frame.of(image, view), Frame.of(tissue, view)
    labels = take_slice(tissue, own, image, frame, plane_shape(image, frame))
    empty = background_of(copy_slice(image, frame)) & (labels == 0)
    if not empty.any():
        raise LayerError(image, "has no dark surroundings that are unpainted in this slice.")
    pixels: list[Any] = list(own.index)
    for axis, places in zip(own.plane, np.nonzero(empty), strict=True):
        pixels[axis] = places
    return tuple(np.broadcast_arrays(*pixels))


def background_filling(image: Any, tissue: Any, view: View | None = None) -> Filling:
    """What is to be painted to have the dark surroundings of the slice that is shown be no tissue.

    Parameters
    ----------
    image : napari.layers.Image
    tissue : napari.layers.Labels
        In the image's place; its own table says which label is no tissue, or gets one more.
    view : View, optional

    Raises
    ------
    ProblemError
        As `unpainted_background`.
    """
    pixels = unpainted_background(image, tissue, view)
    # Of the layer: a dock that is closed does not follow it.
    rows = Table.of(tissue, TISSUE).rows
    void = [row for row in rows if row.stiffness == 0 and row.label > 0]
    label = max([0, *(row.label for row in rows)]) + 1
    material = void[0] if void else Material(label, "background", 0.0)
    return Filling(pixels, material, not void, Place.of(Frame.of(tissue, view)))
