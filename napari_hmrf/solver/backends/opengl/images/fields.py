"""Fields as textures: how their values lie there, and where the textures come from.

A field of two components keeps a pair of neighbouring sites in each texel, others keep one site
(``common.glsl``). A row with an odd number of sites gets one more, of void. Either way the bytes of
the texture are those of the array with its rows so filled up.
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
    """Values on the (H, W) sites of a level, C components each, in a texture of float32.

    Attributes
    ----------
    shape : (int, int)
    components : int
    texture : moderngl.Texture
        RGBA, `grid` texels.
    ratios : list of moderngl.Texture
        Of stiffness: the ratios of each site's cliques, computed when first needed.
    tissue : Tissue or None
        Of stiffness: where there is tissue, found when first needed.
    """

    shape: tuple[int, ...]
    components: int
    texture: Any
    ratios: list[Any] = field(default_factory=list)
    tissue: Tissue | None = None

    @property
    def grid(self) -> tuple[int, int]:
        """The (rows, cols) of texels."""
        return pairs(self.shape) if self.components == 2 else singles(self.shape)


def pairs(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return how many (rows, cols) of pairs there are to (H, W) sites."""
    rows, cols = shape
    return rows, -(-cols // 2)


def singles(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the (rows, cols) of the sites that the pairs have."""
    rows, cols = pairs(shape)
    return rows, 2 * cols


def as_stored(values: FloatArray) -> FloatArray:
    """Return values of shape (H, W, C) as they lie in a texture."""
    lacking = values.shape[1] % 2
    return np.ascontiguousarray(np.pad(values, ((0, 0), (0, lacking), (0, 0))), "<f4")


def as_given(stored: FloatArray, shape: tuple[int, ...], components: int) -> FloatArray:
    """Return what a texture holds as values of shape (H, W, C)."""
    return stored.reshape(*singles(shape), components)[:, : shape[1]]


def pairs_with_tissue(stored: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which pairs have tissue, given what a texture of stiffness holds."""
    tissue: npt.NDArray[np.bool_] = stored.reshape(*stored.shape[:2], 2, 2)[..., 0] > 0
    return tissue[..., 0] | tissue[..., 1]


class Pool:
    """The textures of one backend: those in use, and those waiting to be used again.

    Parameters
    ----------
    make : callable
        Makes a texture of (rows, cols) texels and some components.
    """

    def __init__(self, make: Callable[[tuple[int, ...], int], Any]) -> None:
        self._make = make
        self._spare: dict[tuple[tuple[int, ...], int, str], list[Any]] = {}
        self.all: list[Any] = []

    def take(self, grid: tuple[int, ...], components: int, use: str = "pairs") -> Any:
        """Return a texture; of ``pairs`` it holds 0 where the level has no tissue.

        Kernels that run on tissue only rely on that, so that what holds anything else must not
        come back as pairs.
        """
        spare = self._spare.get((grid, components, use))
        if spare:
            return spare.pop()
        made = self._make(grid, components)
        self.all.append(made)
        if use == "pairs":
            _blank(made, grid, components)
        return made

    def give(
        self, grid: tuple[int, ...], components: int, texture: Any, use: str = "pairs"
    ) -> None:
        """Take a texture back for others of the same use."""
        self._spare.setdefault((grid, components, use), []).append(texture)

    def blank(self, grid: tuple[int, ...]) -> None:
        """Fill the waiting ``pairs`` of a level with 0."""
        for (size, components, use), waiting in self._spare.items():
            if size == grid and use == "pairs":
                for texture in waiting:
                    _blank(texture, grid, components)


def _blank(texture: Any, grid: tuple[int, ...], components: int) -> None:
    texture.write(np.zeros((*grid, components), np.float32))
