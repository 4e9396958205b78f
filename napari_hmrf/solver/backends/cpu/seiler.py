"""Compiled loops for the linear model of the paper's cliques.

All arrays have a border of void, two sites wide. `stiffness` is (m, 1/m), and 0 in void. `lines`
contains the weight of each line of cliques for each component; None selects the faster kernels for
square pixels. `blanket` is True if the energy of a site includes all cliques that contain the site,
otherwise None. With True, `lines` is required, and numba compiles special kernels. `weight` is the
diagonal of the springs W of a coarse level. It is multiplied by `springs`, which is 0 on the finest
level and 1 on the other levels.

With centred cliques, where the energy of a site includes only the cliques centred at the site, the
model is A d = d - q(d): the distance of a site from the minimum of its local energy. The diagonal
of A is 1. With blanket cliques, A d is half the gradient of the clique energy in U_total; doubled
`lines` yield the full gradient. Both models are computed from differences between displacements.
`inverse` is the reciprocal of the diagonal with springs, and 0 where a component does not move.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from numba import float32

from napari_hmrf.solver.backends.cpu.compiled import disjoint_parallel, inline, parallel, portion
from napari_hmrf.solver.backends.cpu.kernels import (
    around,
    middle_curvature,
    ratios,
    square,
    weighted,
)
from napari_hmrf.solver.backends.cpu.vectors import row_largest, row_product

_TINY = float32(1e-30)
# Step (rows, columns) from a site to the next site on each line.
_ALONG = ((1, 0), (0, 1), (1, 1), (1, -1))


@inline
def _pull(d, stiffness, lines, blanket, i, j):
    """Return the force -A d at site (i + 2, j + 2)."""
    if blanket is not None:
        _, _, b0, b1, _ = around(d, stiffness, lines, i, j)
    else:
        a0, a1, b0, b1, _ = weighted(d, stiffness, lines, i, j)
        b0, b1 = b0 / max(a0, _TINY), b1 / max(a1, _TINY)
    return b0, b1


@inline
def _quick_pull(d, stiffness, lines, blanket, i, j):
    """Return the same force as `_pull`, with a faster kernel for square pixels."""
    if lines is None:
        a0, a1, b0, b1, _ = square(d, stiffness, i, j)
        b0, b1 = b0 / max(a0, _TINY), b1 / max(a1, _TINY)
    else:
        b0, b1 = _pull(d, stiffness, lines, blanket, i, j)
    return b0, b1


@inline
def _rest(d, load, given, stiffness, weight, springs, lines, blanket, i, j):
    """Return ``given * load - (A + W) d`` at site (i + 2, j + 2)."""
    row, col = _quick_pull(d, stiffness, lines, blanket, i, j)
    row += given * load[0, i + 2, j + 2] - springs * weight[0, i + 2, j + 2] * d[0, i + 2, j + 2]
    col += given * load[1, i + 2, j + 2] - springs * weight[1, i + 2, j + 2] * d[1, i + 2, j + 2]
    return row, col


@disjoint_parallel
def residual(
    thread, d, load, given, stiffness, inverse, weight, springs, lines, blanket, spans, share, out,
    row_totals,
):  # fmt: skip
    """Write ``share * (given * load - (A + W) d)`` to `out`, or 0 at fixed components.

    Also store the scalar product d . out of each row in `row_totals`, unless it is empty.
    """
    for i in portion(thread, d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k
            row, col = _rest(d, load, given, stiffness, weight, springs, lines, blanket, i, j)
            row, col = share * row, share * col
            out[0, i + 2, j + 2] = row if inverse[0, i + 2, j + 2] > float32(0) else row - row
            out[1, i + 2, j + 2] = col if inverse[1, i + 2, j + 2] > float32(0) else col - col
        if len(row_totals) > 0:
            row_totals[i] = row_product(d, out, i + 2)


@disjoint_parallel
def pull(thread, d, stiffness, lines, blanket, spans, out):
    """Write -A d to `out` within the spans; square pixels also require `lines`."""
    for i in portion(thread, d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k
            row, col = _pull(d, stiffness, lines, blanket, i, j)
            out[0, i + 2, j + 2] = row
            out[1, i + 2, j + 2] = col


@disjoint_parallel
def balance(thread, pulls, load, given, inverse, share, out, row_most, row_squares):
    """Write ``share * (pulls + given * load)`` to `out` in float32, or 0 at fixed components.

    On return, `row_most` contains the largest absolute value of each row, and `row_squares` the sum
    of its squares.
    """
    for number in portion(thread, out.shape[1] - 4):
        i = number + 2
        for component in range(len(out)):
            for j in range(out.shape[2]):
                here = pulls[component, i, j] + given * load[component, i, j]
                here = float32(share * here)
                moves = inverse[component, i, j] > float32(0)
                out[component, i, j] = here if moves else here - here
        row_most[number] = row_largest(out, i)
        row_squares[number] = row_product(out, out, i)


@disjoint_parallel
def smooth(
    thread,
    d,
    load,
    stiffness,
    inverse,
    weight,
    springs,
    lines,
    blanket,
    spans,
    step,
    out,
    scale,
    momentum,
):
    """Compute a Chebyshev step and the displacement ``out = d + step``.

    The step is ``step = scale * D^-1 (load - (A + W) d) + momentum * step``.
    """
    for i in portion(thread, d.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k
            row, col = _rest(d, load, float32(1), stiffness, weight, springs, lines, blanket, i, j)
            row = scale * inverse[0, i + 2, j + 2] * row + momentum * step[0, i + 2, j + 2]
            col = scale * inverse[1, i + 2, j + 2] * col + momentum * step[1, i + 2, j + 2]
            step[0, i + 2, j + 2] = row
            step[1, i + 2, j + 2] = col
            out[0, i + 2, j + 2] = d[0, i + 2, j + 2] + row
            out[1, i + 2, j + 2] = d[1, i + 2, j + 2] + col


@parallel
def curvature(thread, stiffness, lines, blanket, out):
    """Compute the curvature of each site's cliques; square pixels also require `lines`."""
    for number in portion(thread, out.shape[1] - 4):
        i = number + 2
        for k in range(out.shape[2] - 4):
            j = k + 2
            a0, a1 = float32(0), float32(0)
            for line in range(4):
                row, col = _ALONG[line]
                s, u, exists = ratios(stiffness, i - row, j - col, i, j, i + row, j + col)
                a = exists * middle_curvature(s, u)
                if blanket:
                    for _ in range(2):
                        _, u, exists = ratios(
                            stiffness, i, j, i + row, j + col, i + 2 * row, j + 2 * col
                        )
                        a += exists * (u * u + float32(1))
                        row, col = -row, -col
                a0 += lines[line, 0] * a
                a1 += lines[line, 1] * a
            out[0, i, j] = a0
            out[1, i, j] = a1


@disjoint_parallel
def coarsen(thread, fine, coarse, even):
    """Compute the stiffness of coarse sites as the weighted mean of the tissue around them.

    A coarse site without tissue around it is void. On return, `even` contains the factor that
    scales a sum over the tissue around a site to a sum over complete surroundings.
    """
    for i in portion(thread, coarse.shape[1] - 4):
        for j in range(coarse.shape[2] - 4):
            total, share = float32(0), float32(0)
            for a in range(3):
                for b in range(3):
                    m = fine[0, 2 * i + 1 + a, 2 * j + 1 + b]
                    near = float32((2 - abs(a - 1)) * (2 - abs(b - 1))) * float32(0.25)
                    total += near * m
                    share += near if m > float32(0) else float32(0)
            coarse[0, i + 2, j + 2] = total / share if total > float32(0) else float32(0)
            coarse[1, i + 2, j + 2] = share / total if total > float32(0) else float32(0)
            even[i + 2, j + 2] = float32(4) / max(share, float32(1))


@disjoint_parallel
def even_out(thread, load, even):
    """Multiply each component of a load by `even`, in place."""
    for i in portion(thread, load.shape[1] - 4):
        for k in range(2):
            for j in range(load.shape[2]):
                load[k, i + 2, j] *= even[i + 2, j]
