"""Direct factors of a linear model, for materials on which cycles cannot be trusted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import psutil

from napari_hmrf.solver.backends.direct.brick_factors import BrickFactors
from napari_hmrf.solver.backends.direct.dissection import Dissection, Elements, Progress
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes

# Largest part of the available memory that factors may use.
_FREE = 0.7
# Largest number of voxels, whose factors take some seconds; and memory in bytes per voxel^(4/3).
_MOST_VOXELS = 14_000
_VOLUME_BYTES = 3000.0


class Part(NamedTuple):
    """Components of displacement that are coupled, and the elements that couple them."""

    components: tuple[int, ...]
    elements: Elements


class Assembled(Protocol):
    """Material that provides the matrices of its elements."""

    @property
    def patch(self) -> int:
        """Number of sites along a side of an element."""
        ...

    @property
    def margin(self) -> int:
        """Reach of elements beyond the image, in sites: 0, 1 or 2."""
        ...

    @property
    def symmetric(self) -> bool:
        """True if the matrix is symmetric."""
        ...

    @property
    def parts(self) -> Sequence[Part]:
        """Independent parts of the system."""
        ...


class Factors:
    """Direct factors of the matrix of a linear model.

    Parameters
    ----------
    material : Assembled
    moves : ndarray of bool, planes
        Mask of the unknown components.
    progress : callable
        Called with the completed fraction of the work; may raise to stop it.
    springs : ndarray, planes, optional
        Values added to the diagonal.

    Raises
    ------
    Singular
        If the matrix is singular in double precision.
    """

    def __init__(
        self,
        material: Assembled,
        moves: HeldPlanes,
        progress: Progress,
        springs: Planes | None = None,
    ) -> None:
        ring = 2 - material.margin
        self._inside = (slice(None), *(slice(ring, size - ring) for size in moves.shape[1:]))
        inside = np.moveaxis(moves[self._inside], 0, -1)
        self._parts: list[tuple[tuple[int, ...], Dissection | BrickFactors]] = []
        parts = material.parts
        for number, (components, elements) in enumerate(parts):

            def report(part: float, number: int = number) -> None:
                progress((number + part) / len(parts))

            at = list(components)
            some = np.ascontiguousarray(inside[..., at])
            more = None if springs is None else np.moveaxis(springs[self._inside], 0, -1)[..., at]
            if some.ndim == 4:
                self._parts.append((components, BrickFactors(elements, some, report, more)))
                continue
            dissection = Dissection(
                elements, material.patch, some, material.symmetric, report, more
            )
            self._parts.append((components, dissection))

    def solve(self, load: npt.NDArray[np.floating]) -> Planes:
        """Return the displacement for a load, both as planes; fixed components are 0."""
        found: Planes = np.zeros(load.shape)
        inside = np.moveaxis(load[self._inside], 0, -1).astype(np.float64)
        for components, dissection in self._parts:
            at = list(components)
            found[self._inside][at] = np.moveaxis(dissection.solve(inside[..., at]), -1, 0)
        return found

    @staticmethod
    def required_memory(shape: tuple[int, ...]) -> float:
        """Estimate the memory of the factors of a grid (H, W) or (D, H, W), in bytes."""
        sites = float(math.prod(shape))
        if len(shape) == 3:
            return float(_VOLUME_BYTES * sites ** (4 / 3))
        return 8 * 4 * sites * (10 + 10 * math.log2(max(max(shape) / 16, 1)))

    @staticmethod
    def fit(shape: tuple[int, ...]) -> bool:
        """Return whether the factors of a grid fit into memory, and are fast enough in a volume."""
        small = len(shape) == 2 or math.prod(shape) <= _MOST_VOXELS
        return small and bool(
            Factors.required_memory(shape) < _FREE * psutil.virtual_memory().available
        )
