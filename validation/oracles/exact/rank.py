"""Exact number of zero-energy motions in the blanket reading.

Stiffnesses are binary fractions, so the energy of a clique is zero if two linear expressions with
integer coefficients are 0. The number of motions is the number of unknowns minus the rank of these
expressions. The rank is computed in arithmetic modulo a prime, without rounding. A rank modulo a
prime is never too large, and is too small with a probability of about n / prime, so the larger rank
for two primes is used.
"""

from __future__ import annotations

import numba
import numpy as np

from napari_hmrf import Problem
from validation.oracles.exact.matrices import LINES, line_fractions

_loop = numba.njit(cache=True, nogil=True)
_PRIMES = (2147483647, 2147483629)
# Exponent of the smallest float32; all stiffnesses are multiples of this power of two.
_SMALLEST_EXPONENT = -149


def free_motions(problem: Problem) -> int:
    """Return the number of independent zero-energy motions of the unobserved components.

    Components that belong to no clique are not counted, because they stay at rest.

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
