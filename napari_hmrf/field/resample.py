"""Interpolation of an image at the origins of its tissue."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.arguments import real, shown
from napari_hmrf.compute.compile_cache import loader, loops
from napari_hmrf.compute.thread import compute_thread
from napari_hmrf.errors import ProblemError
from napari_hmrf.field.brightness import without_padding
from napari_hmrf.field.slabs import slabs
from napari_hmrf.real_arrays import as_numbers

Float64Array = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


def resample(
    image: npt.ArrayLike,
    coordinates: npt.ArrayLike,
    covered: npt.ArrayLike,
    *,
    order: int = 1,
    fill: float = 0,
) -> npt.NDArray[Any]:
    """Interpolate an image at the coordinates of an `inverse_map`.

    NaN and infinite values do not spread: they are ignored by the interpolation around them.

    Parameters
    ----------
    image : array_like, shape ([D,] H, W) or ([D,] H, W, channels)
    coordinates, covered
        Output of `inverse_map`.
    order, fill
        As in `warp`.

    Returns
    -------
    ndarray
        Resampled image, with the shape and dtype of `image`.

    Raises
    ------
    ProblemError
        If an input is invalid; the error names the input.
    """
    source = as_numbers("coordinates", coordinates).astype(np.float64, copy=False)
    mask = as_numbers("covered", covered).astype(bool, copy=False)
    if source.shape != (*mask.shape, mask.ndim) or mask.ndim not in (2, 3):
        raise ProblemError(
            "coordinates",
            f"have shape {source.shape}, but covered has {mask.shape}. Pass both results of "
            "inverse_map.",
        )
    picture = as_image(image, mask.shape)
    order = checked_order(order)
    background = checked_fill(fill, picture.dtype)
    if mask.ndim == 3:
        resampled = _by_loop(picture, source, mask, order, background)
        if resampled is not None:
            return resampled
    known = np.asarray(np.isfinite(source).all(axis=-1))
    if not known.all():
        if (mask & ~known).any():
            raise ProblemError(
                "coordinates",
                f"are NaN or infinite at {int((mask & ~known).sum())} covered pixels. Pass both "
                "results of inverse_map.",
            )
        source = np.where(known[..., None], source, 0.0)
    moved = sampled(picture, source, order)
    moved[~mask] = background
    return moved


def _by_loop(
    picture: npt.NDArray[Any],
    source: Float64Array,
    covered: BoolArray,
    order: int,
    background: npt.NDArray[Any],
) -> npt.NDArray[Any] | None:
    """Interpolate a volume with the compiled loop; None if the loop cannot be used."""
    kind = picture.dtype
    nearest = order == 0 or kind.kind == "b"
    # Values that are only copied can be reinterpreted as any dtype of the same size. Other values
    # are converted to a dtype that represents them exactly.
    bits = nearest and kind.kind in "iu" and kind.itemsize == 8 and kind.isnative
    taken = _numbers_for(kind)
    if not (bits or taken) or not (nearest or order == 1) or not loops.ready_for_volumes():
        return None
    loader.before_numba()
    from napari_hmrf.field.volume_loops import look_up  # heavy: numba

    values = picture.view(np.float64) if bits else picture.astype(taken, copy=False)
    values = np.ascontiguousarray(values).reshape(*covered.shape, -1)
    smooth, gaps = values, False
    if kind.kind == "f" and not nearest:
        channels = [filled_in(channel) for channel in np.moveaxis(values, -1, 0)]
        gaps = any(bad.any() for _, bad in channels)
        if gaps:
            smooth = np.stack([filled for filled, _ in channels], axis=-1)
    moved = np.empty_like(values)
    fill = background.view(np.float64) if bits else background.astype(taken)
    images = loops.only_read(values), loops.only_read(smooth), gaps
    places = [loops.only_read(each) for each in (source, covered)]
    settings = nearest, kind.kind != "f", fill[()]

    def looked_up() -> bool:
        fine = np.ones(len(covered), bool)
        for slab in slabs(covered.shape):
            about = *(each[slab] for each in places), *settings
            look_up(*images, *about, moved[slab], fine[slab])
        return bool(fine.all())

    if not compute_thread.result_of(looked_up, "resampling a volume"):
        return None
    moved = moved.view(kind) if bits else moved.astype(kind, copy=False)
    return moved.reshape(picture.shape)


def _numbers_for(kind: np.dtype[Any]) -> str:
    """Return the dtype of the loop for volumes that represents all values of a dtype, or ""."""
    for taken in ("float32", "float64"):
        wide = kind.kind in "iu" and kind.itemsize == 8  # `can_cast` wrongly accepts these
        if np.can_cast(kind, taken) and not wide:
            return taken
    return ""


def sampled(picture: npt.NDArray[Any], places: Float64Array, order: int) -> npt.NDArray[Any]:
    """Interpolate a grey or colour image at positions, (..., n) in pixels; return a new array."""
    n = places.shape[-1]
    axes = tuple(np.moveaxis(places, -1, 0))
    nearest = tuple(
        np.clip(np.floor(at + 0.5), 0, size - 1).astype(np.intp)
        for at, size in zip(axes, picture.shape[:n], strict=True)
    )
    if order == 0 or picture.dtype.kind == "b":
        copied: npt.NDArray[Any] = picture[nearest]
        return copied
    if picture.ndim == n:
        return _interpolated(picture, axes, nearest, order)
    channels = np.moveaxis(picture, -1, 0)
    return np.stack([_interpolated(channel, axes, nearest, order) for channel in channels], axis=-1)


def unknown_values(picture: npt.NDArray[Any], axes: int, name: str) -> str:
    """Return a clause about the NaN or infinite pixels of an image; "" if there are none.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, channels)
    axes : int
        Number of spatial axes: 2, or 3 for a volume.
    name : str
        Name of the image, which is the start of the clause.

    Returns
    -------
    str
    """
    if picture.dtype.kind != "f" or np.isfinite(picture).all():
        return ""
    unknown = ~np.isfinite(picture).reshape(*picture.shape[:axes], -1).all(axis=-1)
    count, sites = int(unknown.sum()), "voxel" if axes == 3 else "pixel"
    return (
        f"{name} is NaN or infinite at {count} {sites}{'s' * (count > 1)}, and remains so "
        "where they move"
    )


def without_removed(picture: npt.ArrayLike, removed: BoolArray | None, fill: float) -> Any:
    """Return a picture with the pixels of removed tissue replaced, to warp the remaining tissue.

    Parameters
    ----------
    picture : array_like, shape ([D,] H, W) or ([D,] H, W, channels)
    removed : ndarray of bool, shape ([D,] H, W), optional
        Mask of the removed tissue; None to return the picture itself.
    fill : float
        Value of the replaced pixels.

    Raises
    ------
    ProblemError
        If the picture does not have the pixel grid of the mask.
    """
    if removed is None:
        return picture
    remaining = np.array(as_image(picture, removed.shape))
    remaining[removed] = checked_fill(fill, remaining.dtype)
    return remaining


def emptiness(picture: npt.NDArray[Any], axes: int = 2) -> Any:
    """Return the fill value of uncovered pixels: 0 for colours, the lowest value for grey images.

    In CT the lowest value is air; padding below it does not count, see `without_padding`. The fill
    value is a Python number of the type of the image, because a float cannot represent the largest
    integers.

    Parameters
    ----------
    picture : ndarray, shape ([D,] H, W) or ([D,] H, W, channels)
    axes : int
        Number of spatial axes: 2, or 3 for a volume.
    """
    if picture.ndim > axes:
        return 0
    finite = picture[np.isfinite(picture)] if picture.dtype.kind == "f" else picture
    return without_padding(finite).min().item() if finite.size else 0


def as_image(image: npt.ArrayLike, grid: tuple[int, ...]) -> npt.NDArray[Any]:
    """Check that an image has the shape of a grid, with an optional last axis of channels."""
    picture, n = as_numbers("image", image), len(grid)
    if n < 2 or picture.ndim not in (n, n + 1) or picture.shape[:n] != tuple(grid):
        given = "(D, H, W) or (D, H, W, channels)" if n == 3 else "(H, W) or (H, W, channels)"
        raise ProblemError(
            "image",
            f"has shape {picture.shape}, but the displacement is on a grid of {tuple(grid)}. "
            f"Pass an image {given} on the same pixel grid.",
        )
    return picture


def checked_order(order: int) -> int:
    """Check the order of spline interpolation."""
    if real(order) not in (0, 1, 2, 3, 4, 5):
        raise ProblemError("order", f"is {shown(order)}. Use an integer from 0 to 5.")
    return int(order)


def checked_fill(fill: float, dtype: np.dtype[Any]) -> Any:
    """Convert a fill value to the dtype of an image; raise an error if the value does not fit."""
    try:
        # Integers are compared as integers: as a float, the largest integer would be rounded up.
        whole = dtype.kind in "iu" and isinstance(fill, int | np.integer)
        value = fill if whole else float(fill)
        low, high = (0, 1) if dtype.kind == "b" else (-math.inf, math.inf)
        if dtype.kind in "iu":
            low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
        fits = dtype.kind == "f" or (low <= value <= high and value == int(value))
    except (TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise ProblemError("fill", f"is {shown(fill)}. Pass a value that fits the type {dtype}.")
    return np.asarray(fill).astype(dtype)


def filled_in(values: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], BoolArray]:
    """Replace each NaN or infinite value with the value of the nearest finite pixel.

    This is required before interpolation, because a NaN spreads even with a weight of 0.

    Returns
    -------
    values : ndarray, shape ([D,] H, W)
        Filled values; the input array itself if all or none of its values are finite.
    bad : ndarray, shape ([D,] H, W), bool
        Mask of the input values that are not finite.
    """
    bad = ~np.isfinite(values)
    if bad.any() and not bad.all():
        neighbour = scipy.ndimage.distance_transform_edt(
            bad, return_distances=False, return_indices=True
        )
        values = values[tuple(neighbour)]
    return values, bad


def _interpolated(
    channel: npt.NDArray[Any],
    at: tuple[Float64Array, ...],
    nearest: tuple[npt.NDArray[np.intp], ...],
    order: int,
) -> npt.NDArray[Any]:
    """Interpolate one channel at real-valued coordinates; the result has the same dtype."""
    values = channel if channel.dtype in (np.float32, np.float64) else channel.astype(np.float64)
    values, bad = filled_in(values)
    moved: npt.NDArray[Any] = scipy.ndimage.map_coordinates(values, at, order=order, mode="nearest")
    if channel.dtype.kind == "f":
        moved = moved.astype(channel.dtype)
        if bad.any():
            moved = np.where(bad[nearest], channel[nearest], moved)
        return moved
    bounds = np.iinfo(channel.dtype)
    # A float cannot represent the largest 64-bit integers, so use the next lower float.
    highest = float(bounds.max)
    if int(highest) > bounds.max:
        highest = math.nextafter(highest, 0)
    whole: npt.NDArray[Any] = np.clip(np.rint(moved), bounds.min, highest).astype(channel.dtype)
    return whole
