"""Direct solution of a part of a matrix in double-double precision, with its null space."""

from __future__ import annotations

import functools

import numpy as np
import scipy.sparse
from scipy.sparse import csgraph

from validation.oracles.exact import double_double as dd
from validation.oracles.exact.matrices import Array, Matrix, Numbers


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
            sums = dd.add(middle, (springs[self.unknowns], np.zeros(len(unknowns))))
            self._high[:, self._width], self._low[:, self._width] = sums
        self._left_out, motions = dd.factorise(self._high, self._low, self._width, matrix.symmetric)
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
            rest_high, rest_low = dd.add((-rest_high, -rest_low), (load, np.zeros_like(load)))
            step_high, step_low = rest_high[self.unknowns], rest_low[self.unknowns]
            self._substitute(step_high, step_low)
            self.last_step = float(np.abs(step_high).max(initial=0.0))  # in pixels
            here = (high[self.unknowns], low[self.unknowns])
            high[self.unknowns], low[self.unknowns] = dd.add(here, (step_high, step_low))
        return high, low

    def _substitute(self, high: Array, low: Array) -> None:
        dd.substitute(self._high, self._low, self._width, self._left_out, high, low)

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
