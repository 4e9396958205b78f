"""Compiled loops for elastic tissue: the multigrid operations in single precision.

All arrays have a border of void, two sites wide. A component that is prescribed, or that does not
belong to an element, has an inverse diagonal of 0, so its correction stays 0. `weight` is the
diagonal of the springs W of a coarse level. It is multiplied by `springs`, which is 0 on the finest
level and 1 on the other levels. With a data term (`data_weights`), W also has the components
`mixed`, and `inverse` is a block for each site; otherwise `mixed` is None.

Each kernel divides the rows among `count` threads. A thread starts one row above its first row to
initialize the array `carry`, and discards the result for that row. In each row, kernels write only
to the span of moving sites (`spans`), so the output must already be 0 outside the spans.
"""

# mypy: disable-error-code="no-untyped-def, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32, prange

from napari_hmrf.solver.backends.cpu.compiled import alone, callee, disjoint_callee, parallel
from napari_hmrf.solver.backends.cpu.data_weights import filtered
from napari_hmrf.solver.backends.cpu.forces import (
    left_of,
    left_over,
    moduli_of,
    part,
    reach,
    row_force,
    rows_of,
)
from napari_hmrf.solver.backends.cpu.vectors import restrict_row, row_product

# Loops over a row start at max(..., 0), so that the compiler can exclude negative indices.


@disjoint_callee
def _apply_row(d, lame, inverse, data, shape, i, span, carry, out_row, out_col):
    rows, moduli = rows_of(d, i), moduli_of(lame, i)
    start, past = max(span[0], 0), span[1]
    left = left_of(rows, moduli, shape, start + 1)
    for k in range(past - start):
        j = start + k + 2
        row, col, left = row_force(rows, moduli, shape, carry, left, j)
        if data is not None:
            x, y = d[0, i, j], d[1, i, j]
            row += data[0, i, j] * x + data[2, i, j] * y
            col += data[2, i, j] * x + data[1, i, j] * y
        out_row[j] = row if inverse[0, i, j] > float32(0) else float32(0)
        out_col[j] = col if inverse[1, i, j] > float32(0) else float32(0)


@alone
def apply_part(d, lame, inverse, data, shape, spans, out, row_totals, first, last):
    """Compute the rows `first` to `last` (exclusive) of `apply`."""
    carry, unused = np.zeros_like(d[:, 0]), np.zeros_like(d[:, 0])
    for i in range(max(first - 1, 0), last):
        row, col = (out[0, i + 2], out[1, i + 2]) if i >= first else (unused[0], unused[1])
        _apply_row(d, lame, inverse, data, shape, i + 2, reach(spans, i), carry, row, col)
        if i >= first:
            row_totals[i] = row_product(d, out, i + 2)


@parallel
def apply(d, lame, inverse, data, shape, spans, out, row_totals, count):
    """Write A d to `out`, or 0 at fixed components; store d . A d per row in `row_totals`.

    `data` contains the tensors of the data term, in double precision, or is None.
    """
    for number in prange(count):
        first, last = part(number, count, len(spans))
        apply_part(d, lame, inverse, data, shape, spans, out, row_totals, first, last)


@disjoint_callee
def _smooth_row(rows, tissue, weights, mixed, i, span, carry, pace, out_row, out_col):
    load, lame, inverse, shape = tissue
    scale, ahead, back = pace
    d_row, _, d_col, _ = rows
    moduli = moduli_of(lame, i)
    start, past = max(span[0], 0), span[1]
    left = left_of(rows, moduli, shape, start + 1)
    for k in range(past - start):
        j = start + k + 2
        row, col, left = row_force(rows, moduli, shape, carry, left, j)
        row, col = left_over(row, col, d_row[j], d_col[j], load, weights, i, j)
        if mixed is None:
            row = scale * inverse[0, i, j] * row + ahead * d_row[j]
            col = scale * inverse[1, i, j] * col + ahead * d_col[j]
        else:
            row -= mixed[0, i, j] * d_col[j]
            col -= mixed[0, i, j] * d_row[j]
            row, col = (
                scale * (inverse[0, i, j] * row + mixed[1, i, j] * col) + ahead * d_row[j],
                scale * (mixed[1, i, j] * row + inverse[1, i, j] * col) + ahead * d_col[j],
            )
        out_row[j] = d_row[j] + (row - back * out_row[j])
        out_col[j] = d_col[j] + (col - back * out_col[j])


@callee
def _smooth_part(d, tissue, weights, mixed, spans, out, pace, first, last):
    carry, unused = np.zeros_like(d[:, 0]), np.zeros_like(d[:, 0])
    for i in range(max(first - 1, 0), last):
        row, col = (out[0, i + 2], out[1, i + 2]) if i >= first else (unused[0], unused[1])
        _smooth_row(
            rows_of(d, i + 2), tissue, weights, mixed, i + 2, reach(spans, i), carry, pace, row, col
        )


@parallel
def smooth(
    d, load, lame, inverse, weight, springs, mixed, shape, spans, out, scale, ahead, back, count
):
    """Compute a Chebyshev step with the coefficients `scale`, `ahead` and `back`.

    The step is ``out = d + scale * D^-1 (load - (A + W) d) + ahead * d - back * out``. On entry,
    `out` contains the displacement before the previous step.
    """
    for number in prange(count):
        first, last = part(number, count, len(spans))
        tissue, pace = (load, lame, inverse, shape), (scale, ahead, back)
        _smooth_part(d, tissue, (weight, springs), mixed, spans, out, pace, first, last)


@disjoint_callee
def _start_row(load, inverse, mixed, scale, i, out):
    """Compute a row of the first step from zero: ``out = scale * D^-1 load``."""
    for component in range(2):
        for j in range(out.shape[1]):
            out[component, j] = scale * inverse[component, i, j] * load[component, i, j]
            if mixed is not None:
                out[component, j] += scale * mixed[1, i, j] * load[1 - component, i, j]


@callee
def _begin_part(tissue, weights, mixed, spans, out, start, pace, first, last):
    load, _, inverse, _ = tissue
    carry, unused = np.zeros_like(load[:, 0]), np.zeros_like(load[:, 0])
    here, below = np.zeros_like(carry), np.zeros_like(carry)
    top = max(first - 1, 0)
    _start_row(load, inverse, mixed, start, top + 2, here)
    for i in range(top, last):
        _start_row(load, inverse, mixed, start, i + 3, below)
        rows = here[0], below[0], here[1], below[1]
        row, col = (out[0, i + 2], out[1, i + 2]) if i >= first else (unused[0], unused[1])
        _smooth_row(rows, tissue, weights, mixed, i + 2, reach(spans, i), carry, pace, row, col)
        here, below = below, here


@parallel
def begin(
    load, lame, inverse, weight, springs, mixed, shape, spans, out, start, scale, ahead, back, count
):
    """Compute the first two Chebyshev steps from zero.

    The first step is ``start * D^-1 load``; the second step is `smooth` applied to the first.
    """
    for number in prange(count):
        first, last = part(number, count, len(spans))
        tissue, pace = (load, lame, inverse, shape), (scale, ahead, back)
        _begin_part(tissue, (weight, springs), mixed, spans, out, start, pace, first, last)


@disjoint_callee
def _rest_row(d, tissue, weights, mixed, i, span, carry, out):
    load, lame, inverse, shape = tissue
    rows, moduli = rows_of(d, i), moduli_of(lame, i)
    start, past = max(span[0], 0), span[1]
    left = left_of(rows, moduli, shape, start + 1)
    out[:] = 0
    for k in range(past - start):
        j = start + k + 2
        row, col, left = row_force(rows, moduli, shape, carry, left, j)
        row, col = left_over(row, col, d[0, i, j], d[1, i, j], load, weights, i, j)
        if mixed is not None:
            row -= mixed[0, i, j] * d[1, i, j]
            col -= mixed[0, i, j] * d[0, i, j]
            row, col = filtered(row, col, inverse, weights[0], mixed, i, j)
        out[0, j] = row if inverse[0, i, j] > float32(0) else row - row
        out[1, j] = col if inverse[1, i, j] > float32(0) else col - col


@callee
def _leave_part(d, tissue, weights, mixed, spans, coarse, first, last):
    """Compute the coarse rows `first` to `last` (exclusive) of `leave`.

    A coarse row depends on three fine rows. One more row above them is required to fill `carry`.
    """
    carry = np.zeros_like(d[:, 0])
    rest = np.zeros((3, *carry.shape), dtype=d.dtype)
    for i in range(max(2 * first - 2, 0), 2 * last):
        row = rest[i % 3]
        if i < len(spans):
            _rest_row(d, tissue, weights, mixed, i + 2, reach(spans, i), carry, row)
        else:
            row[:] = 0
        if i % 2 == 1 and i > 2 * first:
            for component in range(2):
                restrict_row(
                    rest[(i - 2) % 3, component],
                    rest[(i - 1) % 3, component],
                    row[component],
                    coarse[component, i // 2 + 2],
                )


@parallel
def leave(d, load, lame, inverse, weight, springs, mixed, shape, spans, coarse, count):
    """Restrict the residual to `coarse`: load - (A + W) d, or 0 at fixed components.

    With a data term, the residual is filtered (`data_weights`).
    """
    for number in prange(count):
        first, last = part(number, count, coarse.shape[1] - 4)
        tissue = load, lame, inverse, shape
        _leave_part(d, tissue, (weight, springs), mixed, spans, coarse, first, last)
