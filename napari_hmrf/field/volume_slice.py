"""Inverse map of a single slice of a volume, for display during a drag.

The result equals the same slice of `inverse_map`, but only sites that can move onto the slice are
drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.warp import BoolArray, Float64Array, inverse_raster, moved_sites

FloatArray = npt.NDArray[np.float32]

#: Upper bound of the distance, in voxels, between a voxel and a moved site drawn on it; the actual
#: distance is at most 0.5.
_REACH = 1.0


class SliceOrigins(NamedTuple):
    """Inverse map of a slice: the origin of the tissue at each pixel.

    Attributes
    ----------
    source : ndarray, shape (H, W, 3), float64
        Origins in voxels; 0 at pixels that are not covered.
    covered : ndarray of bool, shape (H, W)
        True at pixels with moved tissue, and at pixels outside tissue that stay in place.
    """

    source: Float64Array
    covered: BoolArray


def slice_origins(
    displacement: FloatArray,
    number: int,
    spacing: Sequence[float],
    tissue: BoolArray,
    *,
    every: Sequence[int] = (1, 1, 1),
    fraction: float = 1.0,
) -> SliceOrigins:
    """Find the origins of the pixels of one slice after the motion.

    Parameters
    ----------
    displacement : ndarray, shape (D', H', W', 3)
        Material displacement, in the unit of `spacing`, on a coarse grid; linear between sites.
    number : int
        Index of the slice along the first axis.
    spacing : sequence of float, shape (3,)
        Size of a voxel along each axis.
    tissue : ndarray of bool, shape (D, H, W)
        Mask of the tissue that moves.
    every : sequence of int, shape (3,)
        Step between the sites of the coarse grid along each axis, in voxels; the first site is at
        voxel 0.
    fraction : float
        Fraction of the displacement, from 0 to 1.

    Returns
    -------
    SliceOrigins

    Raises
    ------
    ProblemError
        If the displacement is NaN or infinite in tissue that may move onto the slice.
    """
    steps = displacement[..., 0]
    ends = np.stack([steps.min(axis=(1, 2)), steps.max(axis=(1, 2))]) * (fraction / spacing[0])
    low, high = _planes_near(ends, number, len(tissue), every[0])
    part = slice(low, high)
    d = _on_voxels(displacement, tissue, every, part)
    moved, mask = moved_sites(d, spacing, tissue[part], fraction)
    moved[..., 0] -= number - low
    sources, states = inverse_raster(moved, mask, tissue.shape, planes=1)
    source, state = sources[0], states[0]
    source[state > 0, 0] += low
    still = ~tissue[number] & (state == 0)
    source[still, 0], source[still, 1:] = number, np.argwhere(still)
    return SliceOrigins(source, (state > 0) | still)


def _planes_near(ends: Float64Array, number: int, depth: int, every: int) -> tuple[int, int]:
    """Return the range of planes with sites that may move onto the slice.

    `ends`, (2, D'), is the range of the displacement along the first axis in each coarse plane.
    """
    # A voxel with a NaN may move anywhere. If it is tissue, `moved_sites` raises an error later.
    lowest = np.nan_to_num(ends.min(axis=0), nan=-np.inf)
    highest = np.nan_to_num(ends.max(axis=0), nan=np.inf)
    planes, last = np.arange(depth), len(lowest) - 1
    before = np.minimum(planes // every, last)
    after = np.minimum(before + 1, last)
    # Voxels outside tissue stay in place, so the range of the steps includes 0.
    low = planes + np.minimum(np.minimum(lowest[before], lowest[after]), 0)
    high = planes + np.maximum(np.maximum(highest[before], highest[after]), 0)
    # A cell between two planes is drawn even if the planes have moved far apart.
    begins, ends_at = np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])
    near = np.flatnonzero((begins <= number + _REACH) & (ends_at >= number - _REACH))
    if not len(near):
        return number, number + 1
    # Include one more plane on each side; otherwise inner sites would be drawn as outermost sites.
    return max(int(near[0]) - 1, 0), min(int(near[-1]) + 3, depth)


def _on_voxels(
    displacement: FloatArray, tissue: BoolArray, every: Sequence[int], planes: slice
) -> FloatArray:
    """Interpolate a coarse displacement linearly, within tissue, to all voxels of some planes."""
    if tuple(every) == (1, 1, 1):
        return displacement[planes]
    sites = tissue[tuple(slice(None, None, step) for step in every)]
    weight = sites[..., np.newaxis].astype(np.float32)
    parts = [np.where(sites[..., np.newaxis], displacement, np.float32(0)), weight]
    places = [np.arange(*planes.indices(len(tissue))), *map(np.arange, tissue.shape[1:])]
    for axis, (place, step) in enumerate(zip(places, every, strict=True)):
        last = sites.shape[axis] - 1
        before = np.minimum(place // step, last)
        after = np.minimum(before + 1, last)
        share = np.float32(place % step / step).reshape(-1, *(1,) * (3 - axis))
        parts = [
            (1 - share) * part.take(before, axis) + share * part.take(after, axis) for part in parts
        ]
    total, weight = parts
    mean = np.zeros_like(total)
    np.divide(total, weight, out=mean, where=weight > 0)
    return mean
