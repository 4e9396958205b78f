"""Direct solver on a small grid, in double precision: SuperLU on the assembled sparse matrix.

In a grid of voxels, a plane of sites in the middle of a box separates two halves that are not
directly coupled. Therefore the plane is eliminated last (nested dissection: George, SIAM J. Numer.
Anal. 10, 1973). On n x n x n sites, this takes about n^6 operations and n^4 memory, so it suits
small volumes only.

Sites of parts that slide along each other are coupled although they are not neighbours in the grid.
They are neighbours in the image, which determines the order of elimination instead.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.backends.direct.dissection import HELD, Singular

Float64Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

# Number of sites along the longest axis up to which a box is not divided.
_SMALLEST = 3
# Number of pieces of the grid that are assembled one after the other.
_PIECES = 20
# SuperLU objects that were released on another thread; the next factorization frees them.
_dropped: deque[Any] = deque()


class SymmetricFactors:
    """Factorization of a symmetric matrix without pivoting, by SuperLU.

    Parameters
    ----------
    matrix : sparse array
    order : str
        Order of elimination, as for `scipy.sparse.linalg.splu`.

    Raises
    ------
    Singular
        If a pivot is 0.
    """

    # SciPy keeps a table of allocations for each thread. If another thread frees the SuperLU
    # object, as the garbage collector may do, its memory is leaked.

    def __init__(self, matrix: scipy.sparse.sparray, order: str = "NATURAL") -> None:
        _dropped.clear()
        self._thread = threading.get_ident()
        self._factors: Any = None
        try:
            self._factors = scipy.sparse.linalg.splu(
                scipy.sparse.csc_array(matrix),
                order,
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:
            raise Singular from None

    def solve(self, load: Float64Array) -> Float64Array:
        """Return the solution for a load."""
        return np.asarray(self._factors.solve(load))

    def pivots(self) -> Float64Array:
        """Return the pivot of each row; all are positive if the matrix is positive definite."""
        # SuperLU has reordered the columns.
        return np.asarray(self._factors.U.diagonal()[self._factors.perm_c])

    def __del__(self) -> None:
        if threading.get_ident() != self._thread:
            _dropped.append(self._factors)


class Links(NamedTuple):
    """Connections of sites that are not neighbours in a grid.

    Attributes
    ----------
    matrix : sparse array
        Matrix of the connections, with a row for each component of the grid, flattened.
    image : tuple of int
        Shape of an image in which connected sites are at the same place.
    places : ndarray of int
        Index of each site of the grid in the flattened image.
    """

    matrix: scipy.sparse.csr_array
    image: tuple[int, ...]
    places: Index


class SparseFactors:
    """Factorization of a matrix on a grid, by SuperLU.

    Parameters
    ----------
    elements : callable
        Function that returns the matrices of the elements in a range along each axis, shape
        (d, h, w, n, n) with n = 8 C, or (h, w, n, n) with n = 4 C.
    moves : ndarray of bool, shape (H, W, C) or (D, H, W, C)
        Mask of the free components. The solution is 0 at the other components.
    progress : callable
        Called with the completed fraction of the work.
    springs : ndarray of the same shape, optional
        Values added to the diagonal.
    links : Links, optional
        Connections of sites that are not neighbours in the grid.

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
        links: Links | None = None,
    ) -> None:
        grid = moves.shape[:-1]
        by_site = np.arange(moves.size).reshape(-1, moves.shape[-1])
        sites = elimination_order(grid if links is None else links.image)
        if links is not None:
            rank = np.argsort(sites)
            sites = np.argsort(rank[links.places], kind="stable")
        order = by_site[sites].ravel()
        self._moving = order[moves.ravel()[order]]
        self._shape = moves.shape
        if not len(self._moving):
            return
        matrix = self._assembled(elements, grid)
        if links is not None:
            matrix = matrix + links.matrix[self._moving][:, self._moving]
        diagonal = matrix.diagonal()
        if springs is not None:
            matrix = matrix + scipy.sparse.diags_array(springs.ravel()[self._moving])
        progress(0.1)
        self._factors = SymmetricFactors(matrix)
        least = np.zeros(len(diagonal)) if springs is not None else HELD * diagonal
        if not (self._factors.pivots() > least).all():
            raise Singular
        progress(1.0)

    def _assembled(
        self, elements: Callable[..., Float64Array], grid: tuple[int, ...]
    ) -> scipy.sparse.csr_array:
        """Return the matrix of the free components, in the order of elimination."""
        size, fields, axes = len(self._moving), self._shape[-1], len(grid)
        place = np.full(int(np.prod(self._shape)), -1)
        place[self._moving] = np.arange(size)
        numbers = place.reshape(self._shape)
        total = scipy.sparse.csr_array((size, size))
        # A few planes at a time, because the matrices of all elements would need much memory.
        step = max(1, grid[0] // _PIECES)
        for first in range(0, grid[0] - 1, step):
            end = min(first + step, grid[0] - 1)
            ranges = slice(first, end), *(slice(0, along - 1) for along in grid[1:])
            matrices = elements(*ranges)
            corners = np.lib.stride_tricks.sliding_window_view(
                numbers[first : end + 1], (2,) * axes, axis=tuple(range(axes))
            )
            at = np.moveaxis(corners, axes, -1).reshape(-1, 2**axes * fields)
            matrices = matrices.reshape(-1, *matrices.shape[-2:])
            there = (at >= 0)[:, :, None] & (at >= 0)[:, None] & (matrices != 0)
            rows, cols = np.broadcast_arrays(at[:, :, None], at[:, None])
            entries = matrices[there], (rows[there], cols[there])
            total = total + scipy.sparse.coo_array(entries, shape=(size, size)).tocsr()
        return total

    def solve(self, load: Float64Array) -> Float64Array:
        """Return the displacement, (H, W, C) or (D, H, W, C), for a load of the same shape."""
        d = np.zeros(load.size)
        if len(self._moving):
            d[self._moving] = self._factors.solve(load.ravel()[self._moving])
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
