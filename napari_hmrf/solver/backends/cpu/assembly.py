"""Compiled loops that assemble the multigrid levels of elastic tissue.

All arrays have a border of void, two sites wide. An element has the index of its first site
(smallest row and column), so site (i, j) is a corner of the elements (i - 1, j - 1) to (i, j).
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from numba import float32, float64

from napari_hmrf.solver.backends.cpu.compiled import disjoint, disjoint_parallel, parallel, portion
from napari_hmrf.solver.backends.cpu.forces import pair


@disjoint_parallel
def elements(thread, m, poisson, each, one, strain, scale, lame):
    """Compute the Lame parameters of each element from the means of its sites.

    The parameters are 0 for elements with a void site. If `one` is True, Poisson's ratio is
    `poisson` everywhere; otherwise `each` contains the ratio at each site. Lambda is computed for
    plane strain if `strain` is True, otherwise for plane stress. Ratios near 0.5 require double
    precision, because 1 - 2 nu loses digits.
    """
    for i in portion(thread, m.shape[0] - 1):
        for j in range(m.shape[1] - 1):
            a, b = float64(m[i, j]), float64(m[i, j + 1])
            c, d = float64(m[i + 1, j]), float64(m[i + 1, j + 1])
            if min(min(a, b), min(c, d)) > 0:
                young = scale * ((a + b) + (c + d))
                nu = poisson
                if not one:
                    above = float64(each[i, j]) + float64(each[i, j + 1])
                    below = float64(each[i + 1, j]) + float64(each[i + 1, j + 1])
                    nu = 0.25 * (above + below)
                shear = young / (2 + 2 * nu)
                beside = 1 - (nu + nu if strain else nu)
                lame[0, i + 2, j + 2] = 2 * shear * nu / beside
                lame[1, i + 2, j + 2] = shear
            else:
                lame[0, i + 2, j + 2] = 0
                lame[1, i + 2, j + 2] = 0


@disjoint_parallel
def coarsen(thread, fine, coarse):
    """Compute coarse parameters as the mean of four fine elements, where void counts as 0."""
    for i in portion(thread, coarse.shape[1] - 4):
        for k in range(2):
            for j in range(coarse.shape[2] - 4):
                a = fine[k, 2 * i + 2, 2 * j + 2] + fine[k, 2 * i + 2, 2 * j + 3]
                b = fine[k, 2 * i + 3, 2 * j + 2] + fine[k, 2 * i + 3, 2 * j + 3]
                coarse[k, i + 2, j + 2] = float32(0.25) * (a + b)


@disjoint
def _diagonal_row(above, here, shape, out):
    """Compute a row of `diagonal`; all rows begin one site before its first site."""
    first_above, shear_above = above
    first_here, shear_here = here
    out_row, out_col = out
    for k in range(len(out_row) - 1):
        j = k + 1
        first = (first_here[j] + first_here[k]) + (first_above[j] + first_above[k])
        shear = (shear_here[j] + shear_here[k]) + (shear_above[j] + shear_above[k])
        both, own = first + shear + shear, shape[5] * first + shear + shear
        row, col = shape[0] * both + shape[1] * shear, shape[1] * both + shape[0] * shear
        out_row[j] = row + shape[3] * own + shape[4] * shear
        out_col[j] = col + shape[4] * own + shape[3] * shear


@parallel
def diagonal(thread, lame, at, tissue, shape, out):
    """Compute the diagonal of the stiffness matrix in the columns `tissue` of each row.

    `lame` and `out` have shape (2, N), and `at` is their table of rows (`layout`).
    """
    for n in portion(thread, len(at) - 4):
        i = n + 2
        begin, past = tissue[i, 0] + 1, tissue[i, 1] + 2
        above = pair(lame, at[i - 1] + begin, at[i - 1] + past)
        here = pair(lame, at[i] + begin, at[i] + past)
        _diagonal_row(above, here, shape, pair(out, at[i] + begin, at[i] + past))
