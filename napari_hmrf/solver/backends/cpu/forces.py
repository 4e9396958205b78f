"""Forces of elastic tissue at a site, for the compiled loops in both precisions.

Planes have a border of void, two sites wide. An element has the index of its first site
(smallest row and column). Its Lame parameters are 0 if one of its sites is void. Forces are
computed from differences between displacements within an element; `solver.priors.elements`
documents the equations and the names.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from typing import Any

import numpy as np
from numba import get_num_threads

from napari_hmrf.solver.backends.cpu.compiled import (
    bounds_of_part,
    callee,
    disjoint,
    inline,
    portion,
    shared,
)

# Smallest number of rows per thread; with fewer rows, too many rows would be computed twice.
_FEW_ROWS = 16


@inline
def _pulls(row, col, first, shear, shape):
    """Return the derivatives of an element's energy with respect to D_r, D_c and D_x."""
    # `row` and `col` contain a component's values at the sites (0, 0), (0, 1), (1, 0) and (1, 1).
    rows, cols, mixed = shape[0], shape[1], shape[2]
    twist_rows, twist_cols, twist_volume = shape[3], shape[4], shape[5]
    left, right = row[2] - row[0], row[3] - row[1]
    rr, xr = left + right, right - left
    cr = (row[1] - row[0]) + (row[3] - row[2])
    left, right = col[2] - col[0], col[3] - col[1]
    rc, xc = left + right, right - left
    cc = (col[1] - col[0]) + (col[3] - col[2])
    both = first + shear + shear
    own = twist_volume * first + shear + shear
    return (
        rows * both * rr + mixed * first * cc,
        shear * (cols * cr + mixed * rc),
        (twist_rows * own + twist_cols * shear) * xr,
        shear * (rows * rc + mixed * cr),
        cols * both * cc + mixed * first * rr,
        (twist_cols * own + twist_rows * shear) * xc,
    )


@inline
def _element(d, lame, shape, i, j):
    """Return `_pulls` of element (i, j) in the precision of the displacement."""
    return _pulls(
        (d[0, i, j], d[0, i, j + 1], d[0, i + 1, j], d[0, i + 1, j + 1]),
        (d[1, i, j], d[1, i, j + 1], d[1, i + 1, j], d[1, i + 1, j + 1]),
        d.dtype.type(lame[0, i, j]),
        d.dtype.type(lame[1, i, j]),
        shape,
    )


@inline
def force(d, lame, shape, i, j):
    """Return the stiffness matrix times d at site (i, j), as a sum over its four elements."""
    rr, cr, xr, rc, cc, xc = _element(d, lame, shape, i, j)
    row, col = xr - rr - cr, xc - rc - cc
    rr, cr, xr, rc, cc, xc = _element(d, lame, shape, i, j - 1)
    row, col = row + (cr - rr - xr), col + (cc - rc - xc)
    rr, cr, xr, rc, cc, xc = _element(d, lame, shape, i - 1, j)
    row, col = row + (rr - cr - xr), col + (rc - cc - xc)
    rr, cr, xr, rc, cc, xc = _element(d, lame, shape, i - 1, j - 1)
    return row + (rr + cr + xr), col + (rc + cc + xc)


@inline
def left_over(row, col, d, load, weights, j):
    """Return ``load - force - springs * weight * d`` at site j of a row, for a force (row, col).

    `d`, `load` and `weight` are pairs of rows.
    """
    weight, springs = weights
    row += springs * weight[0][j] * d[0][j]
    col += springs * weight[1][j] * d[1][j]
    return load[0][j] - row, load[1][j] - col


@shared
def rest(d, load, lame, weight, shape, i, j):
    """Return load - (A + W) d at site (i, j)."""
    row, col = force(d, lame, shape, i, j)
    row += weight[0, i, j] * d[0, i, j]
    col += weight[1, i, j] * d[1, i, j]
    return load[0, i, j] - row, load[1, i, j] - col


@shared
def left_of(rows, lame, shape, j):
    """Return the derivatives of element j of a row: E_r, E_x - E_c and E_x + E_c.

    E_r, E_c and E_x are derivatives of the energy with respect to D_r, D_c and D_x. The three
    numbers are returned for each component. `row_force` requires the numbers of the first element
    of a row, and then passes them from site to site.
    """
    row, row_below, col, col_below = rows
    first, shear = lame
    rr, cr, xr, rc, cc, xc = _pulls(
        (row[j], row[j + 1], row_below[j], row_below[j + 1]),
        (col[j], col[j + 1], col_below[j], col_below[j + 1]),
        first[j],
        shear[j],
        shape,
    )
    return rr, xr - cr, xr + cr, rc, xc - cc, xc + cc


@shared
def row_force(rows, lame, shape, carry, left, j):
    """Return `force` at site j of a row, and the argument `left` for the next site.

    The sites are visited in order, so that each element is computed only once. The force of an
    element on its right sites is passed to the next site in `left`, and the force on its lower
    sites is passed to the next row in `carry`.

    Parameters
    ----------
    rows : tuple of 4 ndarrays, shape (N,)
        Row component of the displacement in this row and in the next row, followed by the column
        component in both rows.
    lame : tuple of 2 ndarrays, shape (N,)
        Lame parameters of the elements between the two rows.
    carry : tuple of 2 ndarrays, shape (N,)
        Forces of the elements above; overwritten with those for the next row.
    """
    r0, less0, more0, r1, less1, more1 = left
    right = left_of(rows, lame, shape, j)
    r2, less2, more2, r3, less3, more3 = right
    carry_row, carry_col = carry
    row = carry_row[j] + ((less2 - less0) - (r2 + r0))
    col = carry_col[j] + ((less3 - less1) - (r3 + r1))
    carry_row[j] = (r2 + r0) - (more2 - more0)
    carry_col[j] = (r3 + r1) - (more3 - more1)
    return row, col, right


@disjoint
def _gather(above, here, component, force):
    """Compute the forces of the elements around each site of a row, from two rows of derivatives.

    A row contains the six results of `left_of` for each element, shape (6, W + 4).
    """
    up_r, up_more = above[component, 1:], above[4 + component, 1:]
    r, less = here[component, 1:], here[2 + component, 1:]
    for x in range(len(force)):
        below = (less[x + 1] - less[x]) - (r[x + 1] + r[x])
        force[x] = below + ((up_r[x + 1] + up_r[x]) + (up_more[x] - up_more[x + 1]))


def site_sweep_of(derivatives: Any, finish: Any) -> Any:
    """Return a loop over the rows of sites from `first` to `last` (exclusive).

    Parameters
    ----------
    derivatives : callable
        Compiled function ``derivatives(d, model, i, out)`` that computes the derivatives of the
        energy of row i of elements; see `_gather`.
    finish : callable
        Compiled function ``finish(forces, d, about, i)`` that uses the forces of row i of sites,
        shape (2, W). The loop passes on `about`.
    """

    @callee
    def sweep(d, model, about, first, last):
        width = d.shape[2]
        above, here = np.zeros((6, width), d.dtype), np.zeros((6, width), d.dtype)
        forces = np.zeros((2, width - 4), d.dtype)
        derivatives(d, model, first - 1, above)
        for i in range(first, last):
            derivatives(d, model, i, here)
            for k in range(2):
                _gather(above, here, k, forces[k])
            finish(forces, d, about, i)
            above, here = here, above

    return sweep


@inline
def pair(values, begin, past):
    """Return the values of both components from index `begin` to `past` (exclusive)."""
    return values[0, begin:past], values[1, begin:past]


@inline
def rows_of(d, here, below, count):
    """Return `count` values of each component from the indices `here` and `below`."""
    return (
        d[0, here : here + count],
        d[0, below : below + count],
        d[1, here : here + count],
        d[1, below : below + count],
    )


@inline
def place(where, i):
    """Return the columns and indices that a kernel reads in rows i and i + 1.

    They are those of the combined span of moving sites, and of one more site on both sides. If the
    span is empty, the row may not store them, and the kernel must skip it.

    Parameters
    ----------
    where : tuple
        Table of rows (`layout`), spans of the rows, and width of a padded row.

    Returns
    -------
    column, here, below : int
        First column, and its index in both rows.
    count : int
        Number of columns; 0 if the span is empty.
    """
    at, spans, _ = where
    begin, past = reach(spans, i)
    column = begin + 1
    count = past - begin + 2 if past > begin else 0
    return column, at[i + 2] + column, at[i + 3] + column, count


@inline
def reach(spans, i):
    """Return the start and stop of the combined span of moving sites in rows i and i + 1."""
    below = min(i + 1, len(spans) - 1)
    begin, past = spans[i, 0], spans[i, 1]
    if past == begin:
        begin, past = spans[below, 0], spans[below, 1]
    elif spans[below, 1] > spans[below, 0]:
        begin, past = min(begin, spans[below, 0]), max(past, spans[below, 1])
    return begin, past


def parts(height: int) -> int:
    """Return the number of threads for a level with `height` rows."""
    return max(1, min(get_num_threads(), height // _FEW_ROWS))


@callee
def clear(thread, out):
    """Set one thread's planes of the vectors `out` to 0."""
    for i in portion(thread, out.shape[1]):
        out[:, i] = 0


@inline
def planes_of(thread, planes):
    """Return a thread's planes of elements, out of the planes of an array."""
    begin, end = bounds_of_part(thread[0], thread[1], planes - 4)
    return range(begin + 2, end + 2)


@inline
def planes_of_turn(thread, planes):
    """Return a thread's planes of elements in turn 1 or 2, out of the planes of an array."""
    odd = thread[2] - 1
    begin, end = bounds_of_part(thread[0], thread[1], (planes - 3 - odd) // 2)
    return range(2 * begin + odd + 2, 2 * end + odd + 2, 2)
