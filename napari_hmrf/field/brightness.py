"""Brightness of colour images, and edge confidence of images."""

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
