"""Compiled loops that interpolate volumes at an inverse map and compute their strain.

This module imports numba. `resample`, `deformation` and `strain` import this module for volumes.
Until its loops are compiled, these modules use NumPy and SciPy instead.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
from __future__ import annotations

import math

import numpy as np

from napari_hmrf.compute.compile_cache.decorators import cached, callee
from napari_hmrf.compute.compile_cache.threaded import portion, threaded

_callee = callee()


@threaded()
def look_up(thread, image, smooth, gaps, source, covered, nearest, whole, fill, moved, fine):
    """Interpolate a volume at the origins of the moved tissue, as `resample` does, on all cores.

    Parameters
    ----------
    image : ndarray, shape (D, H, W, channels)
    smooth : ndarray, shape (D, H, W, channels)
        Copy of the image for interpolation, without values that are not finite.
    gaps : bool
        True if the image has values that are not finite. If the value nearest to the origin of a
        voxel is not finite, it is copied to that voxel.
    source : ndarray, shape (P, H, W, 3), float64
        Origins of the voxels of some planes, from `inverse_map`.
    covered : ndarray, shape (P, H, W), bool
        Mask of the voxels that have an origin, from `inverse_map`.
    nearest : bool
        If True, copy the nearest voxel; if False, interpolate between the eight nearest voxels.
    whole : bool
        If True, round to integers.
    fill
        Value of uncovered voxels, in the type of the image.
    moved : ndarray, shape (P, H, W, channels)
        Output.
    fine : ndarray, shape (P,), bool
        Output, initially True: False for planes with an origin that is not finite.
    """
    depth, height, width, channels = image.shape
    for plane in portion(thread, len(covered)):
        for row in range(height):
            for col in range(width):
                if not covered[plane, row, col]:
                    for channel in range(channels):
                        moved[plane, row, col, channel] = fill
                    continue
                z = source[plane, row, col, 0]
                y = source[plane, row, col, 1]
                x = source[plane, row, col, 2]
                if not math.isfinite(z + y + x):
                    fine[plane] = False
                    continue
                z = min(max(z, 0.0), depth - 1.0)
                y = min(max(y, 0.0), height - 1.0)
                x = min(max(x, 0.0), width - 1.0)
                i, j, k = math.floor(z + 0.5), math.floor(y + 0.5), math.floor(x + 0.5)
                if nearest:
                    for channel in range(channels):
                        moved[plane, row, col, channel] = image[i, j, k, channel]
                    continue
                above, top, left = math.floor(z), math.floor(y), math.floor(x)
                under = min(above + 1, depth - 1)
                below, right = min(top + 1, height - 1), min(left + 1, width - 1)
                deep, down, along = z - above, y - top, x - left
                for channel in range(channels):
                    a = smooth[above, top, left, channel] * (1.0 - along)
                    a += smooth[above, top, right, channel] * along
                    b = smooth[above, below, left, channel] * (1.0 - along)
                    b += smooth[above, below, right, channel] * along
                    c = smooth[under, top, left, channel] * (1.0 - along)
                    c += smooth[under, top, right, channel] * along
                    d = smooth[under, below, left, channel] * (1.0 - along)
                    d += smooth[under, below, right, channel] * along
                    before, after = a * (1.0 - down) + b * down, c * (1.0 - down) + d * down
                    value = before * (1.0 - deep) + after * deep
                    moved[plane, row, col, channel] = np.rint(value) if whole else value
                    if gaps and not math.isfinite(image[i, j, k, channel]):
                        moved[plane, row, col, channel] = image[i, j, k, channel]


@_callee
def _steps(moved, tissue, plane, row, col, i, j, k):
    """Return the differences with the next and the previous site in the direction (i, j, k)."""
    # If one neighbour is missing, both differences are computed from the existing neighbour. If
    # both neighbours are missing, both differences are the undeformed step.
    depth, height, width = tissue.shape
    z, y, x = moved[plane, row, col, 0], moved[plane, row, col, 1], moved[plane, row, col, 2]
    following = previous = 1.0 * i, 1.0 * j, 1.0 * k
    p, r, c = plane - i, row - j, col - k
    begun = min(p, r, c) >= 0 and tissue[p, r, c]
    if begun:
        previous = z - moved[p, r, c, 0], y - moved[p, r, c, 1], x - moved[p, r, c, 2]
        following = previous
    p, r, c = plane + i, row + j, col + k
    if p < depth and r < height and c < width and tissue[p, r, c]:
        following = moved[p, r, c, 0] - z, moved[p, r, c, 1] - y, moved[p, r, c, 2] - x
        if not begun:
            previous = following
    return following, previous


@_callee
def _across(b, c):
    """Return the cross product of two vectors."""
    return b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]


@_callee
def _octants(step, rows, cols):
    """Return the determinants of the four octants on one side of a site along the first axis."""
    one, two = _across(rows[0], cols[0]), _across(rows[0], cols[1])
    three, four = _across(rows[1], cols[0]), _across(rows[1], cols[1])
    return (
        step[0] * one[0] + step[1] * one[1] + step[2] * one[2],
        step[0] * two[0] + step[1] * two[1] + step[2] * two[2],
        step[0] * three[0] + step[1] * three[1] + step[2] * three[2],
        step[0] * four[0] + step[1] * four[1] + step[2] * four[2],
    )


@cached()
def determinants(moved, tissue, elements, kind):
    """Reduce the determinants of the eight octants around each site of a volume to one value.

    The loop runs on a single core, so any thread may call it, not only the compute thread. For a
    volume, the loop takes as long as a few sweeps of a solver.

    Parameters
    ----------
    moved : ndarray, shape (D, H, W, 3), float64
        Moved positions of the sites, as returned by `moved_sites`.
    tissue : ndarray, shape (D, H, W), bool
        Mask of the tissue.
    elements : ndarray, shape (D + 1, H + 1, W + 1), bool
        Mask of existing elements, as returned by `deformation.elements`.
    kind : int
        0: smallest determinant of the existing elements, or 1.0 if there are none. 1: mean of all
        octants. 2: the smallest determinant if it is 0 or below, otherwise the mean.

    Returns
    -------
    ndarray, shape (D, H, W), float32
        Reduced determinants; NaN outside tissue.
    """
    depth, height, width = tissue.shape
    made = np.empty(tissue.shape, np.float32)
    for plane in range(depth):
        for row in range(height):
            for col in range(width):
                if not tissue[plane, row, col]:
                    made[plane, row, col] = np.nan
                    continue
                planes = _steps(moved, tissue, plane, row, col, 1, 0, 0)
                rows = _steps(moved, tissue, plane, row, col, 0, 1, 0)
                cols = _steps(moved, tissue, plane, row, col, 0, 0, 1)
                a, b, c, d = _octants(planes[0], rows, cols)
                e, f, g, h = _octants(planes[1], rows, cols)
                mean = (a + b + c + d + e + f + g + h) / 8
                octants = (a, b, c, d, e, f, g, h)
                smallest = np.inf
                for number in range(8):
                    p, r, s = 1 - number // 4, 1 - number // 2 % 2, 1 - number % 2
                    if elements[plane + p, row + r, col + s]:
                        smallest = min(smallest, octants[number])
                if smallest == np.inf:
                    smallest = 1.0
                if kind == 0 or (kind == 2 and smallest <= 0):
                    made[plane, row, col] = smallest
                else:
                    made[plane, row, col] = mean
    return made


@cached()
def gradients(moved, tissue, sizes):
    """Return the displacement gradient at each tissue site of a volume.

    Any thread may call this loop, as for `determinants`.

    Parameters
    ----------
    moved : ndarray, shape (D, H, W, 3), float64
        Moved positions of the sites, as returned by `moved_sites`.
    tissue : ndarray, shape (D, H, W), bool
        Mask of the tissue.
    sizes : ndarray, shape (3,)
        Size of a voxel along each axis.

    Returns
    -------
    ndarray, shape (N, 3, 3), float64
        H[..., i, j] = dd_i / dX_j, dimensionless, for the N tissue sites in order.
    """
    depth, height, width = tissue.shape
    found = np.empty((tissue.sum(), 3, 3))
    number = 0
    for plane in range(depth):
        for row in range(height):
            for col in range(width):
                if not tissue[plane, row, col]:
                    continue
                along = (
                    _steps(moved, tissue, plane, row, col, 1, 0, 0),
                    _steps(moved, tissue, plane, row, col, 0, 1, 0),
                    _steps(moved, tissue, plane, row, col, 0, 0, 1),
                )
                for j in range(3):
                    following, previous = along[j]
                    for i in range(3):
                        unstrained = 1.0 if i == j else 0.0
                        mean = (following[i] + previous[i]) / 2 - unstrained
                        found[number, i, j] = mean * (sizes[i] / sizes[j])
                number += 1
    return found
