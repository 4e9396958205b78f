"""Forces of tissue as sparse matrices, and its zero-energy motions, from the equations alone.

A matrix A maps a displacement to forces. In equilibrium, ``A d + p sign(d - y) = 0`` for
components that are observed with a penalty p, and ``A d = 0`` for other components. For elastic
tissue and for the blanket reading, A is the second derivative of the energy. For the centred
reading, each row is the derivative of the energy of the cliques centred at a site with respect to
that site's displacement.

Displacements are in pixels (`Problem.unit`), and component k of site (i, j) has the index
``2 (i W + j) + k``. Geometry is expressed in fractions, and entries are `double_double` numbers.
"""

from __future__ import annotations

from fractions import Fraction

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
# Primes for ranks of the equations.
_PRIMES = (2147483647, 2147483629)
# Exponent of the smallest float32; all stiffnesses are multiples of this power of two.
_SMALLEST_EXPONENT = -149


def matrix_of(problem: Problem, prior: ElasticPrior | SeilerPrior) -> dd.Matrix:
    """Return the matrix of a problem's tissue."""
    m = problem.stiffness.astype(np.float64)
    if isinstance(prior, ElasticPrior):
        nu = np.broadcast_to(np.asarray(prior.poisson, dtype=np.float64), m.shape)
        strain = prior.plane == "strain"
        volume, shear = element_matrices(problem.spacing, twist=not strain)
        entries = _elastic_entries(m / m.max(), nu, strain, *volume, *shear)
        return dd.summed(2 * m.size, entries, symmetric=True)
    lines = dd.pairs(np.array(line_fractions(problem.spacing)))
    blanket = prior.conditional == "blanket"
    entries = _clique_entries(m, LINES, *lines, blanket)
    return dd.summed(2 * m.size, entries, symmetric=blanket)


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
    return dd.pairs(volume), dd.pairs(shear)


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


def free_motions(problem: Problem) -> int:
    """Return the number of independent zero-energy motions of the unobserved components.

    Components that belong to no clique are not counted, because they stay at rest.

    Stiffnesses are binary fractions, so the energy of a clique is zero if two linear expressions
    with integer coefficients are 0. The number of motions is the number of unknowns minus the rank
    of these expressions. The rank is computed in arithmetic modulo a prime, without rounding. It is
    never too large, and is too small with a probability of about n / prime, so the larger rank for
    two primes is used.

    Parameters
    ----------
    problem : Problem
        Problem in the blanket reading.
    """
    return min(_count(problem, prime) for prime in _PRIMES)


def _count(problem: Problem, prime: int) -> int:
    """Return the number of motions in arithmetic modulo a prime."""
    m = problem.stiffness
    turned = m.shape[1] > m.shape[0]
    m = m.T if turned else m
    residues = np.array(
        [_residue(float(value), prime) for value in m.ravel()], dtype=np.int64
    ).reshape(m.shape)
    fractions = line_fractions(problem.spacing)
    motions = 0
    for component in range(2):
        known = problem.known[..., component]
        known = known.T if turned else known
        lines = [LINES[k] for k in range(len(LINES)) if fractions[k][component] > 0]
        offsets = np.array([line[::-1] if turned else line for line in lines], dtype=np.int64)
        columns, rows = _expressions(residues, known, offsets, prime)
        touched = np.unique(columns[columns >= 0])
        if not len(touched):
            continue
        place = np.full(int(touched.max()) + 1, -1)
        place[touched] = np.arange(len(touched))
        columns = np.where(columns >= 0, place[columns], -1)
        motions += len(touched) - _rank(columns, rows, len(touched), prime)
    return motions


def _residue(value: float, prime: int) -> int:
    """Return a multiple of the smallest float32 as an integer modulo a prime."""
    top, bottom = value.as_integer_ratio()
    return (top << -_SMALLEST_EXPONENT) // bottom % prime


@_loop
def _expressions(m, known, offsets, prime):
    """Return the columns (n, 3), -1 if prescribed, and coefficients (n, 3) of all expressions."""
    height, width = m.shape
    most = 2 * len(offsets) * height * width
    columns, rows = np.empty((most, 3), np.int64), np.empty((most, 3), np.int64)
    count = 0
    for i in range(height):
        for j in range(width):
            for k in range(len(offsets)):
                si, sj = i - offsets[k, 0], j - offsets[k, 1]
                ui, uj = i + offsets[k, 0], j + offsets[k, 1]
                if min(si, ui) < 0 or max(si, ui) >= height:
                    continue
                if min(sj, uj) < 0 or max(sj, uj) >= width:
                    continue
                s, t, u = m[si, sj], m[i, j], m[ui, uj]
                if s == 0 or t == 0 or u == 0:
                    continue
                for way in range(2):
                    columns[count, 0] = -1 if known[si, sj] else si * width + sj
                    columns[count, 1] = -1 if known[i, j] else i * width + j
                    columns[count, 2] = -1 if known[ui, uj] else ui * width + uj
                    # m_t (d_t - d_s) - m_u (d_u - d_t), and the same with s and u exchanged.
                    other = u if way == 0 else s
                    ends = (t, other) if way == 0 else (other, t)
                    rows[count, 0] = prime - ends[0]
                    rows[count, 1] = (t + other) % prime
                    rows[count, 2] = prime - ends[1]
                    count += 1
    return columns[:count], rows[:count]


@_loop
def _inverse(value, prime):
    """Return the inverse modulo a prime by Fermat's little theorem."""
    result, power, exponent = 1, value % prime, prime - 2
    while exponent:
        if exponent & 1:
            result = result * power % prime
        power = power * power % prime
        exponent >>= 1
    return result


@_loop
def _rank(columns, rows, size, prime):
    """Return the rank of a matrix with narrow rows, by row elimination."""
    width = 1
    for k in range(len(columns)):
        low, high = size, -1
        for part in range(3):
            if columns[k, part] >= 0:
                low, high = min(low, columns[k, part]), max(high, columns[k, part])
        width = max(width, high - low + 1)
    band, filled = np.zeros((size, width), np.int64), np.zeros(size, np.bool_)
    rank = 0
    line = np.zeros(width, np.int64)
    for k in range(len(columns)):
        at = size
        for part in range(3):
            if columns[k, part] >= 0:
                at = min(at, columns[k, part])
        if at == size:
            continue
        line[:] = 0
        for part in range(3):
            if columns[k, part] >= 0:
                line[columns[k, part] - at] = rows[k, part] % prime
        while at < size:
            if line[0] == 0:
                line[:-1] = line[1:]
                line[-1] = 0
                at += 1
                if not line.any():
                    break
            elif filled[at]:
                factor = line[0]
                for part in range(width):
                    line[part] = (line[part] + (prime - factor) * band[at, part]) % prime
            else:
                scale = _inverse(line[0], prime)
                for part in range(width):
                    band[at, part] = line[part] * scale % prime
                filled[at] = True
                rank += 1
                break
    return rank
