"""Double-double numbers, their sparse matrices, and the direct solution of such matrices.

For tissue with a contrast of 1e7, squared stiffness ratios leave no correct float64 digits for the
softest motions. Double-double numbers, pairs of float64 whose sum is the number, have about 32
digits, which leaves sixteen. A number is (high, low). The sums and products are those of Dekker
(1971) and Knuth.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
import scipy.sparse
from scipy.sparse import csgraph

_scalar = numba.njit(cache=True, error_model="numpy")
_loop = numba.njit(cache=True, nogil=True, error_model="numpy")

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]

_SPLIT = 134217729.0  # 2^27 + 1
#: Pivots below this fraction of their diagonal are examined for a zero-energy motion.
_SUSPECT = 1e-9
#: Relative energy below which a motion counts as zero-energy. Rounding errors are 1e-31, and the
#: relative energy of the weakest connected tissue is 1e-24.
FREE = 1e-28


@_scalar
def two_sum(a, b):
    """Return the exact sum of two float64 numbers."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


@_scalar
def two_product(a, b):
    """Return the exact product of two float64 numbers."""
    product = a * b
    wide = _SPLIT * a
    a_high = wide - (wide - a)
    a_low = a - a_high
    wide = _SPLIT * b
    b_high = wide - (wide - b)
    b_low = b - b_high
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


@_scalar
def add(a, b):
    """Return the sum of two numbers."""
    high, low = two_sum(a[0], b[0])
    low += a[1] + b[1]
    total = high + low
    return total, low - (total - high)


@_scalar
def multiply(a, b):
    """Return the product of two numbers."""
    high, low = two_product(a[0], b[0])
    low += a[0] * b[1] + a[1] * b[0]
    total = high + low
    return total, low - (total - high)


@_scalar
def negative(a):
    """Return the number with the opposite sign."""
    return -a[0], -a[1]


@_scalar
def divide(a, b):
    """Return the quotient of two numbers, by two corrections."""
    first = a[0] / b[0]
    rest = add(a, negative(multiply((first, 0.0), b)))
    second = rest[0] / b[0]
    rest = add(rest, negative(multiply((second, 0.0), b)))
    return add(two_sum(first, second), (rest[0] / b[0], 0.0))


def pairs(fractions: npt.NDArray[Any]) -> tuple[Array, Array]:
    """Convert fractions to double-double numbers."""
    high = fractions.astype(np.float64)
    to_fraction: Callable[..., Any] = np.frompyfunc(Fraction, 1, 1)
    return high, (fractions - to_fraction(high)).astype(np.float64)


@_loop
def gather_sums(rows, columns, high, low):
    """Sum sorted matrix entries at the same position; return (count, first index, high, low)."""
    count = -1
    first = np.empty(len(rows), np.int64)
    total_high, total_low = np.empty(len(rows)), np.empty(len(rows))
    for k in range(len(rows)):
        if k > 0 and rows[k] == rows[k - 1] and columns[k] == columns[k - 1]:
            total = add((total_high[count], total_low[count]), (high[k], low[k]))
            total_high[count], total_low[count] = total
        else:
            count += 1
            first[count], total_high[count], total_low[count] = k, high[k], low[k]
    return count + 1, first, total_high, total_low


@_loop
def product(starts, columns, high, low, x_high, x_low):
    """Return the product of a sparse matrix and a vector."""
    out_high, out_low = np.empty(len(starts) - 1), np.empty(len(starts) - 1)
    for i in range(len(starts) - 1):
        total = (0.0, 0.0)
        for k in range(starts[i], starts[i + 1]):
            j = columns[k]
            total = add(total, multiply((high[k], low[k]), (x_high[j], x_low[j])))
        out_high[i], out_low[i] = total
    return out_high, out_low


@_loop
def factorise(high, low, width, symmetric):
    """Factorize a band matrix as L U in place, without pivoting.

    Entry (i, j) is stored at [i, j - i + width]. A symmetric matrix may be positive semidefinite.
    For each motion in its null space, one unknown is excluded from the factorization. Return the
    mask of excluded unknowns, and the motions, (motions, n), scaled to 1 at the excluded unknown.
    """
    n = len(high)
    left_out = np.zeros(n, np.bool_)
    motions = []
    diagonal = high[:, width].copy()
    for k in range(n):
        pivot = (high[k, width], low[k, width])
        if symmetric and pivot[0] < _SUSPECT * diagonal[k]:
            motion = _motion(high, low, width, left_out, k)
            size = 0.0
            for i in range(k + 1):
                size += diagonal[i] * motion[i] ** 2
            if pivot[0] < FREE * size:
                left_out[k] = True
                motions.append(motion)
                for i in range(max(0, k - width), min(n, k + width + 1)):
                    high[i, k - i + width] = low[i, k - i + width] = 0.0
                    high[k, i - k + width] = low[k, i - k + width] = 0.0
                high[k, width] = 1.0
                continue
        last = min(n, k + width + 1)
        upper_high, upper_low = high[k, width + 1 :], low[k, width + 1 :]
        for i in range(k + 1, last):
            at = k - i + width
            if high[i, at] == 0.0:
                continue
            factor = divide((high[i, at], low[i, at]), pivot)
            high[i, at], low[i, at] = factor
            _subtract(
                factor[0],
                factor[1],
                upper_high,
                upper_low,
                high[i, at + 1 :],
                low[i, at + 1 :],
                last - k - 1,
            )
    return left_out, motions


@_loop
def _subtract(f_high, f_low, x_high, x_low, high, low, count):
    """Subtract f x from a vector in place."""
    wide = _SPLIT * f_high
    a_high = wide - (wide - f_high)
    a_low = f_high - a_high
    for j in range(count):
        x = x_high[j]
        product = f_high * x
        wide = _SPLIT * x
        b_high = wide - (wide - x)
        b_low = x - b_high
        error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
        error += f_high * x_low[j] + f_low * x
        y = high[j]
        total = y - product
        part = total - y
        rest = ((y - (total - part)) - (product + part)) + (low[j] - error)
        sum_ = total + rest
        high[j] = sum_
        low[j] = rest - (sum_ - total)


@_loop
def _motion(high, low, width, left_out, k):
    """Return the motion with unknown k at 1, later unknowns at 0, and no force before k."""
    z_high, z_low = np.zeros(len(high)), np.zeros(len(high))
    z_high[k] = 1.0
    for i in range(k - 1, -1, -1):
        if left_out[i]:
            continue
        total = (0.0, 0.0)
        for j in range(i + 1, min(k, i + width) + 1):
            at = j - i + width
            total = add(total, multiply((high[i, at], low[i, at]), (z_high[j], z_low[j])))
        z_high[i], z_low[i] = divide(negative(total), (high[i, width], low[i, width]))
    return z_high


@_loop
def substitute(high, low, width, left_out, x_high, x_low):
    """Solve L U x = b in place; excluded unknowns stay 0."""
    n = len(high)
    for i in range(n):
        total = (x_high[i], x_low[i])
        for j in range(max(0, i - width), i):
            at = j - i + width
            if high[i, at] != 0.0:
                term = multiply((high[i, at], low[i, at]), (x_high[j], x_low[j]))
                total = add(total, negative(term))
        x_high[i], x_low[i] = (0.0, 0.0) if left_out[i] else total
    for i in range(n - 1, -1, -1):
        total = (x_high[i], x_low[i])
        for j in range(i + 1, min(n, i + width + 1)):
            at = j - i + width
            if high[i, at] != 0.0:
                term = multiply((high[i, at], low[i, at]), (x_high[j], x_low[j]))
                total = add(total, negative(term))
        x_high[i], x_low[i] = divide(total, (high[i, width], low[i, width]))


@dataclass(frozen=True, eq=False)
class Matrix:
    """Sparse square matrix of double-double numbers, in compressed rows.

    Attributes
    ----------
    starts, columns : ndarray of int
        Start of each row, and column of each entry.
    high, low : ndarray
        Entries.
    symmetric : bool
        True if the matrix is the second derivative of an energy.
    """

    starts: Numbers
    columns: Numbers
    high: Array
    low: Array
    symmetric: bool

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.starts) - 1

    @functools.cached_property
    def rows(self) -> Numbers:
        """Row of each entry."""
        return np.repeat(np.arange(self.size), np.diff(self.starts))

    @functools.cached_property
    def diagonal(self) -> Array:
        """Diagonal; 0 at components without forces."""
        made = np.zeros(self.size)
        own = self.rows == self.columns
        made[self.columns[own]] = self.high[own]
        return made

    def times(self, high: Array, low: Array | None = None) -> tuple[Array, Array]:
        """Return the product with a vector."""
        low = np.zeros_like(high) if low is None else low
        about = self.starts, self.columns, self.high, self.low
        return product(*about, np.ascontiguousarray(high), np.ascontiguousarray(low))


def summed(size: int, entries: tuple[Numbers, Numbers, Array, Array], symmetric: bool) -> Matrix:
    """Return a matrix of a size from its entries; entries at the same position are added."""
    rows, columns, high, low = entries
    order = np.lexsort((columns, rows))
    rows, columns = rows[order], columns[order]
    count, first, high, low = gather_sums(rows, columns, high[order], low[order])
    first = first[:count]
    starts = np.searchsorted(rows[first], np.arange(size + 1))
    return Matrix(starts, columns[first], high[:count].copy(), low[:count].copy(), symmetric)


class Factors:
    """Factorization of the rows and columns of some unknowns of a matrix.

    Parameters
    ----------
    matrix : Matrix
        Matrix of all n components.
    unknowns : ndarray of int
        Indices of the unknowns; the other components are prescribed.
    springs : ndarray, shape (n,), optional
        Values that are added to the diagonal.

    Attributes
    ----------
    motions : ndarray, shape (motions, n)
        Basis of the zero-energy motions of the unknowns (the null space).
    """

    def __init__(self, matrix: Matrix, unknowns: Numbers, springs: Array | None = None) -> None:
        self._matrix = matrix
        place = np.full(matrix.size, -1)
        place[unknowns] = np.arange(len(unknowns))
        inner = (place[matrix.rows] >= 0) & (place[matrix.columns] >= 0)
        rows, columns = place[matrix.rows[inner]], place[matrix.columns[inner]]
        order = _narrow(rows, columns, len(unknowns))
        self.unknowns = unknowns[order]
        place[self.unknowns] = np.arange(len(unknowns))
        rows, columns = place[matrix.rows[inner]], place[matrix.columns[inner]]
        self._width = int(np.abs(rows - columns).max(initial=0))
        self._high = np.zeros((len(unknowns), 2 * self._width + 1))
        self._low = np.zeros_like(self._high)
        self._high[rows, columns - rows + self._width] = matrix.high[inner]
        self._low[rows, columns - rows + self._width] = matrix.low[inner]
        if springs is not None:
            middle = self._high[:, self._width], self._low[:, self._width]
            sums = add(middle, (springs[self.unknowns], np.zeros(len(unknowns))))
            self._high[:, self._width], self._low[:, self._width] = sums
        self._left_out, motions = factorise(self._high, self._low, self._width, matrix.symmetric)
        self.motions = np.zeros((len(motions), matrix.size))
        for number, motion in enumerate(motions):
            self.motions[number, self.unknowns] = motion

    def solution(self, right: Array) -> tuple[Array, Array]:
        """Return the solution for a right-hand side, shape (n,); 0 at prescribed components."""
        found_high, found_low = np.zeros(self._matrix.size), np.zeros(self._matrix.size)
        high = right[self.unknowns]
        low = np.zeros_like(high)
        self._substitute(high, low)
        found_high[self.unknowns], found_low[self.unknowns] = high, low
        return found_high, found_low

    def displaced(self, prescribed: Array, load: Array) -> tuple[Array, Array]:
        """Return the displacement, (high, low), at which the unknowns are in equilibrium.

        Prescribed components have the values of `prescribed`, and so does one unknown of each
        zero-energy motion.
        """
        high, low = prescribed.copy(), np.zeros_like(prescribed)
        # The second pass is a refinement step: it corrects the residual of the first pass.
        for _ in range(2):
            rest_high, rest_low = self._matrix.times(high, low)
            rest_high, rest_low = add((-rest_high, -rest_low), (load, np.zeros_like(load)))
            step_high, step_low = rest_high[self.unknowns], rest_low[self.unknowns]
            self._substitute(step_high, step_low)
            self.last_step = float(np.abs(step_high).max(initial=0.0))  # in pixels
            here = (high[self.unknowns], low[self.unknowns])
            high[self.unknowns], low[self.unknowns] = add(here, (step_high, step_low))
        return high, low

    def _substitute(self, high: Array, low: Array) -> None:
        substitute(self._high, self._low, self._width, self._left_out, high, low)

    @functools.cached_property
    def least(self) -> float:
        """Least eigenvalue of the symmetric matrix, with its diagonal scaled to 1."""
        if len(self.motions):
            return 0.0
        if not len(self.unknowns):
            return 1.0
        root = np.sqrt(self._matrix.diagonal[self.unknowns])
        vector = np.random.default_rng(0).normal(size=len(root))
        least = before = np.inf
        for _ in range(200):
            vector /= np.linalg.norm(vector)
            high, low = vector * root, np.zeros_like(root)
            self._substitute(high, low)
            following = high * root
            least = 1 / float(vector @ following)
            if abs(before - least) < 1e-3 * least:
                break
            vector, before = following, least
        return least


def _narrow(rows: Numbers, columns: Numbers, size: int) -> Numbers:
    """Return the order with the smaller bandwidth: by connected piece, or Cuthill-McKee."""
    if size == 0:
        return np.zeros(0, np.int64)
    pattern = scipy.sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(size, size))
    _, piece = csgraph.connected_components(pattern)
    orders = [np.argsort(piece, kind="stable"), csgraph.reverse_cuthill_mckee(pattern)]
    widths = []
    for order in orders:
        place = np.empty(size, np.int64)
        place[order] = np.arange(size)
        widths.append(np.abs(place[rows] - place[columns]).max(initial=0))
    return orders[int(np.argmin(widths))].astype(np.int64)
