"""Compiled loops in double precision: residual, energy and forces of elastic tissue.

Arrays and threads are used as in `backends.cpu.elastic`, but displacement and load have double
precision. These loops evaluate the convergence criterion.
"""

# mypy: disable-error-code="no-untyped-def, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32, prange

from napari_hmrf.solver.backends.cpu.compiled import (
    callee,
    contracted_reduction,
    disjoint_callee,
    parallel,
    shared,
)
from napari_hmrf.solver.backends.cpu.forces import (
    left_of,
    moduli_of,
    part,
    reach,
    row_force,
    rows_of,
)
from napari_hmrf.solver.backends.cpu.vectors import row_largest, row_product


@shared
def _with_data(row, col, d, data, i, j):
    """Add the force W d of the data term to the force (row, col) at a site."""
    x, y = d[0, i, j], d[1, i, j]
    row += data[0, i, j] * x + data[2, i, j] * y
    col += data[2, i, j] * x + data[1, i, j] * y
    return row, col


@disjoint_callee
def _balance_row(d, load, given, tissue, data, i, span, carry, share, out_row, out_col):
    lame, inverse, shape = tissue
    pull_row, pull_col = load[0, i], load[1, i]
    rows, moduli = rows_of(d, i), moduli_of(lame, i)
    start, past = max(span[0], 0), span[1]
    left = left_of(rows, moduli, shape, start + 1)
    for k in range(past - start):
        j = start + k + 2
        row, col, left = row_force(rows, moduli, shape, carry, left, j)
        if data is not None:
            row, col = _with_data(row, col, d, data, i, j)
        row, col = given * pull_row[j] - row, given * pull_col[j] - col
        row, col = float32(share * row), float32(share * col)
        out_row[j] = row if inverse[0, i, j] > float32(0) else row - row
        out_col[j] = col if inverse[1, i, j] > float32(0) else col - col


@callee
def _balance_part(
    d, load, given, tissue, data, spans, share, out, row_most, row_squares, first, last
):
    carry, unused = np.zeros_like(d[:, 0]), np.zeros_like(out[:, 0])
    for i in range(max(first - 1, 0), last):
        row, col = (out[0, i + 2], out[1, i + 2]) if i >= first else (unused[0], unused[1])
        span = reach(spans, i)
        _balance_row(d, load, given, tissue, data, i + 2, span, carry, share, row, col)
        if i >= first:
            row_most[i] = row_largest(out, i + 2)
            row_squares[i] = row_product(out, out, i + 2)


@parallel
def balance(
    d, load, given, lame, inverse, data, shape, spans, share, out, row_most, row_squares, count
):
    """Write ``share * (given * load - A d)`` to `out` in float32, or 0 at fixed components.

    `data` contains the tensors of the data term, which are part of A, or is None.

    On return, `row_most` contains the largest absolute value of each row, and `row_squares` the sum
    of its squares.
    """
    for number in prange(count):
        first, last = part(number, count, len(spans))
        tissue = lame, inverse, shape
        _balance_part(
            d, load, given, tissue, data, spans, share, out, row_most, row_squares, first, last
        )


@contracted_reduction
def _work_row(d, lame, data, shape, i, carry):
    """Return the contributions of one row to d . A d and ||A d||^2."""
    rows, moduli = rows_of(d, i), moduli_of(lame, i)
    product, square = 0.0, 0.0
    left = left_of(rows, moduli, shape, 1)
    for k in range(d.shape[2] - 4):
        j = k + 2
        row, col, left = row_force(rows, moduli, shape, carry, left, j)
        if data is not None:
            row, col = _with_data(row, col, d, data, i, j)
        product += d[0, i, j] * row + d[1, i, j] * col
        square += row * row + col * col
    return product, square


@callee
def _work_part(d, lame, data, shape, row_products, row_squares, first, last):
    carry = np.zeros_like(d[:, 0])
    for i in range(max(first - 1, 0), last):
        product, square = _work_row(d, lame, data, shape, i + 2, carry)
        if i >= first:
            row_products[i], row_squares[i] = product, square


@parallel
def work(d, lame, data, shape, row_products, row_squares, count):
    """Compute the contributions of each row to d . A d and ||A d||^2.

    `data` contains the tensors of the data term, which are part of A, or is None.
    """
    for number in prange(count):
        first, last = part(number, count, len(row_products))
        _work_part(d, lame, data, shape, row_products, row_squares, first, last)


@disjoint_callee
def _pull_row(d, lame, shape, i, carry, out_row, out_col):
    rows, moduli = rows_of(d, i), moduli_of(lame, i)
    left = left_of(rows, moduli, shape, 1)
    for k in range(d.shape[2] - 4):
        j = k + 2
        row, col, left = row_force(rows, moduli, shape, carry, left, j)
        out_row[j] = -row
        out_col[j] = -col


@callee
def _pull_part(d, lame, shape, out, first, last):
    carry, unused = np.zeros_like(d[:, 0]), np.zeros_like(d[:, 0])
    for i in range(max(first - 1, 0), last):
        row, col = (out[0, i + 2], out[1, i + 2]) if i >= first else (unused[0], unused[1])
        _pull_row(d, lame, shape, i + 2, carry, row, col)


@parallel
def pull(d, lame, shape, out, count):
    """Write -A d to `out`, including its values at prescribed components."""
    for number in prange(count):
        first, last = part(number, count, d.shape[1] - 4)
        _pull_part(d, lame, shape, out, first, last)
