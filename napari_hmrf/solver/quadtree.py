"""Quadtree of scale levels: the sites of each level, and the pixels that they sample.

Level 0 is the image. A site of level n covers 2^n x 2^n pixels, or fewer at the far borders. The
coarsest level R is a single site (the root r in the paper). For a volume the tree is an octree, in
which a site covers 2^n x 2^n x 2^n voxels.
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
    """Scale level: its number n and its grid, with ``ceil(size / 2**n)`` sites along each axis."""

    number: int
    shape: tuple[int, ...]

    @property
    def sites(self) -> int:
        """Number of sites of the level."""
        total = 1
        for size in self.shape:
            total *= size
        return total


def levels(shape: tuple[int, ...]) -> tuple[Level, ...]:
    """Return all levels of a grid, from the finest (0) to the single site of level R.

    Parameters
    ----------
    shape : tuple of int
        Shape of the image or volume, such as (H, W).

    Returns
    -------
    tuple of Level
        R + 1 levels, R = ceil(log2(largest size)): ten levels for 300 x 300.
    """
    coarsest = max(0, (max(shape) - 1).bit_length())
    return tuple(Level(n, tuple(-(-size // 2**n) for size in shape)) for n in range(coarsest + 1))


def nearest_pixels(level: Level, shape: tuple[int, ...]) -> tuple[IntArray, ...]:
    """Return, for each axis, the pixel of level 0 nearest to the centre of each site of a level.

    The centre of site i of level n is at pixel coordinate (i + 1/2) 2^n - 1/2, half-way between two
    pixels for n > 0. Of these two, the pixel with the larger index is used, as in nearest-neighbour
    texture sampling. If a centre lies beyond the last pixel of the axis, the last pixel is used.

    Parameters
    ----------
    level : Level
    shape : tuple of int
        Shape of the image or volume.
    """
    half = (1 << level.number) >> 1
    return tuple(
        np.minimum((np.arange(sites) << level.number) + half, size - 1)
        for sites, size in zip(level.shape, shape, strict=True)
    )


def sampled(values: npt.NDArray[_Type], level: Level) -> npt.NDArray[_Type]:
    """Return the values of an image or volume at the pixels nearest to the sites of a level."""
    for axis, pixels in enumerate(nearest_pixels(level, values.shape)):
        values = values.take(pixels, axis=axis)
    return values
