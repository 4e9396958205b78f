"""Forces of tissue as sparse matrices, from the equations alone.

A matrix A maps a displacement to forces. In equilibrium, ``A d + p sign(d - y) = 0`` for
components that are observed with a penalty p, and ``A d = 0`` for other components. For elastic
tissue and for the blanket reading, A is the second derivative of the energy. For the centred
reading, each row is the derivative of the energy of the cliques centred at a site with respect to
that site's displacement.

Displacements are in pixels (`Problem.unit`), and component k of site (i, j) has the index
``2 (i W + j) + k``. Geometry is expressed in fractions, and entries are `double_double` numbers.
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

from napari_hmrf import ElasticPrior, Problem, SeilerPrior
from validation.oracles.exact import double_double as dd

Array = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]
_loop = numba.njit(cache=True, nogil=True, error_model="numpy")

#: Step (row, col) from the middle of a clique to its end u (figure 2).
LINES = np.array([(1, 0), (0, 1), (1, 1), (1, -1)])


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
        return dd.product(*about, np.ascontiguousarray(high), np.ascontiguousarray(low))


def matrix_of(problem: Problem, prior: ElasticPrior | SeilerPrior) -> Matrix:
    """Return the matrix of a problem's tissue."""
    m = problem.stiffness.astype(np.float64)
    if isinstance(prior, ElasticPrior):
        nu = np.broadcast_to(np.asarray(prior.poisson, dtype=np.float64), m.shape)
        strain = prior.plane == "strain"
        volume, shear = element_matrices(problem.spacing, twist=not strain)
        entries = _elastic_entries(m / m.max(), nu, strain, *volume, *shear)
        return _summed(m.size, entries, symmetric=True)
    lines = pairs(np.array(line_fractions(problem.spacing)))
    blanket = prior.conditional == "blanket"
    entries = _clique_entries(m, LINES, *lines, blanket)
    return _summed(m.size, entries, symmetric=blanket)


def pairs(fractions: npt.NDArray[Any]) -> tuple[Array, Array]:
    """Convert fractions to double-double numbers."""
    high = fractions.astype(np.float64)
    to_fraction: Callable[..., Any] = np.frompyfunc(Fraction, 1, 1)
    return high, (fractions - to_fraction(high)).astype(np.float64)


def element_matrices(
    spacing: tuple[float, ...], twist: bool
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return the element matrices V and S for lambda and mu, each of shape (8, 8).

    The energy of an element is ``(lambda d^T V d + mu d^T S d) / 2``, with its sites in the order
    (0, 0), (0, 1), (1, 0), (1, 1), and the row and column component of each site. Without `twist`,
    the change of volume is evaluated at the middle of the element.
    """
    ratio = Fraction(spacing[0]) / Fraction(spacing[1])
    corners = [(0, 0), (0, 1), (1, 0), (1, 1)]
    volume = np.full((8, 8), Fraction(0))
    shear = np.full((8, 8), Fraction(0))
    for a, (i, j) in enumerate(corners):
        for b, (k, l) in enumerate(corners):  # noqa: E741
            # Signs of the derivatives of the shape functions of the two sites, along both axes.
            up, right, up_too, right_too = 2 * i - 1, 2 * j - 1, 2 * k - 1, 2 * l - 1
            along = Fraction(1, 3) if j == l else Fraction(1, 6)
            across = Fraction(1, 3) if i == k else Fraction(1, 6)
            rows, cols = up * up_too * along / ratio, right * right_too * across * ratio
            row_col, col_row = Fraction(up * right_too, 4), Fraction(right * up_too, 4)
            middle = Fraction(1, 4)
            volume[2 * a : 2 * a + 2, 2 * b : 2 * b + 2] = [
                [rows if twist else up * up_too * middle / ratio, row_col],
                [col_row, cols if twist else right * right_too * middle * ratio],
            ]
            shear[2 * a : 2 * a + 2, 2 * b : 2 * b + 2] = [
                [2 * rows + cols, col_row],
                [row_col, 2 * cols + rows],
            ]
    return pairs(volume), pairs(shear)


def line_fractions(spacing: tuple[float, ...]) -> list[list[Fraction]]:
    """Return the weight of each line of cliques for each component, (4, 2).

    With these weights, the lines represent ``3 d_ii + 2 d_jj = 0`` in physical lengths. The weights
    of the diagonals are as large as possible without any negative weight.
    """
    row, col = (Fraction(size) for size in spacing)
    rows, cols = row / col, col / row  # squared sides; their product is 1
    slant = 1 / max(rows, cols)
    return [
        [3 / rows - 2 * slant, 2 / rows - 2 * slant],
        [2 / cols - 2 * slant, 3 / cols - 2 * slant],
        [slant, slant],
        [slant, slant],
    ]


@_loop
def _elastic_entries(m, nu, strain, volume, volume_low, shear, shear_low):
    """Return every entry of every element: (row, column, high, low)."""
    height, width = m.shape
    most = 64 * max(height - 1, 0) * max(width - 1, 0)
    rows, columns = np.empty(most, np.int64), np.empty(most, np.int64)
    high, low = np.empty(most), np.empty(most)
    count = 0
    for i in range(height - 1):
        for j in range(width - 1):
            sites = ((i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1))
            least = min(min(m[i, j], m[i, j + 1]), min(m[i + 1, j], m[i + 1, j + 1]))
            if least <= 0:
                continue
            young = (m[i, j] + m[i, j + 1] + m[i + 1, j] + m[i + 1, j + 1]) / 4
            ratio = (nu[i, j] + nu[i, j + 1] + nu[i + 1, j] + nu[i + 1, j + 1]) / 4
            second = young / (2 * (1 + ratio))
            if strain:
                first = young * ratio / ((1 + ratio) * (1 - 2 * ratio))
            else:
                first = young * ratio / (1 - ratio * ratio)
            for a in range(8):
                for b in range(8):
                    one, other = sites[a // 2], sites[b // 2]
                    rows[count] = 2 * (one[0] * width + one[1]) + a % 2
                    columns[count] = 2 * (other[0] * width + other[1]) + b % 2
                    high[count], low[count] = dd.add(
                        dd.multiply((first, 0.0), (volume[a, b], volume_low[a, b])),
                        dd.multiply((second, 0.0), (shear[a, b], shear_low[a, b])),
                    )
                    count += 1
    return rows[:count], columns[:count], high[:count], low[:count]


@_loop
def _clique_entries(m, lines, weights, weights_low, blanket):
    """Return every entry of every clique, for each component: (row, column, high, low)."""
    height, width = m.shape
    most = 72 * height * width
    rows, columns = np.empty(most, np.int64), np.empty(most, np.int64)
    high, low = np.empty(most), np.empty(most)
    count = 0
    one, minus = (1.0, 0.0), (-1.0, 0.0)
    for i in range(height):
        for j in range(width):
            for line in range(4):
                si, sj = i - lines[line, 0], j - lines[line, 1]
                ui, uj = i + lines[line, 0], j + lines[line, 1]
                if min(si, ui) < 0 or max(si, ui) >= height:
                    continue
                if min(sj, uj) < 0 or max(sj, uj) >= width:
                    continue
                if m[si, sj] <= 0 or m[i, j] <= 0 or m[ui, uj] <= 0:
                    continue
                sites = (si * width + sj, i * width + j, ui * width + uj)
                to_u = dd.divide((m[i, j], 0.0), (m[ui, uj], 0.0))
                to_s = dd.divide((m[i, j], 0.0), (m[si, sj], 0.0))
                # Squared terms: r_u (d_t - d_s) - (d_u - d_t) and r_s (d_t - d_u) - (d_s - d_t).
                first = (dd.negative(to_u), dd.add(one, to_u), minus)
                second = (minus, dd.add(one, to_s), dd.negative(to_s))
                for k in range(2):
                    weight = (2 * weights[line, k], 2 * weights_low[line, k])
                    if weight[0] <= 0:
                        continue
                    for a in range(3):
                        if a != 1 and not blanket:
                            continue
                        for b in range(3):
                            rows[count] = 2 * sites[a] + k
                            columns[count] = 2 * sites[b] + k
                            squares = dd.add(
                                dd.multiply(first[a], first[b]), dd.multiply(second[a], second[b])
                            )
                            high[count], low[count] = dd.multiply(weight, squares)
                            count += 1
    return rows[:count], columns[:count], high[:count], low[:count]


def _summed(sites: int, entries: tuple[Numbers, Numbers, Array, Array], symmetric: bool) -> Matrix:
    """Return a matrix from its entries; entries at the same position are added."""
    rows, columns, high, low = entries
    order = np.lexsort((columns, rows))
    rows, columns = rows[order], columns[order]
    count, first, high, low = dd.gather_sums(rows, columns, high[order], low[order])
    first = first[:count]
    starts = np.searchsorted(rows[first], np.arange(2 * sites + 1))
    return Matrix(starts, columns[first], high[:count].copy(), low[:count].copy(), symmetric)
