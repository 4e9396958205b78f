"""Where an image has edges: there a registration can be believed."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.tissue.stiffness_curve import luminance

#: Pixels whose slope is steeper than that of this share of all are edges.
_SHARE = 0.9


def at_edges(image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Complete confidence where an image has its steepest edges, and none elsewhere.

    Parameters
    ----------
    image : ndarray, shape (H, W) or (H, W, 3 or 4)

    Returns
    -------
    ndarray, shape (H, W), float32
        1 at the steepest tenth of the pixels.
    """
    from skimage.filters import gaussian, sobel

    slope = sobel(gaussian(luminance(image) if image.ndim > 2 else image.astype(float), 1))
    steep: npt.NDArray[np.float32] = (slope > np.quantile(slope, _SHARE)).astype(np.float32)
    return steep
