"""Brightness of images, and confidence at their edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.errors import ProblemError
from napari_hmrf.solver.problem import as_numbers

# Brightness of red, green and blue (ITU-R BT.709).
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
# Pixels whose slope is steeper than that of this share of all are edges.
_SHARE = 0.9


def luminance(colours: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Compute the brightness of colours, from 0 to the largest value of their type.

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
        If these are no colours.
    """
    colours = as_numbers("colours", colours)
    if colours.ndim == 0 or colours.shape[-1] not in (3, 4):
        raise ProblemError(
            "colours", f"has shape {colours.shape}. Give (..., 3 or 4): red, green, blue."
        )
    bright: npt.NDArray[np.float32] = colours[..., :3].astype(np.float32) @ _LUMINANCE
    return bright


def edge_confidence(image: npt.NDArray[Any], *, axes: int = 2) -> npt.NDArray[np.float32]:
    """Return confidence 1 where an image has its steepest edges, and 0 elsewhere.

    Parameters
    ----------
    image : ndarray, shape ([D,] H, W) or ([D,] H, W, 3 or 4)
    axes : int
        Number of axes without that of the colours: 3 for a volume.

    Returns
    -------
    ndarray, shape ([D,] H, W), float32
        1 at the steepest tenth of the pixels.
    """
    from skimage.filters import gaussian, sobel  # heavy: skimage

    slope = sobel(gaussian(luminance(image) if image.ndim > axes else image.astype(float), 1))
    steep: npt.NDArray[np.float32] = (slope > np.quantile(slope, _SHARE)).astype(np.float32)
    return steep
