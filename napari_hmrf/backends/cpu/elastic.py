"""The forces of elastic tissue as compiled loops.

Arrays are padded as those of the other kernels are, by two sites of void. An element has the number
of its first site (least row and col), and its Lame parameters are 0 where one of its sites is void.
A site that is prescribed, or in no element, has an inverse diagonal of 0: its correction stays 0.

Forces are built from differences of displacement within an element; `napari_hmrf.priors.elastic`
has the equations and the names.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numba
from numba import float32, prange

from napari_hmrf.backends.cpu.vectors import row_largest, row_product

_ARITHMETIC = {"contract", "nsz"}
_inline = numba.njit(inline="always", error_model="numpy")
_parallel = numba.njit(
    cache=True, nogil=True, error_model="numpy", parallel=True, fastmath=_ARITHMETIC
)


@_inline
def _pulls(d, lame, shape, i, j):
    """What the differences D_r, D_c, D_x of element (i, j) pull with, for either component."""
    rows, cols, mixed = shape[0], shape[1], shape[2]
    twist_rows, twist_cols, twist_volume = shape[3], shape[4], shape[5]
    left = d[0, i + 1, j] - d[0, i, j]
    right = d[0, i + 1, j + 1] - d[0, i, j + 1]
    rr = left + right
    xr = right - left
    cr = (d[0, i, j + 1] - d[0, i, j]) + (d[0, i + 1, j + 1] - d[0, i + 1, j])
    left = d[1, i + 1, j] - d[1, i, j]
    right = d[1, i + 1, j + 1] - d[1, i, j + 1]
    rc = left + right
    xc = right - left
    cc = (d[1, i, j + 1] - d[1, i, j]) + (d[1, i + 1, j + 1] - d[1, i + 1, j])
    # In double precision throughout, if the displacement is.
    first = d.dtype.type(lame[0, i, j])
    shear = d.dtype.type(lame[1, i, j])
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


@_inline
def _force(d, lame, shape, i, j):
    """What the four elements around site (i, j) pull at it: the stiffness matrix times d."""
    rr, cr, xr, rc, cc, xc = _pulls(d, lame, shape, i, j)
    row, col = xr - rr - cr, xc - rc - cc
    rr, cr, xr, rc, cc, xc = _pulls(d, lame, shape, i, j - 1)
    row, col = row + (cr - rr - xr), col + (cc - rc - xc)
    rr, cr, xr, rc, cc, xc = _pulls(d, lame, shape, i - 1, j)
    row, col = row + (rr - cr - xr), col + (rc - cc - xc)
    rr, cr, xr, rc, cc, xc = _pulls(d, lame, shape, i - 1, j - 1)
    return row + (rr + cr + xr), col + (rc + cc + xc)


@_inline
def rest(d, load, lame, weight, shape, i, j):
    """Load - (A + W) d at site (i, j); `weight`, W's diagonal, and load may be None, zero."""
    row, col = _force(d, lame, shape, i, j)
    if weight is not None:
        row += weight[0, i, j] * d[0, i, j]
        col += weight[1, i, j] * d[1, i, j]
    if load is not None:
        return load[0, i, j] - row, load[1, i, j] - col
    return -row, -col


@_parallel
def residual(d, load, lame, inverse, weight, shape, spans, out):
    """Out = load - (A + W) d, and 0 at sites that do not move."""
    for i in prange(d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k + 2
            row, col = rest(d, load, lame, weight, shape, i + 2, j)
            out[0, i + 2, j] = row if inverse[0, i + 2, j] > float32(0) else row - row
            out[1, i + 2, j] = col if inverse[1, i + 2, j] > float32(0) else col - col


@_parallel
def balance(d, load, lame, inverse, shape, spans, share, out, row_most, row_squares):
    """Out = share (load - A d) in single precision, and 0 at sites that do not move.

    Its largest absolute value and its square are returned row by row.
    """
    for i in prange(d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k + 2
            row, col = rest(d, load, lame, None, shape, i + 2, j)
            row, col = float32(share * row), float32(share * col)
            out[0, i + 2, j] = row if inverse[0, i + 2, j] > float32(0) else row - row
            out[1, i + 2, j] = col if inverse[1, i + 2, j] > float32(0) else col - col
        row_most[i] = row_largest(out, i + 2)
        row_squares[i] = row_product(out, out, i + 2)


@numba.njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _row_work(d, lame, shape, i):
    """A row's product of displacement and forces, and the square of these."""
    product, square = 0.0, 0.0
    for k in range(d.shape[2] - 4):
        j = k + 2
        row, col = _force(d, lame, shape, i, j)
        product += d[0, i, j] * row + d[1, i, j] * col
        square += row * row + col * col
    return product, square


@_parallel
def work(d, lame, shape, row_products, row_squares):
    """The product of a displacement and A times it, and the square of that, by rows."""
    for i in prange(d.shape[1] - 4):
        row_products[i], row_squares[i] = _row_work(d, lame, shape, i + 2)


@_parallel
def pull(d, lame, shape, out):
    """Out = - A d everywhere."""
    for i in prange(d.shape[1] - 4):
        for k in range(d.shape[2] - 4):
            j = k + 2
            row, col = _force(d, lame, shape, i + 2, j)
            out[0, i + 2, j] = -row
            out[1, i + 2, j] = -col


@_parallel
def apply(d, lame, inverse, shape, spans, out, row_totals):
    """Out = A d where sites move, 0 elsewhere; `row_totals` gets the product of d and out."""
    for i in prange(d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k + 2
            row, col = _force(d, lame, shape, i + 2, j)
            out[0, i + 2, j] = row if inverse[0, i + 2, j] > float32(0) else float32(0)
            out[1, i + 2, j] = col if inverse[1, i + 2, j] > float32(0) else float32(0)
        row_totals[i] = row_product(d, out, i + 2)


@_parallel
def smooth(d, load, lame, inverse, weight, shape, spans, out, scale, ahead, back):
    """A Chebyshev step: out = d + scale D^-1 (load - (A + W) d) + ahead d - back out.

    What `out` holds before is the displacement before the last step: d - out was that step.
    """
    for i in prange(d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k + 2
            row, col = rest(d, load, lame, weight, shape, i + 2, j)
            row = scale * inverse[0, i + 2, j] * row + ahead * d[0, i + 2, j]
            col = scale * inverse[1, i + 2, j] * col + ahead * d[1, i + 2, j]
            row -= back * out[0, i + 2, j]
            col -= back * out[1, i + 2, j]
            out[0, i + 2, j] = d[0, i + 2, j] + row
            out[1, i + 2, j] = d[1, i + 2, j] + col
