"""Tissue that exists in only one of two registered images, such as a tumour or a cavity.

Where tissue has no counterpart, the moving image differs from the brightness that is expected from
the fixed image, over a region that is thicker than the errors of the registration.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.field.warp import warp
from napari_hmrf.registration.image_data import (
    BoolArray,
    Checkpoint,
    FloatArray,
    Images,
    Reduced,
    Relation,
    expected_brightness,
    moved_places,
    reduced_pair,
    sampled_linearly,
    smoothed,
)

# The settings were chosen on two resections and two tumours in a brain, and then fixed. Lengths are
# in pixels of the grid on which tissue is searched.

#: Largest number of pixels of this grid; larger images are reduced.
_MOST_PIXELS = 2_000_000
#: Standard deviations of the window of a difference, and of the window of the bias.
_WINDOW, _BIAS_WINDOW = 1.5, 10.0
#: Number of estimates of the bias, and difference at which a pixel counts half in it, in standard
#: deviations.
_ESTIMATES, _DOUBTED = 4, 2.0
#: Smallest expected brightness, as a fraction of the range, at which differences are measured; the
#: background is darker.
_DARKEST = 0.1
#: Difference of the most different pixel and of the other pixels of a region, in standard
#: deviations, and smallest standard deviation that counts, as a fraction of the brightness range.
_PEAK, _LEAST, _NOISE = 8.0, 4.0, 0.0125
#: Difference at the edge of a region, relative to that inside it.
_EDGE, _INSIDE = 0.5, 0.9
#: A region contains a cross of this radius at each of its pixels, and at least as many pixels.
_RADIUS, _PIXELS = 2, 64
#: Largest fraction of the pixels that is missing tissue. If more differs, the images do not match.
_MOST_MISSING = 0.2
#: Number of pixels around missing tissue that do not count, either.
_AROUND = 1
_TINY = 1e-3


class Missing(NamedTuple):
    """Tissue without counterpart, as masks of the pixels of each image."""

    fixed: BoolArray
    moving: BoolArray


def missing_tissue(
    images: Images,
    displacement: npt.NDArray[np.floating],
    spacing: tuple[float, ...],
    relation: Relation,
    checkpoint: Checkpoint,
) -> BoolArray:
    """Find the tissue of the fixed image that has no counterpart in the moving image.

    Parameters
    ----------
    images : Images
    displacement : ndarray, shape (H, W, 2) or (D, H, W, 3)
        Result of a registration, in the unit of `spacing`.
    spacing : tuple of float
    relation : Relation
        Relation of the brightness of both images.
    checkpoint : callable
        Called between the steps; it may raise an error to cancel the computation.

    Returns
    -------
    ndarray of bool, shape (H, W) or (D, H, W)
        Mask of the tissue; False everywhere if the images differ in too large a part.
    """
    axes, shape = images.fixed.ndim, images.fixed.shape
    step = max(1, math.ceil((math.prod(shape) / _MOST_PIXELS) ** (1 / axes)))
    every = (slice(None, None, step),) * axes
    sides = tuple(step * size for size in spacing)
    reduced = reduced_pair(images, step, checkpoint)
    difference, known = _difference(reduced, displacement[every], sides, relation, checkpoint)
    found = _regions(difference)
    if found.sum() > _MOST_MISSING * known.sum():
        found[...] = False
    for axis, count in enumerate(shape):
        found = np.repeat(found, step, axis=axis).take(np.arange(count), axis=axis)
    return found


def around_missing(
    missing: BoolArray, displacement: npt.NDArray[np.floating], spacing: tuple[float, ...]
) -> Missing:
    """Return the pixels of both images that do not count because of missing tissue.

    Parameters
    ----------
    missing : ndarray of bool, shape (H, W) or (D, H, W)
        Result of `missing_tissue`.
    displacement, spacing
        As for `missing_tissue`.
    """
    fixed = scipy.ndimage.binary_dilation(missing, iterations=_AROUND)
    moved = warp(fixed.astype(np.float32), displacement, spacing=spacing)
    return Missing(fixed, np.asarray(moved > 0))


def _difference(
    images: tuple[Reduced, Reduced],
    displacement: npt.NDArray[np.floating],
    spacing: tuple[float, ...],
    relation: Relation,
    checkpoint: Checkpoint,
) -> tuple[FloatArray, BoolArray]:
    """Return differences of brightness in standard deviations, and the mask of the pixels.

    A smooth bias of one image is estimated and removed, so that missing tissue has little weight.
    """
    one, another = images
    fixed, places = one.brightness, moved_places(displacement, spacing)
    moving = sampled_linearly(another.brightness, places, checkpoint)
    known = sampled_linearly(another.share, places, checkpoint) * one.share > 1 - _TINY
    given, other = (moving, fixed) if relation == "from moving" else (fixed, moving)

    def expected(bias: FloatArray) -> FloatArray:
        return expected_brightness(given, given[known], (other / bias)[known])

    def deviation(rest: FloatArray, bright: FloatArray) -> float:
        inside = np.abs(rest[known & (bright > _DARKEST)])
        return float(np.median(inside)) / 0.6745 if inside.size else 0.0

    bias, least = np.ones_like(other), np.float32(_TINY)
    for _ in range(_ESTIMATES):
        bright = expected(bias)
        rest = other - bias * bright
        scale = max(deviation(rest, bright), _NOISE)
        weight = known / (1 + (rest / (_DOUBTED * scale)) ** 2)
        above, below = (
            smoothed(np.asarray(weight * bright * each, np.float32), _BIAS_WINDOW, checkpoint)
            for each in (other, bright)
        )
        bias = np.maximum((above + least) / (below + least), _DARKEST)
    bright = expected(bias)
    rest = smoothed(np.asarray((other - bias * bright) * known, np.float32), _WINDOW, checkpoint)
    noise = max(deviation(rest, bright), _NOISE)
    return np.asarray(np.abs(rest) / noise, np.float32), known


def _regions(difference: FloatArray) -> BoolArray:
    """Return the regions of large differences that are thick enough."""
    large = scipy.ndimage.binary_opening(difference > _LEAST, iterations=_RADIUS)
    labels, _ = scipy.ndimage.label(large)
    found = np.zeros(difference.shape, np.bool_)
    for number, box in enumerate(scipy.ndimage.find_objects(labels), start=1):
        own, values = labels[box] == number, difference[box]
        inside = values[own]
        if len(inside) >= _PIXELS and inside.max() >= _PEAK:
            edge = max(_LEAST, _EDGE * float(np.quantile(inside, _INSIDE)))
            found[box] |= own & (values > edge)
    return np.asarray(scipy.ndimage.binary_fill_holes(found))
