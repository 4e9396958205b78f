"""Direct solver on a small grid of voxels, in double precision: SuperLU with nested dissection.

A plane of sites in the middle of a box separates two halves that are not directly coupled.
Therefore the plane is eliminated last (nested dissection: George, SIAM J. Numer. Anal. 10, 1973).
On n x n x n sites, this takes about n^6 operations and n^4 memory, so it suits small volumes only.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.backends.direct.dissection import HELD, Singular

Float64Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

# Number of sites along the longest axis up to which a box is not divided.
_SMALLEST = 3
# SuperLU objects that were released on another thread; the next factorization frees them.
_dropped: deque[Any] = deque()


class _ThreadBound:
    """Wrapper for a SuperLU object, so that the object is freed on the thread that created it."""

    # SciPy keeps a table of allocations for each thread. If another thread frees the object, as the
    # garbage collector may do, its memory is leaked.

    def __init__(self, factors: Any) -> None:
        self.factors, self._thread = factors, threading.get_ident()

    def __del__(self) -> None:
        if threading.get_ident() != self._thread:
            _dropped.append(self.factors)


class BrickFactors:
    """Factorization of a matrix on a voxel grid, by SuperLU.

    Parameters
    ----------
    elements : callable
        Function that returns the matrices of the elements in a range along each axis, shape
        (d, h, w, n, n) with n = 8 C.
    moves : ndarray of bool, shape (D, H, W, C)
        Mask of the free components. The solution is 0 at the other components.
    progress : callable
        Called with the completed fraction of the work.
    springs : ndarray, shape (D, H, W, C), optional
        Values added to the diagonal.

    Raises
    ------
    Singular
        If the matrix is singular in double precision.
    """

    def __init__(
        self,
        elements: Callable[..., Float64Array],
        moves: npt.NDArray[np.bool_],
        progress: Callable[[float], None],
        springs: Float64Array | None = None,
    ) -> None:
        _dropped.clear()
        grid = moves.shape[:-1]
        by_site = np.arange(moves.size).reshape(-1, moves.shape[-1])
        order = by_site[elimination_order(grid)].ravel()
        self._moving = order[moves.ravel()[order]]
        self._shape = moves.shape
        if not len(self._moving):
            return
        matrix = self._assembled(elements, grid)
        diagonal = matrix.diagonal()
        if springs is not None:
            matrix = matrix + scipy.sparse.diags_array(springs.ravel()[self._moving])
        progress(0.1)
        try:
            factors = scipy.sparse.linalg.splu(
                matrix.tocsc(), "NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError:
            raise Singular from None
        self._bound = _ThreadBound(factors)
        least = HELD * diagonal if springs is None else 0.0
        if not (factors.U.diagonal() > least).all():
            raise Singular
        progress(1.0)

    def _assembled(
        self, elements: Callable[..., Float64Array], grid: tuple[int, ...]
    ) -> scipy.sparse.csr_array:
        """Return the matrix of the free components, in the order of elimination."""
        size, fields = len(self._moving), self._shape[-1]
        place = np.full(int(np.prod(self._shape)), -1)
        place[self._moving] = np.arange(size)
        numbers = place.reshape(self._shape)
        total = scipy.sparse.csr_array((size, size))
        for plane in range(grid[0] - 1):
            ranges = slice(plane, plane + 1), *(slice(0, along - 1) for along in grid[1:])
            matrices = elements(*ranges)
            corners = np.lib.stride_tricks.sliding_window_view(
                numbers[plane : plane + 2], (2, 2, 2), axis=(0, 1, 2)
            )
            at = np.moveaxis(corners, 3, -1).reshape(-1, 8 * fields)
            matrices = matrices.reshape(-1, *matrices.shape[-2:])
            there = (at >= 0)[:, :, None] & (at >= 0)[:, None] & (matrices != 0)
            rows, cols = np.broadcast_arrays(at[:, :, None], at[:, None])
            entries = matrices[there], (rows[there], cols[there])
            total = total + scipy.sparse.coo_array(entries, shape=(size, size)).tocsr()
        return total

    def solve(self, load: Float64Array) -> Float64Array:
        """Return the displacement, shape (D, H, W, C), for a load of the same shape."""
        d = np.zeros(load.size)
        if len(self._moving):
            d[self._moving] = self._bound.factors.solve(load.ravel()[self._moving])
        return d.reshape(self._shape)


def elimination_order(grid: tuple[int, ...]) -> Index:
    """Return the indices of a grid's sites in the order of elimination, middle planes last."""

    def ordered(box: Index) -> list[Index]:
        axis = int(np.argmax(box.shape))
        if box.shape[axis] <= _SMALLEST:
            return [box.ravel()]
        middle = box.shape[axis] // 2
        before, plane, after = np.split(box, [middle, middle + 1], axis)
        return [*ordered(before), *ordered(after), *ordered(plane)]

    return np.concatenate(ordered(np.arange(int(np.prod(grid))).reshape(grid)))
