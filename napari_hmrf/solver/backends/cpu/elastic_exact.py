"""Compiled loops in double precision: residual, energy and forces of elastic tissue.

Arrays and threads are used as in `backends.cpu.elastic`, but displacement, load, Lame parameters
and data are planes in double precision, and `where` contains the table of their rows. These loops
evaluate the convergence criterion.
"""

# mypy: disable-error-code="no-untyped-def, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32

from napari_hmrf.solver.backends.cpu.compiled import (
    bounds_of_part,
    callee,
    contracted_reduction,
    disjoint,
    disjoint_callee,
    disjoint_parallel,
    parallel,
    portion,
    shared,
)
from napari_hmrf.solver.backends.cpu.forces import left_of, pair, place, row_force, rows_of
from napari_hmrf.solver.backends.cpu.vectors import line_largest, line_product


@shared
def _with_data(row, col, d, data, j, at):
    """Add the force W d of the data term to the force (row, col) at a site.

    `j` is the index of the site in the rows `d`, and `at` its index in `data`.
    """
    x, y = d[0][j], d[1][j]
    row += data[0, at] * x + data[2, at] * y
    col += data[2, at] * x + data[1, at] * y
    return row, col


@disjoint_callee
def _balance_row(rows, load, given, lame, inverse, data, here, shape, carry, share, out):
    pull_row, pull_col = load
    out_row, out_col = out
    left = left_of(rows, lame, shape, 0)
    for k in range(len(rows[0]) - 2):
        j = k + 1
        row, col, left = row_force(rows, lame, shape, carry, left, j)
        if data is not None:
            row, col = _with_data(row, col, (rows[0], rows[2]), data, j, here + j)
        row, col = given * pull_row[j] - row, given * pull_col[j] - col
        row, col = float32(share * row), float32(share * col)
        out_row[j] = row if inverse[0][j] > float32(0) else row - row
        out_col[j] = col if inverse[1][j] > float32(0) else col - col


@callee
def _balance_part(
    d, load, given, tissue, data, where, of_out, share, out, row_most, row_squares, first, last
):
    lame, inverse, shape = tissue
    carry, unused = np.zeros((2, where[2]), d.dtype), np.zeros((2, where[2]), out.dtype)
    for i in range(max(first - 1, 0), last):
        column, here, below, count = place(where, i)
        if i >= first:
            row_most[i], row_squares[i] = 0, 0
        if count == 0:
            continue
        past, until, there = here + count, column + count, of_out[i + 2] + column
        own = pair(out, there, there + count) if i >= first else pair(unused, column, until)
        rows, carried = rows_of(d, here, below, count), pair(carry, column, until)
        about = pair(lame, here, past), pair(inverse, there, there + count), data, here, shape
        _balance_row(rows, pair(load, here, past), given, *about, carried, share, own)
        if i >= first:
            most = max(line_largest(own[0]), line_largest(own[1]))
            row_most[i] = np.int32(most).view(np.float32)
            row_squares[i] = line_product(own[0], own[0]) + line_product(own[1], own[1])


@parallel
def balance(
    thread,
    d,
    load,
    given,
    lame,
    data,
    where,
    inverse,
    of_out,
    shape,
    share,
    out,
    row_most,
    row_squares,
    count,
):
    """Write ``share * (given * load - A d)`` to `out` in float32, or 0 at fixed components.

    `data` contains the tensors of the data term, which are part of A, or is None. `of_out` is the
    table of rows of `out` and `inverse`.

    On return, `row_most` contains the largest absolute value of each row, and `row_squares` the sum
    of its squares.
    """
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(where[1]))
        tissue = lame, inverse, shape
        _balance_part(
            d,
            load,
            given,
            tissue,
            data,
            where,
            of_out,
            share,
            out,
            row_most,
            row_squares,
            first,
            last,
        )


@contracted_reduction
def _work_row(rows, lame, data, here, shape, carry):
    """Return the contributions of one row to d . A d and ||A d||^2."""
    d = rows[0], rows[2]
    product, square = 0.0, 0.0
    left = left_of(rows, lame, shape, 0)
    for k in range(len(rows[0]) - 2):
        j = k + 1
        row, col, left = row_force(rows, lame, shape, carry, left, j)
        if data is not None:
            row, col = _with_data(row, col, d, data, j, here + j)
        product += d[0][j] * row + d[1][j] * col
        square += row * row + col * col
    return product, square


@callee
def _work_part(d, lame, data, shape, where, row_products, row_squares, first, last):
    carry = np.zeros((2, where[2]), d.dtype)
    for i in range(max(first - 1, 0), last):
        column, here, below, count = place(where, i)
        rows, moduli = rows_of(d, here, below, count), pair(lame, here, here + count)
        carried = pair(carry, column, column + count)
        product, square = _work_row(rows, moduli, data, here, shape, carried)
        if i >= first:
            row_products[i], row_squares[i] = product, square


@disjoint_parallel
def work(thread, d, lame, data, shape, where, row_products, row_squares, count):
    """Compute the contributions of each row to d . A d and ||A d||^2.

    `data` contains the tensors of the data term, which are part of A, or is None.
    """
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(row_products))
        _work_part(d, lame, data, shape, where, row_products, row_squares, first, last)


@disjoint_callee
def _pull_row(rows, lame, shape, carry, out):
    out_row, out_col = out
    left = left_of(rows, lame, shape, 0)
    for k in range(len(out_row) - 2):
        row, col, left = row_force(rows, lame, shape, carry, left, k + 1)
        out_row[k + 1] = -row
        out_col[k + 1] = -col


@callee
def _pull_part(d, lame, shape, where, out, first, last):
    carry, unused = np.zeros((2, where[2]), d.dtype), np.zeros((2, where[2]), d.dtype)
    for i in range(max(first - 1, 0), last):
        column, here, below, count = place(where, i)
        past, until = here + count, column + count
        own = pair(out, here, past) if i >= first else pair(unused, column, until)
        rows, moduli = rows_of(d, here, below, count), pair(lame, here, past)
        _pull_row(rows, moduli, shape, pair(carry, column, until), own)


@parallel
def pull(thread, d, lame, shape, where, out, count):
    """Write -A d to `out`, including its values at prescribed components."""
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(where[1]))
        _pull_part(d, lame, shape, where, out, first, last)


@disjoint
def _spread(values, row, col):
    """Copy a line of values, with the components of each site side by side, to two lines."""
    for j in range(len(values) // 2):
        row[j] = values[2 * j]
        col[j] = values[2 * j + 1]


@disjoint
def _rest_line(force, load, given, moves, out):
    for j in range(len(out)):
        rest = float32(given * load[j] + force[j])
        out[j] = rest if moves[j] else rest - rest


@callee
def _review_part(values, load, given, lame, moves, where, shape, totals, first, last):
    sites = slice(2, 2 + values.shape[1] // 2)
    lines, forces, carry = np.zeros((4, where[2])), np.zeros((2, where[2])), np.zeros((2, where[2]))
    rest = np.zeros((2, where[2]), np.float32)
    begin = max(first - 1, 0)
    _spread(values[begin], lines[2, sites], lines[3, sites])
    for i in range(begin, last):
        lines[:2] = lines[2:]
        if i + 1 < len(values):
            _spread(values[i + 1], lines[2, sites], lines[3, sites])
        else:
            lines[2:] = 0
        column, here, _, count = place(where, i)
        if i >= first:
            totals[:, i] = 0
        if count == 0:
            continue
        past, until = here + count, column + count
        (row, col), below = pair(lines, column, until), pair(lines[2:], column, until)
        rows, moduli = (row, below[0], col, below[1]), pair(lame, here, past)
        carried, force = pair(carry, column, until), pair(forces, column, until)
        _pull_row(rows, moduli, shape, carried, force)
        if i < first:
            continue
        most = np.int32(0)
        for k in range(2):
            inner, line = forces[k, column + 1 : until - 1], lines[k, column + 1 : until - 1]
            pull = load[k, here + 1 : past - 1] if given != 0 else inner
            left = rest[k, column + 1 : until - 1]
            _rest_line(inner, pull, given, moves[k, here + 1 : past - 1], left)
            most = max(most, line_largest(left))
            totals[1, i] += line_product(left, left)
            totals[2, i] -= line_product(line, inner)
            totals[3, i] += line_product(inner, inner)
            if given != 0:
                totals[4, i] += line_product(line, pull)
        totals[0, i] = np.int32(most).view(np.float32)
        totals[5, i] = np.int32(line_largest(values[i])).view(np.float32)


@parallel
def review(thread, values, load, given, lame, moves, where, shape, totals, count):
    """Compute what decides whether a displacement in single precision is a solution.

    `values` has shape (H, 2 W), with the components of each site side by side, and is 0 outside the
    spans in `where`, which contain all tissue. `moves` is True at free components. Column i of
    `totals` is for row i of sites: 0 and 1 the largest absolute value and the sum of squares of
    ``given * load - A d`` at free components; 2 d . A d; 3 ||A d||^2; 4 load . d; 5 the largest
    absolute value of d.
    """
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(values))
        _review_part(values, load, given, lame, moves, where, shape, totals, first, last)
