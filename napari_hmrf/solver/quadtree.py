"""The quadtree: which sites exist on which scale level, and where their values come from.

Level 0 is the image; a site of level n covers 2^n x 2^n pixels of it, fewer at the far borders. The
coarsest level R is a single site (the paper's root r). Of a volume it is an octree, whose sites
cover 2^n x 2^n x 2^n voxels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int_]
_Type = TypeVar("_Type", bound=np.generic)


@dataclass(frozen=True)
class Level:
    """One scale level: its number n and its grid, ``ceil(size / 2**n)`` along each axis."""

    number: int
    shape: tuple[int, ...]

    @property
    def sites(self) -> int:
        """How many sites the level has."""
        total = 1
        for size in self.shape:
            total *= size
        return total


def levels(shape: tuple[int, ...]) -> tuple[Level, ...]:
    """All levels of a grid, finest (0) first, down to the single site of level R.

    Parameters
    ----------
    shape : tuple of int
        The grid of the image or volume, such as (H, W).

    Returns
    -------
    tuple of Level
        R + 1 of them, R = ceil(log2(largest size)): ten for 300 x 300.
    """
    coarsest = max(0, (max(shape) - 1).bit_length())
    return tuple(Level(n, tuple(-(-size // 2**n) for size in shape)) for n in range(coarsest + 1))


def nearest_pixels(level: Level, shape: tuple[int, ...]) -> tuple[IntArray, ...]:
    """For each axis, the pixel of level 0 that lies nearest to the centre of each site of a level.

    The centre of site i of level n is at pixel coordinate (i + 1/2) 2^n - 1/2, half-way between two
    pixels for n > 0; the later of the two is taken, as nearest-neighbour texture sampling does, and
    the last pixel where a site reaches beyond the image.
    """
    half = (1 << level.number) >> 1
    return tuple(
        np.minimum((np.arange(sites) << level.number) + half, size - 1)
        for sites, size in zip(level.shape, shape, strict=True)
    )


def sampled(values: npt.NDArray[_Type], level: Level) -> npt.NDArray[_Type]:
    """The values of an image or volume at the pixels nearest to a level's sites."""
    for axis, pixels in enumerate(nearest_pixels(level, values.shape)):
        values = values.take(pixels, axis=axis)
    return values
