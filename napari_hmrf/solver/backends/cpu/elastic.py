"""Compiled loops for elastic tissue: the multigrid operations in single precision.

Arrays have shape (C, N) and contain padded rows, one after another. A table contains the index of
column 0 of each row (`layout`). A component that is prescribed, or that does not belong to an
element, has an inverse diagonal of 0, so its correction stays 0. `weight` is the diagonal of the
springs W of a coarse level. It is multiplied by `springs`, which is 0 on the finest level and 1 on
the other levels. With a data term (`data_weights`), W also has the components `mixed`, and
`inverse` is a block for each site; otherwise `mixed` is None.

Each kernel divides the rows among `count` threads. A thread starts one row above its first row to
initialize the array `carry`, and discards the result for that row. In each row, kernels write only
to the span of moving sites (`spans`), so the output must already be 0 outside the spans. `where`
consists of the table of rows, the spans, and the width of a padded row.
"""

# mypy: disable-error-code="no-untyped-def, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32

from napari_hmrf.solver.backends.cpu.compiled import (
    alone,
    bounds_of_part,
    callee,
    disjoint_callee,
    disjoint_parallel,
    inline,
    parallel,
    portion,
)
from napari_hmrf.solver.backends.cpu.data_weights import filtered
from napari_hmrf.solver.backends.cpu.forces import (
    left_of,
    left_over,
    pair,
    place,
    row_force,
    rows_of,
)
from napari_hmrf.solver.backends.cpu.vectors import interpolate_row, line_product, restrict_row


@disjoint_callee
def _apply_row(rows, lame, inverse, data, here, shape, carry, out_row, out_col):
    d_row, _, d_col, _ = rows
    left = left_of(rows, lame, shape, 0)
    for k in range(len(d_row) - 2):
        j = k + 1
        row, col, left = row_force(rows, lame, shape, carry, left, j)
        if data is not None:
            row += data[0, here + j] * d_row[j] + data[2, here + j] * d_col[j]
            col += data[2, here + j] * d_row[j] + data[1, here + j] * d_col[j]
        out_row[j] = row if inverse[0][j] > float32(0) else float32(0)
        out_col[j] = col if inverse[1][j] > float32(0) else float32(0)


@alone
def apply_part(d, lame, inverse, data, shape, where, out, row_totals, first, last):
    """Compute the rows `first` to `last` (exclusive) of `apply`."""
    carry, unused = np.zeros((2, where[2]), d.dtype), np.zeros((2, where[2]), d.dtype)
    for i in range(max(first - 1, 0), last):
        column, here, below, count = place(where, i)
        if i >= first:
            row_totals[i] = 0
        if count == 0:
            continue
        past = here + count
        rows = rows_of(d, here, below, count)
        row, col = pair(out, here, past) if i >= first else pair(unused, column, column + count)
        about = pair(lame, here, past), pair(inverse, here, past), data, here, shape
        _apply_row(rows, *about, pair(carry, column, column + count), row, col)
        if i >= first:
            row_totals[i] = line_product(rows[0], row) + line_product(rows[2], col)


@parallel
def apply(thread, d, lame, inverse, data, shape, where, out, row_totals, count):
    """Write A d to `out`, or 0 at fixed components; store d . A d per row in `row_totals`.

    `data` contains the tensors of the data term, in double precision, or is None.
    """
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(where[1]))
        apply_part(d, lame, inverse, data, shape, where, out, row_totals, first, last)


@disjoint_callee
def _smooth_row(rows, load, lame, inverse, weights, mixed, here, shape, carry, pace, out):
    scale, ahead, back = pace
    d_row, _, d_col, _ = rows
    out_row, out_col = out
    left = left_of(rows, lame, shape, 0)
    for k in range(len(d_row) - 2):
        j = k + 1
        row, col, left = row_force(rows, lame, shape, carry, left, j)
        row, col = left_over(row, col, (d_row, d_col), load, weights, j)
        if mixed is None:
            row = scale * inverse[0][j] * row + ahead * d_row[j]
            col = scale * inverse[1][j] * col + ahead * d_col[j]
        else:
            row -= mixed[0, here + j] * d_col[j]
            col -= mixed[0, here + j] * d_row[j]
            block = mixed[1, here + j]
            row, col = (
                scale * (inverse[0][j] * row + block * col) + ahead * d_row[j],
                scale * (block * row + inverse[1][j] * col) + ahead * d_col[j],
            )
        out_row[j] = d_row[j] + (row - back * out_row[j])
        out_col[j] = d_col[j] + (col - back * out_col[j])


@inline
def _tissue_row(tissue, weights, here, past):
    """Return load, Lame parameters, inverse diagonal and springs of a row."""
    load, lame, inverse, _ = tissue
    weight, springs = weights
    return (
        pair(load, here, past),
        pair(lame, here, past),
        pair(inverse, here, past),
        (pair(weight, here, past), springs),
    )


@callee
def _smooth_part(d, tissue, weights, mixed, where, out, pace, first, last):
    carry, unused = np.zeros((2, where[2]), d.dtype), np.zeros((2, where[2]), d.dtype)
    for i in range(max(first - 1, 0), last):
        column, here, below, count = place(where, i)
        if count == 0:
            continue
        past = here + count
        result = pair(out, here, past) if i >= first else pair(unused, column, column + count)
        about = _tissue_row(tissue, weights, here, past)
        rows, carried = rows_of(d, here, below, count), pair(carry, column, column + count)
        _smooth_row(rows, *about, mixed, here, tissue[3], carried, pace, result)


@parallel
def smooth(
    thread,
    d,
    load,
    lame,
    inverse,
    weight,
    springs,
    mixed,
    shape,
    where,
    out,
    scale,
    ahead,
    back,
    count,
):
    """Compute a Chebyshev step with the coefficients `scale`, `ahead` and `back`.

    The step is ``out = d + scale * D^-1 (load - (A + W) d) + ahead * d - back * out``. On entry,
    `out` contains the displacement before the previous step.
    """
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(where[1]))
        tissue, pace = (load, lame, inverse, shape), (scale, ahead, back)
        _smooth_part(d, tissue, (weight, springs), mixed, where, out, pace, first, last)


@disjoint_callee
def _start_row(load, inverse, mixed, here, scale, out_row, out_col):
    for j in range(len(out_row)):
        out_row[j] = scale * inverse[0][j] * load[0][j]
        out_col[j] = scale * inverse[1][j] * load[1][j]
        if mixed is not None:
            out_row[j] += scale * mixed[1, here + j] * load[1][j]
            out_col[j] += scale * mixed[1, here + j] * load[0][j]


@callee
def _start(load, inverse, mixed, scale, where, i, out):
    """Compute a row of the first step from zero: ``out = scale * D^-1 load``."""
    at, spans, _ = where
    out.fill(0)
    if i < len(spans):
        first, past = spans[i, 0] + 2, spans[i, 1] + 2
        here, there = at[i + 2] + first, at[i + 2] + past
        row, col = pair(out, first, past)
        vectors = pair(load, here, there), pair(inverse, here, there)
        _start_row(*vectors, mixed, here, scale, row, col)


@callee
def _begin_part(tissue, weights, mixed, where, out, start, pace, first, last):
    load, _, inverse, shape = tissue
    carry, unused = np.zeros((2, where[2]), load.dtype), np.zeros((2, where[2]), load.dtype)
    above, under = np.zeros_like(carry), np.zeros_like(carry)
    top = max(first - 1, 0)
    _start(load, inverse, mixed, start, where, top, above)
    for i in range(top, last):
        _start(load, inverse, mixed, start, where, i + 1, under)
        column, here, _, count = place(where, i)
        if count > 0:
            past, until = here + count, column + count
            result = pair(out, here, past) if i >= first else pair(unused, column, until)
            d, d_under = pair(above, column, until), pair(under, column, until)
            rows, carried = (d[0], d_under[0], d[1], d_under[1]), pair(carry, column, until)
            about = _tissue_row(tissue, weights, here, past)
            _smooth_row(rows, *about, mixed, here, shape, carried, pace, result)
        above, under = under, above


@parallel
def begin(
    thread,
    load,
    lame,
    inverse,
    weight,
    springs,
    mixed,
    shape,
    where,
    out,
    start,
    scale,
    ahead,
    back,
    count,
):
    """Compute the first two Chebyshev steps from zero.

    The first step is ``start * D^-1 load``; the second step is `smooth` applied to the first.
    """
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(where[1]))
        tissue, pace = (load, lame, inverse, shape), (scale, ahead, back)
        _begin_part(tissue, (weight, springs), mixed, where, out, start, pace, first, last)


@disjoint_callee
def _rest_row(rows, load, lame, inverse, weights, mixed, here, shape, carry, out):
    d_row, _, d_col, _ = rows
    out_row, out_col = out
    left = left_of(rows, lame, shape, 0)
    for k in range(len(d_row) - 2):
        j = k + 1
        row, col, left = row_force(rows, lame, shape, carry, left, j)
        row, col = left_over(row, col, (d_row, d_col), load, weights, j)
        if mixed is not None:
            row -= mixed[0, here + j] * d_col[j]
            col -= mixed[0, here + j] * d_row[j]
            blocks = pair(mixed, here, here + len(d_row))
            row, col = filtered(row, col, inverse, weights[0], blocks, j)
        out_row[j] = row if inverse[0][j] > float32(0) else row - row
        out_col[j] = col if inverse[1][j] > float32(0) else col - col


@callee
def _leave_part(d, tissue, weights, mixed, where, coarse, of_coarse, columns, first, last):
    """Compute the coarse rows `first` to `last` (exclusive) of `leave`.

    A coarse row depends on three fine rows. One more row above them is required to fill `carry`.
    """
    carry, rest = np.zeros((2, where[2]), d.dtype), np.zeros((3, 2, where[2]), d.dtype)
    for i in range(max(2 * first - 2, 0), 2 * last):
        row = rest[i % 3]
        row.fill(0)
        column, here, below, count = place(where, i) if i < len(where[1]) else (0, 0, 0, 0)
        if count > 0:
            until = column + count
            about = _tissue_row(tissue, weights, here, here + count)
            rows, carried = rows_of(d, here, below, count), pair(carry, column, until)
            out = pair(row, column, until)
            _rest_row(rows, *about, mixed, here, tissue[3], carried, out)
        if i % 2 == 1 and i > 2 * first:
            begin, past = columns[i // 2 + 2, 0] + 2, columns[i // 2 + 2, 1] + 2
            start = of_coarse[i // 2 + 2]
            for k in range(2):
                restrict_row(
                    rest[(i - 2) % 3, k, 2 * begin - 3 :],
                    rest[(i - 1) % 3, k, 2 * begin - 3 :],
                    row[k, 2 * begin - 3 :],
                    coarse[k, start + begin : start + past],
                )


@disjoint_parallel
def leave(
    thread,
    d,
    load,
    lame,
    inverse,
    weight,
    springs,
    mixed,
    shape,
    where,
    coarse,
    of_coarse,
    columns,
    count,
):
    """Restrict the residual to `coarse`: load - (A + W) d, or 0 at fixed components.

    With a data term, the residual is filtered (`data_weights`). `of_coarse` is the table of coarse
    rows, and `columns` contains the columns of each that are written.
    """
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(of_coarse) - 4)
        tissue, weights = (load, lame, inverse, shape), (weight, springs)
        _leave_part(d, tissue, weights, mixed, where, coarse, of_coarse, columns, first, last)


@parallel
def interpolate(thread, coarse, of_coarse, fine, inverse, where):
    """Compute `vectors.interpolate` within the spans of the fine rows."""
    at, spans, _ = where
    for i in portion(thread, len(spans)):
        begin, past = spans[i, 0], spans[i, 1]
        if past > begin:
            begin -= begin % 2
            near, far = i // 2 + 2, i // 2 + 2 + i % 2
            first, here = begin // 2 + 2, at[i + 2] + begin + 2
            pairs = (past - begin + 1) // 2
            there = here + 2 * pairs
            one, other = of_coarse[near] + first, of_coarse[far] + first
            for k in range(2):
                interpolate_row(
                    coarse[k, one : one + pairs + 1],
                    coarse[k, other : other + pairs + 1],
                    inverse[k, here:there],
                    fine[k, here:there],
                )
