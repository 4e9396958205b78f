"""The forces of elastic tissue, at one site, for the compiled loops of both precisions.

Arrays are padded as those of the other kernels are, by two sites of void. An element has the number
of its first site (least row and col), and its Lame parameters are 0 where one of its sites is void.
Forces are built from differences of displacement within an element; `solver.priors.elastic`
has the equations and the names.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from numba import get_num_threads, int64

from napari_hmrf.solver.backends.cpu.compiled import inline, shared

# A thread that gets fewer rows than this makes too much of what it shares with its neighbours.
_FEW_ROWS = 16


@inline
def _pulls(row, col, first, shear, shape):
    """Return the forces of the differences D_r, D_c, D_x of an element, for either component."""
    # Sites of the element, for each component: here, right, below, below right.
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
    """The pulls of element (i, j), in double precision throughout if the displacement is."""
    return _pulls(
        (d[0, i, j], d[0, i, j + 1], d[0, i + 1, j], d[0, i + 1, j + 1]),
        (d[1, i, j], d[1, i, j + 1], d[1, i + 1, j], d[1, i + 1, j + 1]),
        d.dtype.type(lame[0, i, j]),
        d.dtype.type(lame[1, i, j]),
        shape,
    )


@inline
def force(d, lame, shape, i, j):
    """Return the pull of the four elements around site (i, j): the stiffness matrix times d."""
    rr, cr, xr, rc, cc, xc = _element(d, lame, shape, i, j)
    row, col = xr - rr - cr, xc - rc - cc
    rr, cr, xr, rc, cc, xc = _element(d, lame, shape, i, j - 1)
    row, col = row + (cr - rr - xr), col + (cc - rc - xc)
    rr, cr, xr, rc, cc, xc = _element(d, lame, shape, i - 1, j)
    row, col = row + (rr - cr - xr), col + (rc - cc - xc)
    rr, cr, xr, rc, cc, xc = _element(d, lame, shape, i - 1, j - 1)
    return row + (rr + cr + xr), col + (rc + cc + xc)


@inline
def left_over(row, col, d_row, d_col, load, weights, i, j):
    """Return the rest of the load at site (i, j), displaced by d, after a force."""
    weight, springs = weights
    row += springs * weight[0, i, j] * d_row
    col += springs * weight[1, i, j] * d_col
    return load[0, i, j] - row, load[1, i, j] - col


@shared
def rest(d, load, lame, weight, shape, i, j):
    """Load - (A + W) d at site (i, j), whatever was looked at before."""
    row, col = force(d, lame, shape, i, j)
    row += weight[0, i, j] * d[0, i, j]
    col += weight[1, i, j] * d[1, i, j]
    return load[0, i, j] - row, load[1, i, j] - col


@shared
def left_of(rows, lame, shape, j):
    """Return the pulls of element j of a row, per component: D_r, and D_x less and plus D_c.

    `row_force` takes the others from the site before, and this for the first.
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
    """`force` at a row's site j, and what is `left` of the next.

    Each element is looked at once, and rows and sites in their order: what it pulls with at its
    right sites is kept for the next site, and what it pulls with at those below, in `carry`
    (2, W + 4), for the next row.

    Parameters
    ----------
    rows : tuple of 4 ndarrays, shape (W + 4,)
        The first component of displacement at the row's sites and at those below, and the second.
    lame : tuple of 2 ndarrays, shape (W + 4,)
        Of the elements between them.
    """
    r0, less0, more0, r1, less1, more1 = left
    right = left_of(rows, lame, shape, j)
    r2, less2, more2, r3, less3, more3 = right
    row = carry[0, j] + ((less2 - less0) - (r2 + r0))
    col = carry[1, j] + ((less3 - less1) - (r3 + r1))
    carry[0, j] = (r2 + r0) - (more2 - more0)
    carry[1, j] = (r3 + r1) - (more3 - more1)
    return row, col, right


@inline
def rows_of(d, i):
    """Return a row's sites and those below, of either component."""
    return d[0, i], d[0, i + 1], d[1, i], d[1, i + 1]


@inline
def moduli_of(lame, i):
    """Return Lame's parameters of the elements between both."""
    return lame[0, i], lame[1, i]


@inline
def reach(spans, i):
    """Return the begin and end of the moving sites of rows i and i + 1."""
    below = min(i + 1, len(spans) - 1)
    begin, past = spans[i, 0], spans[i, 1]
    if past == begin:
        begin, past = spans[below, 0], spans[below, 1]
    elif spans[below, 1] > spans[below, 0]:
        begin, past = min(begin, spans[below, 0]), max(past, spans[below, 1])
    return begin, past


def parts(height: int) -> int:
    """Return the number of threads for a level's rows."""
    return max(1, min(get_num_threads(), height // _FEW_ROWS))


@inline
def part(number, count, height):
    """Return the begin and end of the rows of one thread."""
    return int64(number) * height // count, (int64(number) + 1) * height // count
