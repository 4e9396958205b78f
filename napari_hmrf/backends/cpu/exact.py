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
def prescribe(y, c, m, unit, d, held):
    """Displace by y / unit where tissue is observed (c > 0), and hold it there; the rest by 0."""
    for i in prange(m.shape[0]):
        for k in range(2):
            for j in range(m.shape[1]):
                given = c[i, j, k] > 0 and m[i, j] > 0
                held[k, i + 2, j + 2] = given
                d[k, i + 2, j + 2] = y[i, j, k] / unit if given else 0.0


@numba.njit(
    cache=True,
    nogil=True,
    error_model="numpy",
    parallel=True,
    fastmath={"reassoc", "contract", "nsz"},
)
def work(d, pull, row_products, row_squares):
    """The product of a displacement and the forces at it, and the square of these, by rows."""
    for i in prange(d.shape[1] - 4):
        total, square = 0.0, 0.0
        for k in range(2):
            for j in range(d.shape[2]):
                total += d[k, i + 2, j] * pull[k, i + 2, j]
                square += pull[k, i + 2, j] * pull[k, i + 2, j]
        row_products[i] = total
        row_squares[i] = square


@numba.njit(
    cache=True,
    nogil=True,
    error_model="numpy",
    parallel=True,
    fastmath={"reassoc", "contract", "nsz", "nnan"},
)
def measure(rest, row_most, row_squares):
    """The largest absolute value and the sum of squares of each row."""
    for i in prange(rest.shape[1] - 4):
        most, square = 0.0, 0.0
        for k in range(2):
            for j in range(rest.shape[2]):
                value = abs(rest[k, i + 2, j])
                most = value if value > most else most
                square += rest[k, i + 2, j] ** 2
        row_most[i] = most
        row_squares[i] = square


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
