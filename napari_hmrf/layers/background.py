"""Finding what of an image is air, so that nobody has to paint it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from napari_hmrf.layers.edit_history import Place
from napari_hmrf.layers.metadata import TISSUE
from napari_hmrf.layers.pixel_copy import copy_slice, plane_shape, take_slice
from napari_hmrf.layers.place import Frame
from napari_hmrf.layers.slice_view import View
from napari_hmrf.layers.table_state import Table
from napari_hmrf.study.layer_names import LayerError
from napari_hmrf.tissue.boundary_rules import Material

# Of how far what is bright is from air, so much must what is dark be apart to be two things.
_APART = 0.35
# And each of them so much of the surroundings.
_PART = 0.02
# Pixels along a side that say how bright air is.
_ENOUGH = 400
# What is dark surrounds something from this part of the picture's edge on.
_AROUND = 0.75


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


def background_of(picture: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Tell the dark surroundings of a picture from what is in it.

    Dark is what Otsu's threshold says; surroundings are what hangs together with the edge of the
    picture, so that dark places inside stay tissue. Where those are clearly of two kinds, as air
    and fat are in a CT, only the darker one is air.

    Parameters
    ----------
    picture : ndarray, shape (H, W) or (H, W, 3 or 4)

    Returns
    -------
    ndarray of bool, shape (H, W)
        Nothing, if the picture is of one value.
    """
    from skimage.filters import threshold_otsu

    grey = picture[..., :3].mean(axis=-1) if picture.ndim == 3 else picture
    values = grey[np.isfinite(grey)] if grey.dtype.kind == "f" else grey
    if not values.size or values.min() == values.max():
        return np.zeros(grey.shape, dtype=bool)
    threshold = threshold_otsu(values)
    found = _surroundings(grey, threshold)
    around = grey[found & np.isfinite(grey)].astype(np.float64)
    if around.size and around.min() < around.max():
        below = threshold_otsu(around)
        air, rest, bright = (
            around[around <= below],
            around[around > below],
            values[values > threshold],
        )
        apart = rest.mean() - air.mean() > _APART * (bright.mean() - air.mean())
        if apart and min(len(air), len(rest)) > _PART * len(around):
            found = _surroundings(grey, below)
    return found


def between_air_and_tissue(picture: npt.NDArray[Any]) -> float | None:
    """Find an intensity that what surrounds something does not have, and what is in it has.

    Parameters
    ----------
    picture : ndarray, shape (H, W)

    Returns
    -------
    float or None
        Halfway, to two digits; None if nothing dark surrounds anything.
    """
    # Of a large picture every few pixels tell as much, and the window waits for it.
    step = max(1, max(picture.shape) // _ENOUGH)
    picture = picture[::step, ::step]
    dark, known = background_of(picture), np.isfinite(picture)
    air, inside = picture[dark & known], picture[~dark & known]
    if not (surrounds(dark) and air.size and inside.size):
        return None
    return float(f"{(float(np.median(air)) + float(np.percentile(inside, 5))) / 2:.2g}")


def air_that_is_tissue(picture: npt.NDArray[Any], tissue: npt.NDArray[np.bool_]) -> tuple[str, ...]:
    """Say so where most of what is dark around a picture counts as tissue, as a clause.

    Parameters
    ----------
    picture : ndarray, shape (H, W) or (H, W, 3 or 4)
    tissue : ndarray of bool, shape (H, W)
    """
    dark = background_of(picture)
    if not surrounds(dark) or 2 * np.count_nonzero(dark & tissue) < np.count_nonzero(dark):
        return ()
    note = (
        "the dark surroundings of the image move as tissue does, too: if they are air, 'Background "
        "is no tissue' in Deform tissue makes them none"
    )
    return (note,)


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


def surrounds(dark: npt.NDArray[np.bool_]) -> bool:
    """Whether what is dark in a picture surrounds something: in a photograph it is a shadow.

    Parameters
    ----------
    dark : ndarray of bool, shape (H, W)
        Of `background_of`.
    """
    edge = np.concatenate([dark[0], dark[-1], dark[:, 0], dark[:, -1]])
    return bool(edge.mean() >= _AROUND)


def _surroundings(grey: npt.NDArray[Any], threshold: float) -> npt.NDArray[np.bool_]:
    """What is dark and hangs together with the edge."""
    dark = ~(grey > threshold)  # what is no number is dark
    # A ring around the picture joins all that reaches its edge.
    pieces, _ = ndimage.label(np.pad(dark, 1, constant_values=True))
    found: npt.NDArray[np.bool_] = (pieces == pieces[0, 0])[1:-1, 1:-1]
    return found
