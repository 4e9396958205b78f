"""Compiled loop that interpolates an image at an inverse map, as `resample` does, on all cores.

This module imports numba. `live_warp` imports this module on first use, on the compute thread.
"""

# mypy: disable-error-code="no-untyped-def, untyped-decorator"
from __future__ import annotations

import math

import numpy as np

from napari_hmrf.compute.compile_cache.threaded import portion, threaded


@threaded()
def look_up(thread, image, smooth, gaps, source, state, tissue, nearest, whole, fill, moved):
    """Interpolate an image at the origins of the moved tissue, as `resample` does, on all cores.

    Parameters
    ----------
    image : ndarray, shape (H, W, channels)
    smooth : ndarray, shape (H, W, channels)
        Copy of the image for interpolation, without values that are not finite.
    gaps : bool
        True if the image has values that are not finite. If the value nearest to the origin of a
        pixel is not finite, it is copied to that pixel.
    source, state
        Output of `triangle_raster.rasterise`.
    tissue : ndarray, shape (H, W), bool
        Mask of the tissue. Pixels outside tissue that no tissue reaches retain their values.
    nearest : bool
        If True, copy the nearest pixel; if False, interpolate between the four nearest pixels.
    whole : bool
        If True, round to integers.
    fill
        Value of uncovered pixels, in the type of the image.
    moved : ndarray, shape (H, W, channels)
        Output.
    """
    height, width, channels = image.shape
    for row in portion(thread, height):
        for col in range(width):
            if state[row, col] == 0:
                for k in range(channels):
                    moved[row, col, k] = fill if tissue[row, col] else image[row, col, k]
                continue
            y = min(max(source[row, col, 0], 0.0), height - 1.0)
            x = min(max(source[row, col, 1], 0.0), width - 1.0)
            i = math.floor(y + 0.5)
            j = math.floor(x + 0.5)
            if nearest:
                for k in range(channels):
                    moved[row, col, k] = image[i, j, k]
                continue
            top = math.floor(y)
            left = math.floor(x)
            below = min(top + 1, height - 1)
            right = min(left + 1, width - 1)
            down = y - top
            along = x - left
            for k in range(channels):
                value = smooth[top, left, k] * (1.0 - down) * (1.0 - along)
                value += smooth[top, right, k] * (1.0 - down) * along
                value += smooth[below, left, k] * down * (1.0 - along)
                value += smooth[below, right, k] * down * along
                moved[row, col, k] = np.rint(value) if whole else value
                if gaps and not np.isfinite(image[i, j, k]):
                    moved[row, col, k] = image[i, j, k]
