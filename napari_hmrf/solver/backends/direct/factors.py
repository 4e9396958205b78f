"""Direct factorization of a linear model, for use if cycles are not reliable."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import psutil

from napari_hmrf.solver.backends.direct.dissection import Dissection, Elements, Progress
from napari_hmrf.solver.backends.direct.sparse_factors import Links, SparseFactors
from napari_hmrf.solver.backends.planes import HeldPlanes, Planes

# Largest fraction of the available memory that a factorization may use.
_FREE = 0.7
# Largest number of voxels of a volume that is factorized, which takes a few seconds.
_MOST_VOXELS = 14_000
# Largest number of sites of an unfolded image of sliding parts that is factorized.
_MOST_COUPLED = 200_000
# Memory of the factorization of a volume, in bytes per voxel^(4/3).
_VOLUME_BYTES = 3000.0


class Part(NamedTuple):
    """Coupled components of displacement, and the elements that couple them."""

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
    """Direct factorization of the matrix of a linear model.

    Parameters
    ----------
    material : Assembled
    moves : ndarray of bool, planes
        Mask of the free components.
    progress : callable
        Called with the completed fraction of the work; may raise an exception to cancel.
    springs : ndarray, planes, optional
        Values added to the diagonal.
    links : Links, optional
        Connections between sliding parts.

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
        links: Links | None = None,
    ) -> None:
        ring = 2 - material.margin
        self._inside = (slice(None), *(slice(ring, size - ring) for size in moves.shape[1:]))
        inside = np.moveaxis(moves[self._inside], 0, -1)
        self._parts: list[tuple[tuple[int, ...], Dissection | SparseFactors]] = []
        parts = material.parts
        for number, (components, elements) in enumerate(parts):

            def report(part: float, number: int = number) -> None:
                progress((number + part) / len(parts))

            at = list(components)
            some = np.ascontiguousarray(inside[..., at])
            more = None if springs is None else np.moveaxis(springs[self._inside], 0, -1)[..., at]
            if some.ndim == 4 or links is not None:
                sparse = SparseFactors(elements, some, report, more, links)
                self._parts.append((components, sparse))
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
        """Estimate the memory of a factorization on a grid (H, W) or (D, H, W), in bytes."""
        sites = float(math.prod(shape))
        if len(shape) == 3:
            return float(_VOLUME_BYTES * sites ** (4 / 3))
        return 8 * 4 * sites * (10 + 10 * math.log2(max(max(shape) / 16, 1)))

    @staticmethod
    def fit(shape: tuple[int, ...], coupled: bool = False) -> bool:
        """Return whether a factorization fits into memory and is fast enough.

        Parameters
        ----------
        shape : tuple of int
            Shape of the grid.
        coupled : bool
            True for the unfolded grid of sliding parts.
        """
        most = _MOST_COUPLED if coupled else math.inf
        small = math.prod(shape) <= (most if len(shape) == 2 else _MOST_VOXELS)
        return small and bool(
            Factors.required_memory(shape) < _FREE * psutil.virtual_memory().available
        )
