"""Second image of a study, interpolated on the grid of the study."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from napari_hmrf.errors import LayerError
from napari_hmrf.field.brightness import luminance
from napari_hmrf.field.frame import Frame
from napari_hmrf.layers.result_layers import LayerData, layer_on
from napari_hmrf.layers.slice_view import View, frame_of, full_resolution, layer_extents
from napari_hmrf.registration.alignment import matrix_in_pixels
from napari_hmrf.registration.study_registration import SecondPicture

#: Distance from the outermost pixel centres, in pixels, up to which an image covers a position.
_MARGIN = 0.5
# Largest distance of positions from pixel centres that counts as rounding, in pixels.
_SAME = 1e-3


def second_picture(
    layer: Any, frame: Frame, shape: tuple[int, ...], view: View | None = None
) -> SecondPicture:
    """Return the brightness of an image layer at the sites of a study.

    The positions of both images in the world decide which pixels belong together.

    Parameters
    ----------
    layer : napari.layers.Image
        Image on any grid. Along axes that the study lacks, such as time, the visible position
        counts.
    frame : Frame
        Place of the study.
    shape : tuple of int
        Grid of the study.
    view : View, optional
        View that shows the visible position.

    Returns
    -------
    SecondPicture

    Raises
    ------
    LayerError
        If the image has other units or lacks an axis of the study, or does not cover its grid.
    """
    data, extents = full_resolution(layer), layer_extents(layer)
    linear, origin = _to_pixels(layer, frame, view)
    if (box := _box_of_sites(linear, origin, shape, extents)) is not None:
        exact = _brightness(layer, data[box]).reshape(shape)
        valid = np.isfinite(exact)
        return SecondPicture(np.where(valid, exact, 0), valid, str(layer.name))
    ends = np.array(np.meshgrid(*((0, size - 1) for size in shape), indexing="ij"))
    corners = linear @ ends.reshape(len(shape), -1) + origin[:, None]
    low = np.floor(corners.min(axis=1) + _SAME).astype(int)
    high = np.ceil(corners.max(axis=1) - _SAME).astype(int) + 1
    box = tuple(
        slice(min(max(first, 0), size - 1), max(min(past, size), 1))
        for first, past, size in zip(low, high, extents, strict=True)
    )
    pixels = _brightness(layer, data[box])
    sites = np.indices(shape, dtype=np.float32).reshape(len(shape), -1)
    places = linear.astype(np.float32) @ sites + origin.astype(np.float32)[:, None]
    last = np.array(extents)[:, None] - 1
    known = ((places >= -_MARGIN) & (places <= last + _MARGIN)).all(axis=0)
    if not known.any():
        raise LayerError(
            layer,
            "does not cover the image that is deformed. Move it there (layer controls > transform, "
            "or its scale and translate), or choose another image.",
        )
    places -= np.array([part.start for part in box], np.float32)[:, None]
    valid = np.isfinite(pixels)
    sampled = ndimage.map_coordinates(
        np.where(valid, pixels, 0), places, order=1, mode="nearest", output=np.float32
    )
    if not valid.all():
        covered = ndimage.map_coordinates(valid.astype(np.float32), places, order=1, mode="nearest")
        known &= covered > 1 - _SAME
    return SecondPicture(sampled.reshape(shape), known.reshape(shape), str(layer.name))


def second_layer(picture: SecondPicture, frame: Frame, first: Any) -> LayerData:
    """Return the data of a hidden layer with a second image; pixels that are not known are NaN.

    The layer has the contrast limits of the layer of the first image if they suit it, so that equal
    brightness looks equal.
    """
    pixels = np.where(picture.known, picture.pixels, np.nan).astype(np.float32)
    own: dict[str, Any] = {"visible": False}
    if first is not None and not first.rgb and picture.known.any():
        low, high = first.contrast_limits
        darkest, brightest = float(np.nanmin(pixels)), float(np.nanmax(pixels))
        if low <= darkest and brightest <= high and 2 * (brightest - darkest) > high - low:
            own["contrast_limits"] = (low, high)
    return layer_on(frame, pixels, picture.name or "second image", {}, own)


def _brightness(layer: Any, pixels: Any) -> npt.NDArray[np.float32]:
    """Return the brightness of pixels of a layer."""
    read = np.asarray(pixels)
    return (luminance(read) if layer.rgb else read).astype(np.float32)


def _box_of_sites(
    linear: npt.NDArray[np.float64],
    origin: npt.NDArray[np.float64],
    shape: tuple[int, ...],
    extents: tuple[int, ...],
) -> tuple[slice, ...] | None:
    """Return the box of a layer whose pixels are the sites of a grid, or None if there is none."""
    lead, first = len(extents) - len(shape), np.rint(origin).astype(int)
    steps = np.concatenate([np.zeros((lead, len(shape))), np.eye(len(shape))])
    apart = np.abs(linear - steps) @ np.array(shape) + np.abs(origin - first)
    past = first + np.array([1] * lead + [*shape])
    if apart.max() > _SAME or (first < 0).any() or (past > extents).any():
        return None
    return tuple(slice(begin, end) for begin, end in zip(first, past, strict=True))


def _to_pixels(
    layer: Any, frame: Frame, view: View | None
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the matrix and the offset from sites of a frame's slice to pixels of a layer."""
    own = frame_of(layer, view)
    transform = frame.from_pixels_of(own)
    if transform is None:
        raise LayerError(
            layer, "has different units from the image that is deformed. Use the same units."
        )
    lead, lacking = max(own.ndim - frame.ndim, 0), max(frame.ndim - own.ndim, 0)
    if min(frame.plane) < lacking:
        raise LayerError(
            layer, f"has {own.ndim} axes only, so it cannot show the whole volume. Choose a volume."
        )
    index = np.array(own.index[:lead], np.float64)
    matrix = transform[lacking:, lead:-1]
    offset = transform[lacking:, -1] + transform[lacking:, :lead] @ index
    back = np.linalg.inv(matrix)
    start = np.array(frame.index, np.float64)
    start[list(frame.plane)] = 0
    linear = back[:, [axis - lacking for axis in frame.plane]]
    origin = back @ (start[lacking:] - offset)
    leading = np.zeros((lead, len(frame.plane)))
    return np.concatenate([leading, linear]), np.concatenate([index, origin])


def align_layer(
    layer: Any, frame: Frame, matrix: npt.NDArray[np.float64], view: View | None = None
) -> bool:
    """Move a layer in the world by the alignment of a registration; return whether it was moved.

    Parameters
    ----------
    layer : napari.layers.Image
    frame : Frame
        Place of the study.
    matrix : ndarray, shape (n + 1, n + 1)
        Matrix from positions of the study to positions of the layer on the grid of the study, in
        the unit of the spacing; the first pixel is at the origin.
    view : View, optional
    """
    own = frame_of(layer, view)
    if own.ndim != frame.ndim or own.units != frame.units:
        return False
    axes, size = list(frame.plane), frame.ndim
    pixels = matrix_in_pixels(matrix, frame.spacing, frame.spacing)
    whole = np.eye(size + 1)
    whole[np.ix_([*axes, size], [*axes, size])] = np.linalg.inv(pixels)
    world = np.array(frame.matrix)
    layer.affine = world @ whole @ np.linalg.inv(world) @ np.array(layer.affine.affine_matrix)
    return True
