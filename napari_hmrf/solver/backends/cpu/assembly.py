"""What multigrid needs to know of elastic tissue, level by level, as compiled loops.

Arrays are padded by two sites of void. An element has the number of its first site (least row and
col), so that site (i, j) is a corner of the elements (i - 1, j - 1) to (i, j).
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from numba import float32, float64, prange

from napari_hmrf.solver.backends.cpu.compiled import inline, parallel
from napari_hmrf.solver.backends.cpu.vectors import span


@parallel
def elements(m, poisson, each, one, strain, scale, lame):
    """Lame's parameters of each element: of the means of its sites; 0 if one of them is void.

    Poisson's ratio is `poisson` everywhere if there is `one`, else each site's in `each`; lambda is
    that of plane stress or, if `strain`, of plane strain. In double precision: of 1 - 2 nu little
    is left where nu is 0.499.
    """
    for i in prange(m.shape[0] - 1):
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


@parallel
def coarsen(fine, coarse):
    """A coarse element's parameters: the mean of the four it covers, void counted as 0."""
    for i in prange(coarse.shape[1] - 4):
        for k in range(2):
            for j in range(coarse.shape[2] - 4):
                a = fine[k, 2 * i + 2, 2 * j + 2] + fine[k, 2 * i + 2, 2 * j + 3]
                b = fine[k, 2 * i + 3, 2 * j + 2] + fine[k, 2 * i + 3, 2 * j + 3]
                coarse[k, i + 2, j + 2] = float32(0.25) * (a + b)


@inline
def _diagonal(lame, shape, i, j):
    """The diagonal of the stiffness matrix at a site."""
    first = (lame[0, i, j] + lame[0, i, j - 1]) + (lame[0, i - 1, j] + lame[0, i - 1, j - 1])
    shear = (lame[1, i, j] + lame[1, i, j - 1]) + (lame[1, i - 1, j] + lame[1, i - 1, j - 1])
    both, own = first + shear + shear, shape[5] * first + shear + shear
    row = shape[0] * both + shape[1] * shear + shape[3] * own + shape[4] * shear
    col = shape[1] * both + shape[0] * shear + shape[4] * own + shape[3] * shear
    return row, col


@parallel
def diagonal(lame, shape, out):
    """The diagonal of the stiffness matrix."""
    for i in prange(lame.shape[1] - 4):
        for k in range(lame.shape[2] - 4):
            j = k + 2
            out[0, i + 2, j], out[1, i + 2, j] = _diagonal(lame, shape, i + 2, j)


@parallel
def hold(lame, shape, held, inverse, pins, spans):
    """The finest level's inverse diagonal, 0 where held; `pins` counts what is held: 1 or 0."""
    for i in prange(lame.shape[1] - 4):
        for k in range(lame.shape[2] - 4):
            j = k + 2
            row, col = _diagonal(lame, shape, i + 2, j)
            pins[0, i + 2, j] = float32(1) if held[0, i + 2, j] else float32(0)
            pins[1, i + 2, j] = float32(1) if held[1, i + 2, j] else float32(0)
            moves = row > float32(0) and not held[0, i + 2, j]
            inverse[0, i + 2, j] = float32(1) / row if moves else float32(0)
            moves = col > float32(0) and not held[1, i + 2, j]
            inverse[1, i + 2, j] = float32(1) / col if moves else float32(0)
        span(inverse, spans, i)


@parallel
def spring(lame, shape, pins, most, strength, inverse, weight, spans):
    """A coarser level's springs, and the inverse of the diagonal of stiffness and springs.

    A spring is as strong as the site's `pins`, `most` of them at most, times the diagonal.
    """
    for i in prange(lame.shape[1] - 4):
        for k in range(lame.shape[2] - 4):
            j = k + 2
            row, col = _diagonal(lame, shape, i + 2, j)
            pins[0, i + 2, j] = min(pins[0, i + 2, j], most)
            pins[1, i + 2, j] = min(pins[1, i + 2, j], most)
            weight[0, i + 2, j] = strength * pins[0, i + 2, j] * row
            weight[1, i + 2, j] = strength * pins[1, i + 2, j] * col
            row += weight[0, i + 2, j]
            col += weight[1, i + 2, j]
            inverse[0, i + 2, j] = float32(1) / row if row > float32(0) else float32(0)
            inverse[1, i + 2, j] = float32(1) / col if col > float32(0) else float32(0)
        span(inverse, spans, i)
