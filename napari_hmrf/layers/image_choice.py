"""Selection of the image to deform, and its visibility in a viewer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any

import numpy as np
from napari.layers import Image

from napari_hmrf.field.units import unit_name
from napari_hmrf.layers.compat import camera_of
from napari_hmrf.layers.metadata import BOUNDARY, IMAGE, TISSUE, metadata_of, role_of
from napari_hmrf.layers.slice_view import View, fits, full_resolution
from napari_hmrf.layers.viewer_layers import ViewerLayers

#: Blending modes in which an image hides the layers below it.
_OPAQUE = ("opaque", "translucent", "translucent_no_depth")
#: Attributes that define the position of a layer, besides its units.
_POSITION = ("scale", "translate", "rotate", "shear", "affine")
#: Smallest share of the box around two images that both must cover to count as the same place.
_SHARED = 0.5
#: Number of points along each axis at which the visibility of an image is checked.
_SAMPLES = 5


def image_in_front(viewer: Any, images: Iterable[Any], worked_on: Iterable[Any] = ()) -> Any:
    """Return the image to deform if the user has not chosen an image.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    images : iterable of napari.layers.Image
        Candidates, lowest first.
    worked_on : iterable of napari.layers.Layer
        Layers with edits; candidates among them take precedence.

    Returns
    -------
    napari.layers.Image or None
        In order of preference: the active image, the topmost selected image, the topmost visible
        image, the topmost image. However, napari makes each new image active: instead of the
        topmost image, the lowest image that may show the same tissue is returned. None if there
        are no candidates.
    """
    preferred, selection, candidates = set(worked_on), viewer.layers.selection, [*images]

    def likelihood(image: Any) -> tuple[bool, ...]:
        return image in preferred, image is selection.active, image in selection, image.visible

    front = max(reversed(candidates), key=likelihood, default=None)
    if front is None or front in preferred or front is not candidates[-1]:
        return front
    earlier = (each for each in candidates if each.visible or not front.visible)
    return next((each for each in earlier if may_be_second(each, front)), front)


def may_be_second(image: Any, other: Any) -> bool:
    """Return whether another image may show the tissue of an image, such as a later scan.

    This is the case if both have the same axes and units, and cover about the same box in the
    world. Different samples do not show the same tissue.
    """
    one, two = ((each.ndim, each.units, each.source.sample) for each in (image, other))
    if one != two:
        return False
    extents = [each.extent for each in (image, other)]
    boxes = np.array([(each.world[0], each.world[1] + each.step) for each in extents], float)
    (low, high), (first, last) = boxes.max(axis=0), boxes.min(axis=0)
    shared = np.clip(last - low, 0, None)
    return bool(np.prod(shared) >= _SHARED * np.prod(high - first))


def shows_other_object(image: Any, other: Any) -> bool:
    """Return whether a new image shows another object than an image, such as another sample.

    So do images without a unit of length, such as photographs, that differ in size.
    """
    if other.source.sample is not None:
        return bool(other.source.sample != image.source.sample)
    if image.ndim != other.ndim or any(unit_name(unit) != "pixel" for unit in other.units):
        return False
    return image.units == other.units and not np.array_equal(image.extent.data, other.extent.data)


def is_photograph(image: Any) -> bool:
    """Return whether an image seems to be a photograph or a drawing rather than a scan.

    This is the case for a colour image, or a single slice of 8-bit values, without a unit of length
    and without metadata of this package, which scans and samples have.
    """
    has_unit = any(unit_name(unit) != "pixel" for unit in image.units)
    if has_unit or role_of(image) is not None:
        return False
    return bool(image.rgb) or (image.ndim == 2 and full_resolution(image).dtype == np.uint8)


def is_same_image(layer: Any, image: Any) -> bool:
    """Return whether a layer is an image with the pixels and the position of another image."""
    if not isinstance(layer, Image) or layer.multiscale or image.multiscale:
        return False
    return (
        (layer.rgb, layer.data.shape, layer.units) == (image.rgb, image.data.shape, image.units)
        and all(np.array_equal(getattr(layer, name), getattr(image, name)) for name in _POSITION)
        and np.array_equal(layer.data, image.data)
    )


def painted_on(image: Any, layers: Iterable[Any], view: View | None = None) -> list[Any]:
    """Return the tissue and boundary layers on the grid of an image, lowest first.

    If several images have the same grid, a layer belongs to the nearest image below it that has a
    role, such as the image of a sample.
    """
    painted, ordered = list[Any](), list(layers)
    for at, layer in enumerate(ordered):
        if role_of(layer) in (TISSUE, BOUNDARY) and fits(layer, image, view):
            below = (each for each in reversed(ordered[:at]) if role_of(each) == IMAGE)
            if next((each for each in below if fits(layer, each, view)), image) is image:
                painted.append(layer)
    return painted


def image_covering(viewer: Any, image: Any, places: Iterable[Sequence[float]] = ()) -> Any:
    """Return the topmost image that covers another image at all given points, or None.

    Parameters
    ----------
    viewer : napari.Viewer or ViewerModel
    image : napari.layers.Image
        Image that may be covered.
    places : iterable of sequence of float
        Points in world coordinates; by default, a grid of points over the whole image.
    """
    layers = list(viewer.layers)
    above = [each for each in reversed(layers[layers.index(image) + 1 :]) if _is_opaque(each)]
    if not above:
        return None
    targets, view = tuple(places) or _sample_places(viewer, image), View.of(viewer.dims)
    return next((each for each in above if _has_pixels_at(each, targets, view)), None)


def uncover(layers: ViewerLayers, image: Any) -> list[Any]:
    """Show an image, hide all images that cover a part of it, and return the hidden images."""
    layers.want(image)
    viewer, hidden = layers.viewer, list[Any]()
    for place in _sample_places(viewer, image):
        while (other := image_covering(viewer, image, [place])) is not None:
            layers.want(other, wanted=False)
            hidden.append(other)
    return hidden


def in_middle(viewer: Any, image: Any) -> bool:
    """Return whether the centre of the canvas shows a pixel of an image."""
    place, shown = list(viewer.dims.point), viewer.dims.displayed
    for axis, at in zip(shown, camera_of(viewer).center[-len(shown) :], strict=True):
        place[axis] = at
    return _has_pixels_at(image, [place], View.of(viewer.dims))


def _sample_places(viewer: Any, image: Any) -> list[tuple[float, ...]]:
    """Return a grid of points on the visible slice of an image, in world coordinates."""
    extent, missing = image.extent.world, viewer.dims.ndim - image.ndim
    ends: list[Any] = [[at] for at in viewer.dims.point]
    for axis in viewer.dims.displayed:
        low, high = extent[:, axis - missing] if axis >= missing else viewer.dims.range[axis][:2]
        ends[axis] = np.linspace(low, high, _SAMPLES)
    return list(product(*ends))


def _is_opaque(layer: Any) -> bool:
    is_image = isinstance(layer, Image) and "kind" not in metadata_of(layer)  # not a result
    hides = is_image and layer.visible and layer.blending in _OPAQUE
    # An image with a fourth colour channel (opacity) can be transparent.
    return hides and layer.opacity == 1 and not (layer.rgb and layer.data.shape[-1] == 4)


def _has_pixels_at(layer: Any, places: Sequence[Sequence[float]], view: View) -> bool:
    """Return whether a layer has a pixel at all given points in world coordinates."""
    if layer.ndim > len(places[0]):
        return False
    pixels = np.rint(view.pixel(layer, places))
    extents = np.array(full_resolution(layer).shape[: layer.ndim])
    return bool(((pixels >= 0) & (pixels < extents)).all())
