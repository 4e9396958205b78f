"""Brightness of colour images, edge confidence of images, and padding of CT images."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import as_numbers

# Weights of red, green and blue in the luminance (ITU-R BT.709).
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
# Quantile of the gradient magnitude above which a pixel belongs to an edge.
_SHARE = 0.9
# Smallest value of a CT image with air, in Hounsfield units; lower values are padding.
_LEAST_HU = -1024
# Values of air in a CT image, in Hounsfield units.
_AIR_HU = (-1100, -900)
# Smallest fraction of a CT image that air covers, without the padding.
_AIR_SHARE = 0.02
# Largest number of samples along each axis of a large image.
_SAMPLES = 256


def luminance(colours: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Compute the luminance of colours, from 0 to the largest value of their type.

    Parameters
    ----------
    colours : ndarray, shape (..., 3 or 4)
        Red, green and blue; opacity is ignored.

    Returns
    -------
    ndarray, shape (...), float32

    Raises
    ------
    ProblemError
        If the last axis does not have 3 or 4 entries, or the array is not numeric.
    """
    colours = as_numbers("colours", colours)
    if colours.ndim == 0 or colours.shape[-1] not in (3, 4):
        raise ProblemError(
            "colours", f"has shape {colours.shape}. Pass (..., 3 or 4): red, green, blue."
        )
    bright: npt.NDArray[np.float32] = colours[..., :3].astype(np.float32) @ _LUMINANCE
    return bright


def edge_confidence(image: npt.NDArray[Any], *, axes: int = 2) -> npt.NDArray[np.float32]:
    """Return a confidence of 1 at the steepest edges of an image, and 0 elsewhere.

    Parameters
    ----------
    image : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    axes : int
        Number of spatial axes: 2 for a slice, 3 for a volume.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        1 at the steepest tenth of the pixels, 0 elsewhere.
    """
    from skimage.filters import gaussian, sobel  # heavy: skimage

    slope = sobel(gaussian(luminance(image) if image.ndim > axes else image.astype(float), 1))
    steep: npt.NDArray[np.float32] = (slope > np.quantile(slope, _SHARE)).astype(np.float32)
    return steep


def without_padding(grey: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Raise padding of a CT image to the lowest value of air; return other images unchanged.

    Padding lies outside the circle of the scanner, and has a value below air, such as -3024.

    Parameters
    ----------
    grey : ndarray
        Grey image, in Hounsfield units if it is a CT image.

    Returns
    -------
    ndarray
        Of the same shape and type.
    """
    if grey.dtype.kind not in "if" or not (is_padding := grey < _LEAST_HU).any():
        return grey
    is_air = (grey > _AIR_HU[0]) & (grey < _AIR_HU[1])
    if np.count_nonzero(is_air) < max(_AIR_SHARE * np.count_nonzero(~is_padding), 1):
        return grey
    return np.where(is_padding, grey[grey >= _LEAST_HU].min(), grey)


def thinned(image: npt.NDArray[Any], most: int) -> npt.NDArray[Any]:
    """Return a view of every k-th pixel along each axis, of which there are at most `most`."""
    return image[tuple(slice(None, None, -(-size // most)) for size in image.shape)]


def limits_without_padding(grey: npt.NDArray[Any]) -> tuple[float, float] | None:
    """Return the lowest and the highest brightness of a padded CT image, except for the padding.

    Large images are sampled.

    Parameters
    ----------
    grey : ndarray

    Returns
    -------
    tuple of float, or None
        None for other images.
    """
    sample = thinned(grey, _SAMPLES)
    inside = without_padding(sample)
    return None if inside is sample else (float(np.nanmin(inside)), float(np.nanmax(inside)))
