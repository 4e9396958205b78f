"""Finding what of an image is air, so that nobody has to paint it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import ndimage


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
    from skimage.filters import threshold_otsu

    grey = picture[..., :3].mean(axis=-1) if picture.ndim == 3 else picture
    values = grey[np.isfinite(grey)] if grey.dtype.kind == "f" else grey
    if not values.size or values.min() == values.max():
        return np.zeros(grey.shape, dtype=bool)
    dark = ~(grey > threshold_otsu(values))  # what is no number is dark
    # A ring around the picture joins all that reaches its edge.
    pieces, _ = ndimage.label(np.pad(dark, 1, constant_values=True))
    background: npt.NDArray[np.bool_] = (pieces == pieces[0, 0])[1:-1, 1:-1]
    return background
