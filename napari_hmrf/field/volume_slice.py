"""One slice of a volume that has moved, without the rest: for as long as a hand drags.

The same as that slice of `inverse_map`: the sites that can reach it are looked for, and only their
planes are drawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.warp import BoolArray, Float64Array, inverse_raster, moved_sites

FloatArray = npt.NDArray[np.float32]

#: Tissue is drawn no farther than this from its sites, in voxels; half of one is true.
_REACH = 1.0


class SliceOrigins(NamedTuple):
    """Where that which is seen on a slice came from.

    Attributes
    ----------
    source : ndarray, shape (H, W, 3), float64
        In voxels; 0 where not covered.
    covered : ndarray of bool, shape (H, W)
        Whether anything is seen: tissue that has come, or what never moves.
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
    """Find where that which is seen on a slice after the motion came from.

    Parameters
    ----------
    displacement : ndarray, shape (D', H', W', 3)
        Material, in the unit of `spacing`: of every so many-th voxel, linear between these.
    number : int
        Of the slice along the first axis.
    spacing : sequence of float, shape (3,)
        Size of a voxel along each axis.
    tissue : ndarray of bool, shape (D, H, W)
        What moves.
    every : sequence of int, shape (3,)
        The first voxel has a vector, and every so many-th along each axis after it.
    fraction : float
        How much of the displacement.

    Raises
    ------
    ProblemError
        If the displacement is NaN or infinite somewhere in tissue that may reach the slice.
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
    """From which plane to before which sites are needed; `ends` of the steps of each, (2, D')."""
    # A step that is no number may lead anywhere; whether it is one of tissue is seen later.
    lowest = np.nan_to_num(ends.min(axis=0), nan=-np.inf)
    highest = np.nan_to_num(ends.max(axis=0), nan=np.inf)
    planes, last = np.arange(depth), len(lowest) - 1
    before = np.minimum(planes // every, last)
    after = np.minimum(before + 1, last)
    # Voxels beside tissue stay, and say nothing of how far those between sites go.
    low = planes + np.minimum(np.minimum(lowest[before], lowest[after]), 0)
    high = planes + np.maximum(np.maximum(highest[before], highest[after]), 0)
    # What lies between two planes is drawn even where these are far apart.
    begins, ends_at = np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])
    near = np.flatnonzero((begins <= number + _REACH) & (ends_at >= number - _REACH))
    if not len(near):
        return number, number + 1
    # With a neighbour on either side, by which sites know that they are no outermost ones.
    return max(int(near[0]) - 1, 0), min(int(near[-1]) + 3, depth)


def _on_voxels(
    displacement: FloatArray, tissue: BoolArray, every: Sequence[int], planes: slice
) -> FloatArray:
    """The displacement of all voxels of some planes, linear between the sites in tissue."""
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
    found, weight = parts
    filled = np.zeros_like(found)
    np.divide(found, weight, out=filled, where=weight > 0)
    return filled
