"""Which of several images somebody looks at: the one that is selected, or lies in front."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

import numpy as np
from napari.layers import Image

from napari_hmrf.layers.compat import camera_of
from napari_hmrf.layers.metadata import BOUNDARY, IMAGE, TISSUE, known_of, role_of
from napari_hmrf.layers.slice_view import View, fits, full_resolution

#: Ways of drawing an image that leave nothing to be seen of what lies beneath.
_OPAQUE = ("opaque", "translucent", "translucent_no_depth")
#: Along each axis it is asked of so many places whether they are seen.
_ALONG = 5


def image_in_front(viewer: Any, images: Iterable[Any], worked_on: Iterable[Any] = ()) -> Any:
    """Find the image that somebody means who says nothing.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    images : iterable of napari.layers.Image
        Those it may be, lowest first.
    worked_on : iterable of napari.layers.Layer
        If there are any among `images`, it is one of these.

    Returns
    -------
    napari.layers.Image or None
        The active one, or else the topmost that is selected, or visible, or there.
    """
    known, selection = set(worked_on), viewer.layers.selection

    def likelihood(image: Any) -> tuple[bool, ...]:
        return image in known, image is selection.active, image in selection, image.visible

    return max(reversed([*images]), key=likelihood, default=None)


def painted_on(image: Any, layers: Iterable[Any], view: View | None = None) -> list[Any]:
    """Those of some layers, lowest first, that are tissues or boundaries on an image's pixels.

    What came with the image of a sample lies above it, and goes with no other.
    """
    found, there = list[Any](), list(layers)
    for at, layer in enumerate(there):
        if role_of(layer) in (TISSUE, BOUNDARY) and fits(layer, image, view):
            below = (each for each in reversed(there[:at]) if role_of(each) == IMAGE)
            if next((each for each in below if fits(layer, each, view)), image) is image:
                found.append(layer)
    return found


def image_covering(viewer: Any, image: Any, places: Iterable[Sequence[float]] = ()) -> Any:
    """Find the topmost image that hides places of another one; else None.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    image : napari.layers.Image
        In the viewer.
    places : iterable of sequence of float
        In the world, that must all be hidden; by default some all over the image.
    """
    there, layers = tuple(places) or _places(viewer, image), list(viewer.layers)
    above = filter(_is_opaque, reversed(layers[layers.index(image) + 1 :]))
    view = View.of(viewer.dims)
    return next((each for each in above if all(_holds(each, at, view) for at in there)), None)


def uncover(viewer: Any, image: Any) -> list[Any]:
    """Show an image, and hide all images that hide any of it; returns these."""
    image.visible, hidden = True, list[Any]()
    for place in _places(viewer, image):
        while (other := image_covering(viewer, image, [place])) is not None:
            other.visible = False
            hidden.append(other)
    return hidden


def in_middle(viewer: Any, image: Any) -> bool:
    """Whether the middle of what a viewer shows lies on an image."""
    place, shown = list(viewer.dims.point), viewer.dims.displayed
    for axis, at in zip(shown, camera_of(viewer).center[-len(shown) :], strict=True):
        place[axis] = at
    return _holds(image, place, View.of(viewer.dims))


def _places(viewer: Any, image: Any) -> list[tuple[float, ...]]:
    """The corners of an image as a viewer shows it, and places between, in the world."""
    extent, missing = image.extent.world, viewer.dims.ndim - image.ndim
    ends: list[Any] = [[at] for at in viewer.dims.point]
    for axis in viewer.dims.displayed:
        low, high = extent[:, axis - missing] if axis >= missing else viewer.dims.range[axis][:2]
        ends[axis] = np.linspace(low, high, _ALONG)
    return list(product(*ends))


def _is_opaque(layer: Any) -> bool:
    plain = isinstance(layer, Image) and "kind" not in known_of(layer)  # that is a result
    seen = plain and layer.visible and layer.blending in _OPAQUE
    # Of colours the fourth is how much is seen through them.
    return seen and layer.opacity == 1 and not (layer.rgb and layer.data.shape[-1] == 4)


def _holds(layer: Any, place: Sequence[float], view: View) -> bool:
    """Whether a viewer shows one of a layer's pixels at a place in the world."""
    if layer.ndim > len(place):
        return False
    pixel = np.rint(view.pixel(layer, place))
    extents = np.array(full_resolution(layer).shape[: layer.ndim])
    return bool(((pixel >= 0) & (pixel < extents)).all())
