"""Compiled loops for the data term: blocks of the smoother, coarse levels, and products.

`data` contains a symmetric tensor W per site as planes: its diagonal, then its other components,
3 planes in an image and 6 in a volume. On the levels of a model, `weight` contains the diagonal of
W and of the springs, and `mixed` the other components of W followed by those of (D + W)^-1, whose
diagonal is in `inverse`. All arrays have a border of void, two sites wide. Loops over sites accept
volumes as views of all rows (`layout.rows`).
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32, float64

from napari_hmrf.solver.backends.cpu.compiled import (
    callee,
    parallel,
    portion,
    scratch_parallel,
    shared,
)


@shared
def _inverse(a, b, c, d, e, f):
    """Return the inverse of the symmetric matrix [[a, d, e], [d, b, f], [e, f, c]], packed."""
    p, q, r = b * c - f * f, e * f - c * d, d * f - b * e
    scale = 1 / (a * p + d * q + e * r)
    return (
        scale * p,
        scale * (a * c - e * e),
        scale * (a * b - d * d),
        scale * q,
        scale * r,
        scale * (d * e - a * f),
    )


@shared
def _tensor(data, i, j):
    """Return the six components of the tensor at a site; those of a third axis are 0 in 2-D."""
    if len(data) == 3:
        return float64(data[0, i, j]), float64(data[1, i, j]), 0.0, float64(data[2, i, j]), 0.0, 0.0
    return (
        float64(data[0, i, j]),
        float64(data[1, i, j]),
        float64(data[2, i, j]),
        float64(data[3, i, j]),
        float64(data[4, i, j]),
        float64(data[5, i, j]),
    )


@parallel
def couple(thread, inverse, data, weight, mixed):
    """Add W to the springs, and replace the reciprocal diagonal with the blocks of (D + W)^-1.

    On entry, `weight` contains the springs, and `inverse` the reciprocal of D with springs, or 0 at
    fixed components, which stay 0.
    """
    count = len(inverse)
    for n in portion(thread, inverse.shape[1] - 4):
        i = n + 2
        for j in range(2, inverse.shape[2] - 2):
            a, b, c, d, e, f = _tensor(data, i, j)
            weight[0, i, j] += float32(a)
            weight[1, i, j] += float32(b)
            mixed[0, i, j] = float32(d)
            x, y, z = float64(inverse[0, i, j]), float64(inverse[1, i, j]), 0.0
            if count == 3:
                weight[2, i, j] += float32(c)
                mixed[1, i, j], mixed[2, i, j] = float32(e), float32(f)
                z = float64(inverse[2, i, j])
            a, d, e = (a + 1 / x, d, e) if x > 0 else (1.0, 0.0, 0.0)
            b, d, f = (b + 1 / y, d, f) if y > 0 else (1.0, 0.0, 0.0)
            c, e, f = (c + 1 / z, e, f) if z > 0 else (1.0, 0.0, 0.0)
            a, b, c, d, e, f = _inverse(a, b, c, d, e, f)
            inverse[0, i, j] = float32(a) if x > 0 else float32(0)
            inverse[1, i, j] = float32(b) if y > 0 else float32(0)
            if count == 3:
                inverse[2, i, j] = float32(c) if z > 0 else float32(0)
                mixed[3, i, j], mixed[4, i, j] = float32(d), float32(e)
                mixed[5, i, j] = float32(f)
            else:
                mixed[1, i, j] = float32(d)


@parallel
def add(thread, d, data, scale, inverse, out, row_totals):
    """Add ``scale * W d`` to `out`, except at fixed components; sum d . W d of each row.

    Components with an inverse diagonal of 0 are fixed. If `inverse` is None, no component is.
    """
    count = len(d)
    for n in portion(thread, d.shape[1] - 4):
        i, total = n + 2, 0.0
        for j in range(2, d.shape[2] - 2):
            a, b, c, e, f, g = _tensor(data, i, j)
            x, y, z = float64(d[0, i, j]), float64(d[1, i, j]), 0.0
            if count == 3:
                z = float64(d[2, i, j])
            first, second, third = a * x + e * y + f * z, e * x + b * y + g * z, 0.0
            total += x * first + y * second
            if count == 3:
                third = f * x + g * y + c * z
                total += z * third
            if inverse is not None:
                first = first if inverse[0, i, j] > 0 else 0.0
                second = second if inverse[1, i, j] > 0 else 0.0
                if count == 3:
                    third = third if inverse[2, i, j] > 0 else 0.0
            out[0, i, j] += scale * first
            out[1, i, j] += scale * second
            if count == 3:
                out[2, i, j] += scale * third
        row_totals[n] = total


@parallel
def add_mixed(thread, d, mixed, inverse, out):
    """Add the part of W d with the mixed components of W to `out`, except at fixed components."""
    count = len(d)
    for n in portion(thread, d.shape[1] - 4):
        i = n + 2
        for j in range(2, d.shape[2] - 2):
            x, y = d[0, i, j], d[1, i, j]
            first, second = mixed[0, i, j] * y, mixed[0, i, j] * x
            if count == 3:
                z = d[2, i, j]
                third = mixed[1, i, j] * x + mixed[2, i, j] * y
                first += mixed[1, i, j] * z
                second += mixed[2, i, j] * z
                out[2, i, j] += third if inverse[2, i, j] > float32(0) else float32(0)
            out[0, i, j] += first if inverse[0, i, j] > float32(0) else float32(0)
            out[1, i, j] += second if inverse[1, i, j] > float32(0) else float32(0)


@parallel
def smooth(thread, d, rest, inverse, mixed, out, scale, ahead, back):
    """Compute a Chebyshev step: out = d + scale (D + W)^-1 rest + ahead d - back out.

    `rest` is the residual, except for the part of W d with the mixed components of W. On entry,
    `out` has the displacement before the last step, which was d - out.
    """
    count = len(d)
    for n in portion(thread, d.shape[1] - 4):
        i = n + 2
        for j in range(2, d.shape[2] - 2):
            x, y = d[0, i, j], d[1, i, j]
            first = rest[0, i, j] - mixed[0, i, j] * y
            second = rest[1, i, j] - mixed[0, i, j] * x
            if count == 3:
                z = d[2, i, j]
                first -= mixed[1, i, j] * z
                second -= mixed[2, i, j] * z
                third = rest[2, i, j] - (mixed[1, i, j] * x + mixed[2, i, j] * y)
                a = mixed[4, i, j] * first + mixed[5, i, j] * second + inverse[2, i, j] * third
                out[2, i, j] = z + (scale * a + ahead * z - back * out[2, i, j])
                a = inverse[0, i, j] * first + mixed[3, i, j] * second + mixed[4, i, j] * third
                b = mixed[3, i, j] * first + inverse[1, i, j] * second + mixed[5, i, j] * third
            else:
                a = inverse[0, i, j] * first + mixed[1, i, j] * second
                b = mixed[1, i, j] * first + inverse[1, i, j] * second
            out[0, i, j] = x + (scale * a + ahead * x - back * out[0, i, j])
            out[1, i, j] = y + (scale * b + ahead * y - back * out[1, i, j])


# Transfer between levels
#
# Data with a large W almost prescribe the motion of a site. As at prescribed sites, an interpolated
# correction must not move it, so both transfers are filtered by T = (D + W)^-1 D, which is the
# identity without data. A coarse site receives the sum of W T, which is W if W is small and at most
# D otherwise, because the coarse sites beside a fixed site must still move.


@shared
def filtered(first, second, inverse, weight, mixed, j):
    """Return T^T r = r - W (D + W)^-1 r for a force r at site j of a row of an image.

    The other arguments are pairs of rows.
    """
    x = inverse[0][j] * first + mixed[1][j] * second
    y = mixed[1][j] * first + inverse[1][j] * second
    return (
        first - (weight[0][j] * x + mixed[0][j] * y),
        second - (mixed[0][j] * x + weight[1][j] * y),
    )


@shared
def relaxed(first, second, inverse, weight, mixed, j):
    """Return T u = u - (D + W)^-1 W u for an interpolated correction u; see `filtered`."""
    x = weight[0][j] * first + mixed[0][j] * second
    y = mixed[0][j] * first + weight[1][j] * second
    return (
        first - (inverse[0][j] * x + mixed[1][j] * y),
        second - (mixed[1][j] * x + inverse[1][j] * y),
    )


@callee
def _interpolate_row(near, far, inverse, line):
    """Interpolate one row of a component of a coarse correction, with 0 where it is fixed."""
    for j in range((len(line) - 3) // 2):
        here = float32(0.5) * (near[j + 2] + far[j + 2])
        between = float32(0.5) * here + float32(0.25) * (near[j + 3] + far[j + 3])
        line[2 * j + 2] = here if inverse[2 * j + 2] > float32(0) else float32(0)
        line[2 * j + 3] = between if inverse[2 * j + 3] > float32(0) else float32(0)


@shared
def _product_line(weight, mixed, own, other, out):
    for x in range(len(out)):
        out[x] = weight[x] * own[x] + mixed[x] * other[x]


@shared
def _subtract_line(own, inverse, mixed, force, other, out):
    for x in range(len(out)):
        out[x] += own[x] - (inverse[x] * force[x] + mixed[x] * other[x])


@scratch_parallel
def add_relaxed(thread, coarse, inverse, weight, mixed, out):
    """Interpolate the coarse correction of an image, multiply it by T, and add it to `out`."""
    for n in portion(thread, out.shape[1] - 4):
        i, near = n + 2, n // 2 + 2
        far = near + n % 2
        # The interpolated correction u, and W u. Loops that write a single line vectorize.
        u, force = np.zeros((2, out.shape[2]), out.dtype), np.zeros((2, out.shape[2]), out.dtype)
        for k in range(2):
            _interpolate_row(coarse[k, near], coarse[k, far], inverse[k, i], u[k])
        for k in range(2):
            _product_line(weight[k, i], mixed[0, i], u[k], u[1 - k], force[k])
        for k in range(2):
            _subtract_line(u[k], inverse[k, i], mixed[1, i], force[k], force[1 - k], out[k, i])


# Coarse levels


@shared
def _limited(data, mean, i, j):
    """Return W T at a site, with D = mean, which is positive."""
    a, b, c, d, e, f = _tensor(data, i, j)
    scale = 1 / mean
    # W T = D (1 - T) with T = (1 + W / D)^-1
    a, b, c, d, e, f = _inverse(
        1 + scale * a, 1 + scale * b, 1 + scale * c, scale * d, scale * e, scale * f
    )
    return mean * (1 - a), mean * (1 - b), mean * (1 - c), -mean * d, -mean * e, -mean * f


@parallel
def limit(thread, data, diagonal, weight, mixed):
    """Write W T to `weight` and `mixed`, with the mean of the diagonal for D; 0 in void.

    The sum over the fine sites around a coarse site, as for forces, is the tensor of that site.
    """
    count = len(diagonal)
    for n in portion(thread, diagonal.shape[1] - 4):
        i = n + 2
        for j in range(2, diagonal.shape[2] - 2):
            mean = float64(diagonal[0, i, j]) + float64(diagonal[1, i, j])
            if count == 3:
                mean += float64(diagonal[2, i, j])
            mean /= count
            a, b, c, d, e, f = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            if mean > 0:
                a, b, c, d, e, f = _limited(data, mean, i, j)
            weight[0, i, j], weight[1, i, j] = float32(a), float32(b)
            mixed[0, i, j] = float32(d)
            if count == 3:
                weight[2, i, j] = float32(c)
                mixed[1, i, j], mixed[2, i, j] = float32(e), float32(f)
