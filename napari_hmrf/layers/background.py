"""Finding what of an image is air, so that nobody has to paint it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage

#: Steps of grey to choose the threshold from.
_BINS = 256


def background_of(picture: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Tell the dark surroundings of a picture from what is in it.

    Dark is what Otsu's threshold says; surroundings are what hangs together with the edge of the
    picture, so that dark places inside stay tissue.

    Parameters
    ----------
    picture : ndarray, shape (H, W) or (H, W, 3 or 4)

    Returns
    -------
    ndarray of bool, shape (H, W)
        Nothing, if the picture is of one value.
    """
    grey = picture[..., :3].mean(axis=-1) if picture.ndim == 3 else picture
    values = grey[np.isfinite(grey)] if grey.dtype.kind == "f" else grey
    if not values.size or values.min() == values.max():
        return np.zeros(grey.shape, dtype=bool)
    dark = ~(grey > _otsu(values))  # what is no number is dark
    # A ring around the picture joins all that reaches its edge.
    pieces, _ = ndimage.label(np.pad(dark, 1, constant_values=True))
    background: npt.NDArray[np.bool_] = (pieces == pieces[0, 0])[1:-1, 1:-1]
    return background


def _otsu(values: npt.NDArray[Any]) -> float:
    """Threshold that parts values into two classes whose means differ most, for their sizes."""
    counts, edges = np.histogram(values, bins=_BINS)
    centres = (edges[1:] + edges[:-1]) / 2
    below, total = np.cumsum(counts)[:-1].astype(float), float(values.size)
    sums = np.cumsum(counts * centres)
    mean_below = sums[:-1] / below  # the lowest bin is never empty
    mean_above = (sums[-1] - sums[:-1]) / (total - below)
    between = below * (total - below) * (mean_above - mean_below) ** 2
    return float(edges[1:-1][between.argmax()])
