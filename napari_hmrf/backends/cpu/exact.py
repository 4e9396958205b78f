"""Displacements in double precision on the host, as compiled loops: what refinement is made of.

Planes are float64, (2, H + 4, W + 4), the component first, in a ring of zeros two sites wide. A
row's share of a total is returned for each row.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numba
import numpy as np
from numba import prange

_parallel = numba.njit(cache=True, nogil=True, error_model="numpy", parallel=True)


@_parallel
def prescribe(y, c, m, start, share, d, held):
    """Displace by share * y where tissue is observed (c > 0), and hold it there; the rest as start.

    `start`, (H, W, 2) in pixels, may be None: zero.
    """
    for i in prange(m.shape[0]):
        for j in range(m.shape[1]):
            tissue = m[i, j] > 0
            row, col = tissue & (c[i, j, 0] > 0), tissue & (c[i, j, 1] > 0)
            held[0, i + 2, j + 2] = row
            held[1, i + 2, j + 2] = col
            if start is None:
                d[0, i + 2, j + 2] = share * y[i, j, 0] if row else 0.0
                d[1, i + 2, j + 2] = share * y[i, j, 1] if col else 0.0
            else:
                d[0, i + 2, j + 2] = share * y[i, j, 0] if row else start[i, j, 0]
                d[1, i + 2, j + 2] = share * y[i, j, 1] if col else start[i, j, 1]


@numba.njit(cache=True, nogil=True)
def observed(c, m, at):
    """Write where tissue is observed to `at`, numbers in the order of memory; how many."""
    count = 0
    for i in range(m.shape[0]):
        for j in range(m.shape[1]):
            for k in range(2):
                if c[i, j, k] > 0 and m[i, j] > 0:
                    at[count] = (i * m.shape[1] + j) * 2 + k
                    count += 1
    return count


@_parallel
def blend(values, weight, out):
    """Out += weight * values, all (H, W, 2)."""
    for i in prange(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j, 0] += weight * values[i, j, 0]
            out[i, j, 1] += weight * values[i, j, 1]


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "nsz"})
def _settle_row(values, tissue, unit):
    nothing = np.float32(0)
    for j in range(len(values)):
        nothing += values[j] * np.float32(0)  # 0, but for what is not a number
    for j in range(len(tissue)):
        factor = unit * np.float32(tissue[j])
        values[2 * j] *= factor
        values[2 * j + 1] *= factor
    return nothing == 0


@_parallel
def settle(values, tissue, unit, row_finite):
    """Values *= unit on tissue, 0 elsewhere; whether each row of (H, W, 2) had numbers only."""
    flat = values.reshape(values.shape[0], -1)
    for i in prange(values.shape[0]):
        row_finite[i] = _settle_row(flat[i], tissue[i], unit)


@_parallel
def measure(rest, row_most, row_squares):
    """The largest absolute value, and the sum of squares, of each row."""
    for i in prange(rest.shape[1] - 4):
        row_most[i], row_squares[i] = _row_measure(rest, i + 2)


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _row_measure(rest, i):
    most, square = np.int64(0), 0.0
    for k in range(2):
        # In the order of their bits, as in `vectors.row_largest`.
        bits = rest[k, i].view(np.int64)
        for j in range(len(bits)):
            most = max(most, bits[j] & np.int64(0x7FFFFFFFFFFFFFFF))
            square += rest[k, i, j] ** 2
    return np.int64(most).view(np.float64), square


@_parallel
def shrink(rest, scale, out):
    """Out = rest / scale in single precision."""
    for i in prange(rest.shape[1]):
        for k in range(2):
            for j in range(rest.shape[2]):
                out[k, i, j] = np.float32(rest[k, i, j] / scale)


@_parallel
def add(d, correction, scale):
    """D += scale * correction."""
    for i in prange(d.shape[1]):
        for k in range(2):
            for j in range(d.shape[2]):
                d[k, i, j] += scale * correction[k, i, j]


@_parallel
def gather(d, out):
    """Out, (H, W, 2) in single precision, from planes."""
    for i in prange(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j, 0] = np.float32(d[0, i + 2, j + 2])
            out[i, j, 1] = np.float32(d[1, i + 2, j + 2])
