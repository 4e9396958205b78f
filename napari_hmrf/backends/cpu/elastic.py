"""Multigrid for elastic tissue as compiled loops.

Arrays are padded as those of the other kernels are, by two sites of void. An element has the number
of its first site (least row and col), and its Lame parameters are 0 where one of its sites is void.
A site that is prescribed, or in no element, has an inverse diagonal of 0: its correction stays 0.

Forces are built from differences of displacement within an element; `napari_hmrf.priors.elastic`
has the equations and the names.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from typing import Any

import numba
from numba import float32, prange

_ARITHMETIC = {"contract", "nsz"}
_inline = numba.njit(inline="always", error_model="numpy")
_parallel = numba.njit(
    cache=True, nogil=True, error_model="numpy", parallel=True, fastmath=_ARITHMETIC
)
_reduction = numba.njit(cache=True, nogil=True, fastmath={"reassoc", "nsz"})


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
    first = lame[0, i, j]
    shear = lame[1, i, j]
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


@_reduction
def _row_product(a: Any, b: Any, row: int) -> float:
    total = float32(0)
    for component in range(2):
        for j in range(a.shape[2]):
            total += a[component, row, j] * b[component, row, j]
    return total


@_parallel
def residual(d, load, lame, inverse, weight, shape, spans, out):
    """Out = load - (A + W) d, and 0 at sites that do not move; `weight` is W's diagonal or None."""
    for i in prange(d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k
            row, col = _force(d, lame, shape, i + 2, j + 2)
            if weight is not None:
                row += weight[0, i + 2, j + 2] * d[0, i + 2, j + 2]
                col += weight[1, i + 2, j + 2] * d[1, i + 2, j + 2]
            row = load[0, i + 2, j + 2] - row
            col = load[1, i + 2, j + 2] - col
            out[0, i + 2, j + 2] = row if inverse[0, i + 2, j + 2] > float32(0) else row - row
            out[1, i + 2, j + 2] = col if inverse[1, i + 2, j + 2] > float32(0) else col - col


@_parallel
def work(d, lame, shape, row_totals):
    """The product of d and its forces, row by row: twice the energy."""
    for i in prange(d.shape[1] - 4):
        total = 0.0
        for j in range(d.shape[2] - 4):
            row, col = _force(d, lame, shape, i + 2, j + 2)
            total += row * d[0, i + 2, j + 2] + col * d[1, i + 2, j + 2]
        row_totals[i] = total


@_parallel
def apply(d, lame, inverse, shape, spans, out, row_totals):
    """Out = A d where sites move, 0 elsewhere; `row_totals` gets the product of d and out."""
    for i in prange(d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k
            row, col = _force(d, lame, shape, i + 2, j + 2)
            out[0, i + 2, j + 2] = row if inverse[0, i + 2, j + 2] > float32(0) else float32(0)
            out[1, i + 2, j + 2] = col if inverse[1, i + 2, j + 2] > float32(0) else float32(0)
        row_totals[i] = _row_product(d, out, i + 2)


@_parallel
def smooth_first(load, inverse, step, d, scale):
    """The first Chebyshev step from d = 0: step = d = scale * D^-1 load."""
    for i in prange(load.shape[1] - 4):
        for j in range(load.shape[2]):
            row = scale * inverse[0, i + 2, j] * load[0, i + 2, j]
            col = scale * inverse[1, i + 2, j] * load[1, i + 2, j]
            step[0, i + 2, j] = row
            step[1, i + 2, j] = col
            d[0, i + 2, j] = row
            d[1, i + 2, j] = col


@_parallel
def smooth(d, load, lame, inverse, weight, shape, spans, step, out, scale, momentum):
    """A Chebyshev step: step = scale D^-1 (load - (A + W) d) + momentum step, out = d + step."""
    for i in prange(d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k
            row, col = _force(d, lame, shape, i + 2, j + 2)
            if weight is not None:
                row += weight[0, i + 2, j + 2] * d[0, i + 2, j + 2]
                col += weight[1, i + 2, j + 2] * d[1, i + 2, j + 2]
            row = scale * inverse[0, i + 2, j + 2] * (load[0, i + 2, j + 2] - row)
            col = scale * inverse[1, i + 2, j + 2] * (load[1, i + 2, j + 2] - col)
            row += momentum * step[0, i + 2, j + 2]
            col += momentum * step[1, i + 2, j + 2]
            step[0, i + 2, j + 2] = row
            step[1, i + 2, j + 2] = col
            out[0, i + 2, j + 2] = d[0, i + 2, j + 2] + row
            out[1, i + 2, j + 2] = d[1, i + 2, j + 2] + col


@_parallel
def restrict(fine, coarse):
    """The transpose of `interpolate`: coarse site i lies on fine site 2 i."""
    for i in prange(coarse.shape[1] - 4):
        above, here, below = 2 * i + 1, 2 * i + 2, 2 * i + 3
        for component in range(2):
            for j in range(coarse.shape[2] - 4):
                left = (
                    fine[component, here, 2 * j + 1]
                    + float32(0.5) * fine[component, above, 2 * j + 1]
                    + float32(0.5) * fine[component, below, 2 * j + 1]
                )
                middle = (
                    fine[component, here, 2 * j + 2]
                    + float32(0.5) * fine[component, above, 2 * j + 2]
                    + float32(0.5) * fine[component, below, 2 * j + 2]
                )
                right = (
                    fine[component, here, 2 * j + 3]
                    + float32(0.5) * fine[component, above, 2 * j + 3]
                    + float32(0.5) * fine[component, below, 2 * j + 3]
                )
                coarse[component, i + 2, j + 2] = middle + float32(0.5) * (left + right)


@_parallel
def interpolate(coarse, fine, inverse):
    """Add a coarse correction, bilinear, to the sites that move."""
    for i in prange(fine.shape[1] - 4):
        near = i // 2 + 2
        far = near + i % 2
        for component in range(2):
            for j in range((fine.shape[2] - 3) // 2):
                here = coarse[component, near, j + 2] + coarse[component, far, j + 2]
                after = coarse[component, near, j + 3] + coarse[component, far, j + 3]
                here *= float32(0.5)
                between = float32(0.5) * here + float32(0.25) * after
                moves = inverse[component, i + 2, 2 * j + 2] > float32(0)
                fine[component, i + 2, 2 * j + 2] += here if moves else float32(0)
                moves = inverse[component, i + 2, 2 * j + 3] > float32(0)
                fine[component, i + 2, 2 * j + 3] += between if moves else float32(0)


@_parallel
def advance(d, rest, direction, image, length, row_totals):
    """D += length * direction, rest -= length * image; `row_totals` gets the square of the rest."""
    for i in prange(d.shape[1] - 4):
        for component in range(2):
            for j in range(d.shape[2]):
                d[component, i + 2, j] += length * direction[component, i + 2, j]
                rest[component, i + 2, j] -= length * image[component, i + 2, j]
        row_totals[i] = _row_product(rest, rest, i + 2)


@_parallel
def turn(steepest, direction, share):
    """Direction = steepest + share * direction."""
    for i in prange(direction.shape[1] - 4):
        for component in range(2):
            for j in range(direction.shape[2]):
                direction[component, i + 2, j] = (
                    steepest[component, i + 2, j] + share * direction[component, i + 2, j]
                )


@_parallel
def product(a, b, row_totals):
    """The scalar product, row by row."""
    for i in prange(a.shape[1] - 4):
        row_totals[i] = _row_product(a, b, i + 2)
