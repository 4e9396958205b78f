"""Compiled loops for the data term: blocks of the smoother, coarse levels, and products.

`data` contains a symmetric tensor W per site as planes: its diagonal, then its other components,
3 planes in an image and 6 in a volume. On the levels of a model, `weight` contains the diagonal of
W and of the springs, and `mixed` the other components of W followed by those of (D + W)^-1, whose
diagonal is in `inverse`. All arrays have a border of void, two sites wide. Loops over sites accept
volumes as views of all rows (`level.rows`).
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32, float64, prange

from napari_hmrf.solver.backends.cpu.compiled import callee, parallel, shared


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
def couple(inverse, data, weight, mixed):
    """Add W to the springs, and replace the reciprocal diagonal with the blocks of (D + W)^-1.

    On entry, `weight` contains the springs, and `inverse` the reciprocal of D with springs, or 0 at
    fixed components, which stay 0.
    """
    count = len(inverse)
    for n in prange(inverse.shape[1] - 4):
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
def add(d, data, scale, inverse, out, row_totals):
    """Add ``scale * W d`` to `out`, except at fixed components; sum d . W d of each row.

    Components with an inverse diagonal of 0 are fixed. If `inverse` is None, no component is.
    """
    count = len(d)
    for n in prange(d.shape[1] - 4):
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


# Transfer between levels
#
# Data with a large W almost prescribe the motion of a site. As at prescribed sites, an interpolated
# correction must not move it, so both transfers are filtered by T = (D + W)^-1 D, which is the
# identity without data. A coarse site receives the sum of W T, which is W if W is small and at most
# D otherwise, because the coarse sites beside a fixed site must still move.


@shared
def filtered(first, second, inverse, weight, mixed, i, j):
    """Return T^T r = r - W (D + W)^-1 r for a force r at a site of an image."""
    x = inverse[0, i, j] * first + mixed[1, i, j] * second
    y = mixed[1, i, j] * first + inverse[1, i, j] * second
    return (
        first - (weight[0, i, j] * x + mixed[0, i, j] * y),
        second - (mixed[0, i, j] * x + weight[1, i, j] * y),
    )


@shared
def relaxed(first, second, inverse, weight, mixed, i, j):
    """Return T u = u - (D + W)^-1 W u for an interpolated correction u at a site of an image."""
    x = weight[0, i, j] * first + mixed[0, i, j] * second
    y = mixed[0, i, j] * first + weight[1, i, j] * second
    return (
        first - (inverse[0, i, j] * x + mixed[1, i, j] * y),
        second - (mixed[1, i, j] * x + inverse[1, i, j] * y),
    )


@shared
def _product(tensor, x, y, z):
    """Return the product of a packed tensor and a vector."""
    a, b, c, d, e, f = tensor
    return a * x + d * y + e * z, d * x + b * y + f * z, e * x + f * y + c * z


@parallel
def add_relaxed(correction, inverse, weight, mixed, out):
    """Add an interpolated correction, multiplied by T, to `out`."""
    for n in prange(out.shape[1] - 4):
        i = n + 2
        for j in range(2, out.shape[2] - 2):
            x, y = correction[0, i, j], correction[1, i, j]
            if len(out) == 2:
                x, y = relaxed(x, y, inverse, weight, mixed, i, j)
                out[0, i, j] += x
                out[1, i, j] += y
            else:
                z = correction[2, i, j]
                p, q, r = _product(_packed(weight, mixed, 0, i, j), x, y, z)
                p, q, r = _product(_packed(inverse, mixed, 3, i, j), p, q, r)
                out[0, i, j] += x - p
                out[1, i, j] += y - q
                out[2, i, j] += z - r


@parallel
def filter_rest(inverse, weight, mixed, rest):
    """Multiply the residual of a volume by T^T, in place."""
    for n in prange(rest.shape[1] - 4):
        i = n + 2
        for j in range(2, rest.shape[2] - 2):
            x, y, z = rest[0, i, j], rest[1, i, j], rest[2, i, j]
            p, q, r = _product(_packed(inverse, mixed, 3, i, j), x, y, z)
            p, q, r = _product(_packed(weight, mixed, 0, i, j), p, q, r)
            rest[0, i, j] = x - p
            rest[1, i, j] = y - q
            rest[2, i, j] = z - r


@shared
def _packed(diagonal, others, first, i, j):
    """Return a tensor at a site of a volume; its other components begin at plane `first`."""
    return (
        diagonal[0, i, j],
        diagonal[1, i, j],
        diagonal[2, i, j],
        others[first, i, j],
        others[first + 1, i, j],
        others[first + 2, i, j],
    )


@shared
def _limited(data, diagonal, i, j):
    """Return W T at a site, with the mean of the diagonal for D; 0 where there is no tissue."""
    if len(diagonal) == 3:
        mean = (diagonal[0, i, j] + diagonal[1, i, j] + diagonal[2, i, j]) / 3.0
    else:
        mean = (diagonal[0, i, j] + diagonal[1, i, j]) / 2.0
    a, b, c, d, e, f = _tensor(data, i, j)
    if mean > 0:
        # W T = D (1 - T) with T = (1 + W / D)^-1
        a, b, c, d, e, f = _inverse(
            1 + a / mean, 1 + b / mean, 1 + c / mean, d / mean, e / mean, f / mean
        )
    else:
        a, b, c, d, e, f = 1.0, 1.0, 1.0, 0.0, 0.0, 0.0
    return mean * (1 - a), mean * (1 - b), mean * (1 - c), -mean * d, -mean * e, -mean * f


@shared
def _add_limited(data, diagonal, i, j, share, sums):
    """Add W T of a site, multiplied by `share`, to the sums of the six components."""
    a, b, c, d, e, f = _limited(data, diagonal, i, j)
    sums[0] += share * a
    sums[1] += share * b
    sums[2] += share * c
    sums[3] += share * d
    sums[4] += share * e
    sums[5] += share * f


@callee
def _write(sums, out, i, j):
    """Write the sums of the six components to the planes of a coarse site."""
    out[0, i, j], out[1, i, j] = sums[0], sums[1]
    if len(out) == 3:
        out[2, i, j] = sums[3]
    else:
        for k in range(2, 6):
            out[k, i, j] = sums[k]


@parallel
def coarsen_image(data, diagonal, out):
    """Compute the tensors of the next coarser level of an image."""
    for n in prange(out.shape[1] - 4):
        sums = np.zeros(6)
        for m in range(out.shape[2] - 4):
            sums[:] = 0
            for down in range(-1, 2):
                for right in range(-1, 2):
                    share = 1.0 / ((1 + abs(down)) * (1 + abs(right)))
                    i, j = 2 * np.int64(n) + 2 + down, 2 * m + 2 + right
                    _add_limited(data, diagonal, i, j, share, sums)
            _write(sums, out, np.int64(n) + 2, m + 2)


@parallel
def coarsen_volume(data, diagonal, out):
    """Compute the tensors of the next coarser level of a volume."""
    for n in prange(out.shape[1] - 4):
        sums = np.zeros(6)
        for m in range(out.shape[2] - 4):
            for o in range(out.shape[3] - 4):
                sums[:] = 0
                for back in range(-1, 2):
                    z = 2 * np.int64(n) + 2 + back
                    for down in range(-1, 2):
                        for right in range(-1, 2):
                            share = 1.0 / ((1 + abs(back)) * (1 + abs(down)) * (1 + abs(right)))
                            i, j = 2 * m + 2 + down, 2 * o + 2 + right
                            _add_limited(data[:, z], diagonal[:, z], i, j, share, sums)
                _write(sums, out[:, np.int64(n) + 2], m + 2, o + 2)
