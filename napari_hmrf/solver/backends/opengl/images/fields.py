"""Fields as textures: their layout, and a pool of textures.

In a field of two components, each texel stores a pair of neighbouring sites. In other fields, each
texel stores one site (``common.glsl``). A row with an odd number of sites is padded with a void
site. A texture contains the same bytes as the padded array.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.base import FloatArray
from napari_hmrf.solver.backends.opengl.programs.regions import Tissue


@dataclass(eq=False)
class GLField:
    """Field of float32 values on the sites of a level, in a texture.

    Attributes
    ----------
    shape : (int, int)
        Grid of the level, (H, W).
    components : int
        Number of components, C.
    texture : moderngl.Texture
        RGBA texture of `grid` texels.
    ratios : list of moderngl.Texture
        Stiffness ratios of each site's cliques, computed on first use; only for stiffness fields.
    tissue : Tissue or None
        Region that contains tissue, computed on first use; only for stiffness fields.
    """

    shape: tuple[int, ...]
    components: int
    texture: Any
    ratios: list[Any] = field(default_factory=list)
    tissue: Tissue | None = None

    @property
    def grid(self) -> tuple[int, int]:
        """Grid of texels, (rows, cols)."""
        return pairs(self.shape) if self.components == 2 else singles(self.shape)


def pairs(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the grid (rows, cols) of the pairs of (H, W) sites."""
    rows, cols = shape
    return rows, -(-cols // 2)


def singles(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the grid (rows, cols) of (H, W) sites, padded to an even number of columns."""
    rows, cols = pairs(shape)
    return rows, 2 * cols


def as_stored(values: FloatArray) -> FloatArray:
    """Convert an array of shape (H, W, C) to texture layout."""
    lacking = values.shape[1] % 2
    return np.ascontiguousarray(np.pad(values, ((0, 0), (0, lacking), (0, 0))), "<f4")


def as_given(stored: FloatArray, shape: tuple[int, ...], components: int) -> FloatArray:
    """Convert values from texture layout to an array of shape (H, W, C)."""
    return stored.reshape(*singles(shape), components)[:, : shape[1]]


def pairs_with_tissue(stored: FloatArray) -> npt.NDArray[np.bool_]:
    """Return the mask of pairs that contain tissue, given the stiffness in texture layout."""
    tissue: npt.NDArray[np.bool_] = stored.reshape(*stored.shape[:2], 2, 2)[..., 0] > 0
    return tissue[..., 0] | tissue[..., 1]


class Pool:
    """Pool of reusable textures of one backend.

    Parameters
    ----------
    make : callable
        Function that allocates a texture, given its (rows, cols) and its number of components.
    """

    def __init__(self, make: Callable[[tuple[int, ...], int], Any]) -> None:
        self._make = make
        self._spare: dict[tuple[tuple[int, ...], int, str], list[Any]] = {}
        self.all: list[Any] = []

    def acquire(self, grid: tuple[int, ...], components: int, use: str = "pairs") -> Any:
        """Return a texture from the pool; textures for the use ``pairs`` are 0 outside tissue.

        Kernels that skip void rely on these zeros. Therefore, a texture with nonzero values outside
        tissue must not be returned to the pool for the use ``pairs``.
        """
        spare = self._spare.get((grid, components, use))
        if spare:
            return spare.pop()
        made = self._make(grid, components)
        self.all.append(made)
        if use == "pairs":
            _blank(made, grid, components)
        return made

    def recycle(
        self, grid: tuple[int, ...], components: int, texture: Any, use: str = "pairs"
    ) -> None:
        """Return a texture to the pool for later requests with the same size and use."""
        self._spare.setdefault((grid, components, use), []).append(texture)

    def blank(self, grid: tuple[int, ...]) -> None:
        """Fill all free textures with this grid and the use ``pairs`` with zeros."""
        for (size, components, use), waiting in self._spare.items():
            if size == grid and use == "pairs":
                for texture in waiting:
                    _blank(texture, grid, components)


def _blank(texture: Any, grid: tuple[int, ...], components: int) -> None:
    texture.write(np.zeros((*grid, components), np.float32))
