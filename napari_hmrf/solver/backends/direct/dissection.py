"""Direct solver on the pixel grid, in double precision: nested dissection of its elements.

The matrix of an *element* couples a block of `patch` x `patch` sites. For elastic tissue `patch` is
2; for the paper's cliques it is 3, and the block is centred on the middle site of the cliques. A
*box* of elements is condensed onto its *ring*, the sites that it shares with other boxes. With the
interior sites first and the ring second, the matrix F of a box is replaced by its Schur complement
S:

    F = [[A, B], [C, D]],   S = D - C A^-1 B.

The matrices S of two neighbouring boxes add up to the matrix F of their union (nested dissection:
George, SIAM J. Numer. Anal. 10, 1973). Boxes within tiles of 16 x 16 elements have few different
shapes, so many boxes are condensed at once; their fixed components have 1 on the diagonal.
Larger boxes contain only free components. On n x n sites, the work is about n^3 and the memory
about n^2 log n, independent of the materials.
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy
from threadpoolctl import ThreadpoolController

from napari_hmrf.solver.backends.direct import tiles as shapes
from napari_hmrf.solver.backends.direct.condensation import Step, SymmetricStep
from napari_hmrf.solver.backends.direct.tiles import LEAF, TILE

Float64Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]

#: Function of a range of rows and a range of columns that returns the matrices of the elements
#: there, shape (h, w, n, n) with n = patch^2 C.
Elements = Callable[[slice, slice], Float64Array]
#: Callback, on any thread, with the completed fraction of the work; may raise an exception to
#: cancel.
Progress = Callable[[float], None]

# Number of tiles condensed at once, chosen so that their matrices fit into the processor's cache.
_AT_ONCE = 16
_THREADS = os.cpu_count() or 1
#: Smallest pivot of a component, relative to its diagonal entry, in a nonsingular system.
HELD = 1e-13


class Singular(ArithmeticError):
    """Error for a matrix that is singular in double precision: some tissue has a free motion."""


_Steps = list[Step | SymmetricStep]
#: Range of tiles: first row, end row, first column, end column; the ends are exclusive.
_Range = tuple[int, int, int, int]


class _Share(NamedTuple):
    """Condensed box: the numbers of the ring components, and the matrix S."""

    ring: Index
    matrix: Float64Array


class Dissection:
    """Factorization of a matrix on a pixel grid, by nested dissection.

    Parameters
    ----------
    elements : callable
        Function that returns the matrices of the elements; see `Elements`.
    patch : int
        Number of sites along a side of an element.
    moves : ndarray of bool, shape (H, W, C)
        Mask of the free components, each of which must belong to an element. The solution is 0 at
        the other components.
    symmetric : bool
        True if the matrix is symmetric positive definite.
    progress : callable
        Called with the completed fraction of the work.
    springs : ndarray, shape (H, W, C), optional
        Values added to the diagonal.

    Raises
    ------
    Singular
        If the matrix is singular in double precision.
    """

    def __init__(
        self,
        elements: Elements,
        patch: int,
        moves: Mask,
        symmetric: bool,
        progress: Progress = lambda part: None,
        springs: Float64Array | None = None,
    ) -> None:
        self._elements, self._patch = elements, patch
        self._moves, self._symmetric = moves, symmetric
        self._span = tuple(size - patch + 1 for size in moves.shape[:2])
        self._tiles = tuple(-(-size // TILE) for size in self._span)
        self._progress, self._done, self._work = progress, 0.0, work(moves.shape)
        self._number_components()
        # Diagonal of the matrix: sum over the elements that have been assembled so far.
        self._diagonal, self._lock = np.zeros(moves.size + 1), threading.Lock()
        self._springs = np.zeros(moves.size + 1)
        self._least = HELD if springs is None else 0.0
        if springs is not None:
            self._springs[:-1] = springs.ravel()
        # Each thread makes its own calls to BLAS. More threads within a call do not speed up small
        # matrices and would be very slow if other programs use the cores.
        with _one_thread(), ThreadPoolExecutor(_THREADS) as pool:
            self._steps, rest = self._condense((0, self._tiles[0], 0, self._tiles[1]), pool)
        if len(rest.ring):
            self._steps.append(self._eliminate(rest.matrix, rest.ring, len(rest.ring))[0])
        del self._elements, self._diagonal, self._springs, self._lock

    def solve(self, load: Float64Array) -> Float64Array:
        """Return the displacement, shape (H, W, C), for a load of the same shape."""
        rest, d = np.zeros((2, self._moves.size + 1))
        rest[:-1] = np.where(self._moves, load, 0.0).ravel()
        with _one_thread():
            for step in self._steps:
                step.forward(rest)
            for step in reversed(self._steps):
                step.back(rest, d)
        return d[:-1].reshape(self._moves.shape)

    @property
    def memory(self) -> int:
        """Memory of the factorization, in bytes."""
        return sum(part.nbytes for step in self._steps for part in step if part is not None)

    def _number_components(self) -> None:
        """Assign numbers to the components of each tile; fixed components share the last number."""
        side = TILE + self._patch - 1
        height, width, fields = self._moves.shape
        size = [TILE * count + self._patch - 1 for count in self._tiles]
        numbers = np.full((*size, fields), self._moves.size)
        every = np.arange(self._moves.size).reshape(self._moves.shape)
        numbers[:height, :width] = np.where(self._moves, every, self._moves.size)
        windows = np.lib.stride_tricks.sliding_window_view(numbers, (side, side), axis=(0, 1))
        #: Numbers of the components, shape (tile rows, tile columns, side, side, C).
        self._numbers = np.moveaxis(windows[::TILE, ::TILE], 2, -1)

    def _condense(
        self,
        tiles: _Range,
        pool: ThreadPoolExecutor,
        threads: int = _THREADS,
        shares: dict[tuple[int, int], _Share] | None = None,
    ) -> tuple[_Steps, _Share]:
        """Condense a box of tiles; `shares` contains the tiles that are already condensed."""
        top, bottom, left, right = tiles
        high, wide = bottom - top, right - left
        steps: _Steps = []
        if shares is None and high * wide <= _AT_ONCE:
            steps, shares = self._condense_tiles(tiles)
        if high == wide == 1:
            assert shares is not None
            return steps, shares.pop((top, left))
        if high >= wide:
            middle = (top + bottom) // 2
            one, two = (top, middle, left, right), (middle, bottom, left, right)
        else:
            middle = (left + right) // 2
            one, two = (top, bottom, left, middle), (top, bottom, middle, right)
        if threads > 1 and shares is None:
            other = pool.submit(self._condense, two, pool, threads // 2)
            found = [self._condense(one, pool, threads - threads // 2), other.result()]
        else:
            found = [self._condense(half, pool, 1, shares) for half in (one, two)]
        (first, share), (second, other_share) = found
        step, merged = self._merge(tiles, share, other_share)
        return [*steps, *first, *second, step], merged

    def _merge(
        self, tiles: _Range, one: _Share, two: _Share
    ) -> tuple[Step | SymmetricStep, _Share]:
        """Merge two neighbouring boxes and condense the merged box."""
        every = np.union1d(one.ring, two.ring)
        shared = self._shared(every, tiles)
        own = len(every) - int(shared.sum())
        place = np.where(shared, own + np.cumsum(shared), np.cumsum(~shared)) - 1
        front = np.zeros((len(every), len(every)))
        for share in (one, two):
            at = place[np.searchsorted(every, share.ring)]
            front[np.ix_(at, at)] += share.matrix
        order = np.concatenate([every[~shared], every[shared]])
        step, matrix = self._eliminate(front, order, own)
        self._report(float(own) * len(every) ** 2)
        return step, _Share(order[own:], matrix)

    def _shared(self, components: Index, tiles: _Range) -> Mask:
        """Return a mask of the components on sites shared with elements outside a box of tiles."""
        top, bottom, left, right = tiles
        row, col = np.divmod(components // self._moves.shape[2], self._moves.shape[1])
        over = self._patch - 1
        above, below = top > 0, bottom < self._tiles[0]
        before, after = left > 0, right < self._tiles[1]
        return np.asarray(
            (above & (row < TILE * top + over))
            | (below & (row >= TILE * bottom))
            | (before & (col < TILE * left + over))
            | (after & (col >= TILE * right))
        )

    def _condense_tiles(self, tiles: _Range) -> tuple[_Steps, dict[tuple[int, int], _Share]]:
        """Condense each tile of a range of tiles."""
        top, bottom, left, right = tiles
        fields = self._moves.shape[2]
        numbers = self._numbers[top:bottom, left:right].reshape(-1, *self._numbers.shape[2:])
        boxes, at = self._leaves(tiles, numbers)
        steps: _Steps = []
        own = shapes.components(shapes.own(LEAF, LEAF, self._patch), fields).size
        for merge in (None, *shapes.merges(self._patch, fields)):
            if merge is not None:
                boxes, at, own = shapes.merged(boxes, at, merge)
            step, boxes = self._eliminate(boxes, at, own)
            steps.append(step)
            at = at[..., own:]
        self._report(_TILE_WORK * fields**3 * len(numbers))
        shares = {}
        for number, (ring, matrix) in enumerate(zip(at[:, 0, 0], boxes[:, 0, 0], strict=True)):
            row, col = divmod(number, right - left)
            here = np.flatnonzero(ring < self._moves.size)
            here = here[np.argsort(ring[here])]
            shares[top + row, left + col] = _Share(ring[here], matrix[np.ix_(here, here)])
        return steps, shares

    def _leaves(self, tiles: _Range, numbers: Index) -> tuple[Float64Array, Index]:
        """Assemble the smallest boxes: matrices (tiles, 4, 4, n, n), and component numbers."""
        top, bottom, left, right = tiles
        patch, fields = self._patch, self._moves.shape[2]
        rows = slice(TILE * top, min(TILE * bottom, self._span[0]))
        cols = slice(TILE * left, min(TILE * right, self._span[1]))
        some = self._elements(rows, cols)
        size = some.shape[-1]
        every = np.zeros((TILE * (bottom - top), TILE * (right - left), size, size))
        every[: some.shape[0], : some.shape[1]] = some
        count, side = TILE // LEAF, LEAF + patch - 1
        split = (bottom - top, count, LEAF, right - left, count, LEAF, size, size)
        # Axes: tile row, tile column, box row, box column, element row, element column, n, n.
        elements = every.reshape(split).transpose(0, 3, 1, 4, 2, 5, 6, 7)
        order = shapes.components(
            np.concatenate([part(LEAF, LEAF, patch) for part in (shapes.own, shapes.ring)]), fields
        )
        place = np.argsort(order)
        grid = np.arange(len(order)).reshape(side, side, fields)
        leaves = np.zeros((*elements.shape[:4], len(order), len(order)))
        for i in range(LEAF):
            for j in range(LEAF):
                at = place[grid[i : i + patch, j : j + patch].ravel()]
                leaves[..., at[:, None], at] += elements[:, :, :, :, i, j]
        leaves = leaves.reshape(-1, *leaves.shape[2:])
        windows = np.lib.stride_tricks.sliding_window_view(numbers, (side, side), axis=(1, 2))
        each = np.moveaxis(windows[:, ::LEAF, ::LEAF], 3, -1)
        at = each.reshape(*leaves.shape[:-1])[..., order]
        moves = at < self._moves.size
        leaves *= moves[..., None] & moves[..., None, :]
        diagonal = np.arange(len(order))
        leaves[..., diagonal, diagonal] += ~moves
        with self._lock:
            np.add.at(self._diagonal, at, leaves[..., diagonal, diagonal])
        return leaves, at

    def _eliminate(
        self, front: Float64Array, at: Index, own: int
    ) -> tuple[Step | SymmetricStep, Float64Array]:
        """Condense matrices (..., own + ring, own + ring) of the components with numbers `at`."""
        a, b = front[..., :own, :own], front[..., :own, own:]
        c, d = front[..., own:, :own], front[..., own:, own:]
        places = at[..., :own], at[..., own:]
        diagonal = np.arange(own)
        a[..., diagonal, diagonal] += self._springs[places[0]]
        if self._symmetric:
            step = self._factorise(a, b, places)
            return step, d - step.right.swapaxes(-1, -2) @ step.right
        try:
            inverse = np.asarray(np.linalg.inv(a), np.float64)
        except np.linalg.LinAlgError:
            raise Singular from None
        self._check(1 / inverse.diagonal(axis1=-2, axis2=-1), places[0])
        right, left = inverse @ b, c @ inverse
        return Step(*places, inverse, right, left), np.asarray(d - c @ right, np.float64)

    def _factorise(
        self, a: Float64Array, b: Float64Array, places: tuple[Index, Index]
    ) -> SymmetricStep:
        """Condense symmetric matrices by Cholesky factorization, more accurately than by A^-1."""
        pivots = a.diagonal(axis1=-2, axis2=-1)
        if not (pivots > 0).all():
            raise Singular
        if a.ndim == 2:
            factor, wrong = scipy.linalg.lapack.dpotrf(a)
            if wrong:
                raise Singular
            self._check(factor.diagonal() ** 2, places[0])
            above = scipy.linalg.blas.dtrsm(1.0, factor, b, trans_a=1)
            return SymmetricStep(*places, factor, above)
        scale = np.sqrt(pivots)
        try:
            factor = np.linalg.cholesky(a / (scale[..., :, None] * scale[..., None, :]))
        except np.linalg.LinAlgError:
            raise Singular from None
        self._check(factor.diagonal(axis1=-2, axis2=-1) ** 2 * pivots, places[0])
        inverse = np.linalg.inv(factor) / scale[..., None, :]
        return SymmetricStep(*places, inverse.swapaxes(-1, -2), inverse @ b)

    def _check(self, pivots: Float64Array, own: Index) -> None:
        """Raise `Singular` if a pivot is too small; with springs, any positive pivot is valid."""
        if not (pivots > self._least * self._diagonal[own]).all():
            raise Singular

    def _report(self, amount: float) -> None:
        self._done += amount
        self._progress(min(self._done / self._work, 1.0))


def work(shape: tuple[int, ...]) -> float:
    """Estimate the number of multiplications for the dissection of a grid (H, W, C)."""
    height, width, fields = shape
    sites = height * width
    boxes, tiles = 16.0 * sites * math.sqrt(sites), _TILE_WORK * sites / TILE**2
    return fields**3 * (boxes + tiles)


# Number of multiplications for a tile with one component per site.
_TILE_WORK = 3.0e5


@lru_cache(maxsize=1)
def _pools() -> ThreadpoolController:
    """Return the controller of the thread pools that NumPy and SciPy use."""
    return ThreadpoolController()


def _one_thread() -> Any:
    """Return a context manager in which each call to BLAS uses one thread."""
    return _pools().limit(limits=1, user_api="blas")
