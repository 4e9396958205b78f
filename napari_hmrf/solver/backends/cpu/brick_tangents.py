"""Compiled loops for deformed volumes in large motion: the operations of multigrid on its levels.

An element of a level has 13 numbers, from which its tangent follows: the nine components of the
mean deformation gradient F, row by row; mu; the first and the second derivative of the energy with
respect to the mean Jacobian, s and b; and the damping of the smoother. The energy of a motion with
the mean gradient W, and with modes m that vary along more than one axis, is

    U = 1/2 (mu |W|^2 + b (C : W)^2 + s W : (F x W))
        + 1/2 mu (sum over modes of h m^2 + mean over the element of (C : W_h)^2 / det(F)^2)

C are the cofactors of F, F x W is their derivative in the direction W, and W_h is the gradient of
the modes m. The first derivative is limited so that no motion has a negative energy:

    |s| sigma <= mu, with the largest singular value sigma of F.

The solved system is that of `backends.cpu.finite_bricks`; this one is its preconditioner.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import math

import numpy as np
from numba import float32

from napari_hmrf.solver.backends.cpu.bernstein import barrier_slopes
from napari_hmrf.solver.backends.cpu.compiled import (
    alone,
    by_parity,
    callee,
    parallel,
    portion,
    scratch_parallel,
    shared,
)
from napari_hmrf.solver.backends.cpu.finite_bricks import (
    GAIN,
    GROWTH,
    LAM,
    LOW,
    MODES,
    MU,
    PULLS,
    SQUARE,
    STEP,
    VOLUME,
    add_pulls,
    bound_below,
    cofactor,
    deformed,
    determinant,
    largest_stretch,
    line,
    place,
    product,
    read_solid,
    sweep_of,
    times_growth,
    twisted,
    volumes,
)
from napari_hmrf.solver.backends.cpu.forces import clear, planes_of, planes_of_turn

#: Number of planes of a level's model.
PLANES = np.int64(13)
_SHEAR, _SLOPE, _BEND, _DAMPING = np.arange(9, 13)
# Number of iterations for the norm of an element, which begin near the largest eigenvector.
_ITERATIONS = 4


@shared
def _limited(slope, mu, stretch):
    """Return a derivative with respect to the Jacobian that leaves the tangent positive."""
    bound = mu / stretch
    return min(max(slope, -bound), bound)


@callee
def _norm(m, mu, slope, bend, q, way, image):
    """Return the norm of an element's matrix, scaled to a diagonal of ones."""
    c = cofactor(m)
    hourglass = mu * _hourglass_diagonal(q)
    volume = determinant(m)
    dense, least, tilted = mu / (volume * volume), np.inf, 0.0
    for k in range(3):
        own, here = hourglass, 0.0
        for a in range(3):
            square = q[a] * q[a] * c[3 * k + a] * c[3 * k + a]
            own += q[a] * q[a] * mu + (bend + 7.0 / 9.0 * dense) * square
            here += square
        least, tilted = min(least, own), tilted + here / own
        scale = 1.0 / math.sqrt(own)
        for a in range(3):
            image[9 + 3 * k + a] = q[a] * scale
            way[3 * k + a] = c[3 * k + a] * q[a] * scale
    norm = 0.0
    for _ in range(_ITERATIONS):
        total = 0.0
        for n in range(9):
            total += way[n] * way[n]
        total = 1.0 / math.sqrt(total)
        tilt = 0.0
        for n in range(9):
            way[n] *= total
            image[n] = image[9 + n] * way[n]
            tilt += c[n] * image[n]
        w = (
            image[0], image[1], image[2], image[3], image[4],
            image[5], image[6], image[7], image[8],
        )  # fmt: skip
        turn = twisted(m, w)
        norm = 0.0
        for n in range(9):
            made = image[9 + n] * (mu * image[n] + bend * tilt * c[n] + slope * turn[n])
            norm += made * way[n]
            way[n] = made
    # Bound of the modes that vary along more than one axis.
    others = hourglass / least + 2.0 / 3.0 * dense * tilted
    return 8.0 * max(norm, others)


@shared
def _hourglass_diagonal(q):
    """Return the sum of the factors h of the four modes that vary along more than one axis."""
    a, b, c = q[0] * q[0], q[1] * q[1], q[2] * q[2]
    return 2.0 * (a + b + c) / 3.0 + (a + b + c) / 9.0


@alone
def norm_at_rest(mu, lam, q):
    """Return the norm of the matrix of an element at rest, scaled to a diagonal of ones."""
    m = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    return _norm(m, mu, -mu, mu + lam, q, np.empty(9), np.empty(18))


@shared
def _write_tangents(d, q, block, f, points, about):
    z, y, begin, count = block
    strength, start, calm, out, low, edges, net, way, image = about
    bound_below(f, q, count)
    volumes(f, points, q, count)
    for x in range(count):
        at = begin + x
        mu, gain = f[line(MU) + x], f[line(GAIN) + x]
        if mu <= 0:
            continue
        m = deformed(f, x, q, 0.0, 0.0, 0.0)
        lam, volume = f[line(LAM) + x], f[line(VOLUME) + x]
        jacobian = volume / gain
        slope = 0.5 * lam * gain * (volume - 1.0 / volume) - mu / jacobian
        bend = 0.5 * lam * gain * gain * (1.0 + 1.0 / (volume * volume))
        bend += mu / (jacobian * jacobian)
        stretch = largest_stretch(times_growth(f, GROWTH, x, m))
        low[z, y, at] = f[line(LOW) + x]
        if low[z, y, at] < start:
            least, first, second = barrier_slopes(d, z, y, at, q, gain, start, edges, net)
            low[z, y, at] = least
            slope += strength * mu * gain * first
            bend += strength * mu * gain * gain * second
        slope = _limited(slope, mu, stretch / gain)
        own = (f[line(SQUARE) + x] + f[line(SQUARE + 3) + x] + f[line(SQUARE + 5) + x]) / 3
        for n in range(9):
            out[n, z, y, at] = m[n]
        out[_SHEAR, z, y, at] = mu * own
        out[_SLOPE, z, y, at] = slope
        out[_BEND, z, y, at] = bend
        norm = _norm(m, mu * own, slope, bend, q, way, image)
        out[_DAMPING, z, y, at] = max(1.0, norm / calm)


_tangent_sweep = sweep_of(read_solid, _write_tangents)


@scratch_parallel
def tangents(thread, d, solid, q, barrier, calm, out, low):
    """Compute the numbers of each element at a displacement, for the finest level.

    `low` gets a bound below the Jacobian of each element, infinite in void. It is the least
    Bernstein coefficient where it is less than the start of the barrier.
    """
    planes = planes_of(thread, d.shape[1])
    for z in planes:
        out[:, z], low[z] = 0, np.inf
    edges, net, way, image = np.empty((3, 4, 3)), np.empty(27), np.empty(9), np.empty(18)
    about = (*barrier, calm, out, low, edges, net, way, image)
    _tangent_sweep(planes, d, solid, q, d, about)


@scratch_parallel
def coarsen(thread, fine, coarse):
    """Compute the numbers of coarse elements from the eight fine ones, with void as 0.

    F is the mean, weighted by mu. The moduli are twice their mean, because the energy of an element
    grows with its side. The damping is the largest of the eight.
    """
    for n in portion(thread, coarse.shape[1] - 4):
        z = n + 2
        total = np.empty(9, dtype=np.float32)
        for y in range(2, coarse.shape[2] - 2):
            for x in range(2, coarse.shape[3] - 2):
                mu = slope = bend = damping = float32(0)
                total[:] = 0
                for c in range(8):
                    i, j, k = 2 * z - 2 + c // 4, 2 * y - 2 + c % 4 // 2, 2 * x - 2 + c % 2
                    shear = fine[_SHEAR, i, j, k]
                    mu += shear
                    slope += fine[_SLOPE, i, j, k]
                    bend += fine[_BEND, i, j, k]
                    damping = max(damping, fine[_DAMPING, i, j, k])
                    for e in range(9):
                        total[e] += shear * fine[e, i, j, k]
                if mu > 0:
                    for e in range(9):
                        total[e] /= mu
                    m = (
                        total[0], total[1], total[2], total[3], total[4],
                        total[5], total[6], total[7], total[8],
                    )  # fmt: skip
                    slope = _limited(slope, mu, largest_stretch(m))
                for e in range(9):
                    coarse[e, z, y, x] = total[e]
                coarse[_SHEAR, z, y, x] = float32(0.25) * mu
                coarse[_SLOPE, z, y, x] = float32(0.25) * slope
                coarse[_BEND, z, y, x] = float32(0.25) * bend
                coarse[_DAMPING, z, y, x] = damping


@callee
def _diagonal_plane(tangent, q, z, out):
    hourglass = _hourglass_diagonal(q)
    even = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    for y in range(2, tangent.shape[2] - 2):
        for x in range(2, tangent.shape[3] - 2):
            mu = tangent[_SHEAR, z, y, x]
            if mu <= 0:
                continue
            m = (
                tangent[0, z, y, x], tangent[1, z, y, x], tangent[2, z, y, x],
                tangent[3, z, y, x], tangent[4, z, y, x], tangent[5, z, y, x],
                tangent[6, z, y, x], tangent[7, z, y, x], tangent[8, z, y, x],
            )  # fmt: skip
            c = cofactor(m)
            bend, damping = tangent[_BEND, z, y, x], tangent[_DAMPING, z, y, x]
            volume = determinant(m)
            dense = mu / (volume * volume)
            for corner in range(8):
                s, t, r = place(corner, 1.0)
                for k in range(3):
                    a, b, e = s * q[0] * c[3 * k], t * q[1] * c[3 * k + 1], r * q[2] * c[3 * k + 2]
                    own = mu * (even + hourglass) + bend * (a + b + e) ** 2
                    two = (a + b) ** 2 + (a + e) ** 2 + (b + e) ** 2
                    own += dense * (two / 3 + (a * a + b * b + e * e) / 9)
                    out[k, z + corner // 4, y + corner % 4 // 2, x + corner % 2] += float32(
                        damping * own
                    )


@by_parity
def diagonal(thread, tangent, q, out):
    """Compute the diagonal of the matrix, times the damping of the elements."""
    if thread[2] == 0:
        clear(thread, out)
    else:
        for z in planes_of_turn(thread, tangent.shape[1]):
            _diagonal_plane(tangent, q, z, out)


@shared
def _read_tangents(tangent, z, y, begin, count, f):
    """Return whether any element of a block is tissue."""
    most, shear = float32(0), tangent[_SHEAR, z, y, begin : begin + count]
    for x in range(count):
        most = max(most, shear[x])
    return most > 0


@shared
def _add_image(d, q, block, f, points, about):
    z, y, begin, count = block
    tangent, out = about
    one = f.dtype.type
    q0, q1, q2 = q[0], q[1], q[2]
    third, ninth, none, least = one(1 / 3), one(1 / 9), one(0), one(1e-12)
    h110, h101, h011 = (
        third * (q0 * q0 + q1 * q1),
        third * (q0 * q0 + q2 * q2),
        third * (q1 * q1 + q2 * q2),
    )
    h111 = ninth * (q0 * q0 + q1 * q1 + q2 * q2)
    past = begin + count
    t0, t1, t2 = (
        tangent[0, z, y, begin:past],
        tangent[1, z, y, begin:past],
        tangent[2, z, y, begin:past],
    )
    t3, t4, t5 = (
        tangent[3, z, y, begin:past],
        tangent[4, z, y, begin:past],
        tangent[5, z, y, begin:past],
    )
    t6, t7, t8 = (
        tangent[6, z, y, begin:past],
        tangent[7, z, y, begin:past],
        tangent[8, z, y, begin:past],
    )
    shear, slopes = tangent[_SHEAR, z, y, begin:past], tangent[_SLOPE, z, y, begin:past]
    bends = tangent[_BEND, z, y, begin:past]
    for x in range(count):
        mu, slope, bend = shear[x], slopes[x], bends[x]
        m = (t0[x], t1[x], t2[x], t3[x], t4[x], t5[x], t6[x], t7[x], t8[x])
        c = cofactor(m)
        at = line(MODES) + x
        w = (
            q0 * f[at], q1 * f[at + STEP], q2 * f[at + 2 * STEP],
            q0 * f[at + 7 * STEP], q1 * f[at + 8 * STEP], q2 * f[at + 9 * STEP],
            q0 * f[at + 14 * STEP], q1 * f[at + 15 * STEP], q2 * f[at + 16 * STEP],
        )  # fmt: skip
        turn = twisted(m, w)
        tilt = bend * product(c, w)
        to = line(PULLS) + x
        f[to] = q0 * (mu * w[0] + tilt * c[0] + slope * turn[0])
        f[to + STEP] = q1 * (mu * w[1] + tilt * c[1] + slope * turn[1])
        f[to + 2 * STEP] = q2 * (mu * w[2] + tilt * c[2] + slope * turn[2])
        f[to + 7 * STEP] = q0 * (mu * w[3] + tilt * c[3] + slope * turn[3])
        f[to + 8 * STEP] = q1 * (mu * w[4] + tilt * c[4] + slope * turn[4])
        f[to + 9 * STEP] = q2 * (mu * w[5] + tilt * c[5] + slope * turn[5])
        f[to + 14 * STEP] = q0 * (mu * w[6] + tilt * c[6] + slope * turn[6])
        f[to + 15 * STEP] = q1 * (mu * w[7] + tilt * c[7] + slope * turn[7])
        f[to + 16 * STEP] = q2 * (mu * w[8] + tilt * c[8] + slope * turn[8])
    for x in range(count):
        m = (t0[x], t1[x], t2[x], t3[x], t4[x], t5[x], t6[x], t7[x], t8[x])
        c = cofactor(m)
        mu, volume = shear[x], determinant(m)
        dense = mu / max(volume * volume, least)
        # Changes of volume that vary along one axis, and along two axes.
        a = b = e = ab = ae = be = none
        for k in range(3):
            at = line(MODES + 7 * k) + x
            m110, m101 = f[at + 3 * STEP], f[at + 4 * STEP]
            m011, m111 = f[at + 5 * STEP], f[at + 6 * STEP]
            c0, c1, c2 = q0 * c[3 * k], q1 * c[3 * k + 1], q2 * c[3 * k + 2]
            a += c1 * m110 + c2 * m101
            b += c0 * m110 + c2 * m011
            e += c0 * m101 + c1 * m011
            ab += c2 * m111
            ae += c1 * m111
            be += c0 * m111
        one_third, one_ninth = dense * third, dense * ninth
        a, b, e = one_third * a, one_third * b, one_third * e
        ab, ae, be = one_ninth * ab, one_ninth * ae, one_ninth * be
        for k in range(3):
            at, to = line(MODES + 7 * k) + x, line(PULLS + 7 * k) + x
            c0, c1, c2 = q0 * c[3 * k], q1 * c[3 * k + 1], q2 * c[3 * k + 2]
            f[to + 3 * STEP] = mu * h110 * f[at + 3 * STEP] + (c1 * a + c0 * b)
            f[to + 4 * STEP] = mu * h101 * f[at + 4 * STEP] + (c2 * a + c0 * e)
            f[to + 5 * STEP] = mu * h011 * f[at + 5 * STEP] + (c2 * b + c1 * e)
            f[to + 6 * STEP] = mu * h111 * f[at + 6 * STEP] + (c2 * ab + c1 * ae + c0 * be)
    add_pulls(f, z, y, begin, count, out)


_image_sweep = sweep_of(_read_tangents, _add_image)


@by_parity
def image(thread, d, tangent, q, out):
    """Compute A d."""
    if thread[2] == 0:
        clear(thread, out)
    else:
        planes = planes_of_turn(thread, d.shape[1])
        _image_sweep(planes, d, tangent, q, d, (tangent, out))


@parallel
def smooth(thread, d, load, image, inverse, weight, springs, out, scale, ahead, back):
    """Compute a Chebyshev step: out = d + scale D^-1 (load - (A + W) d) + ahead d - back out.

    `image` is A d. On entry, `out` has the displacement before the last step, which was d - out.
    Arrays are those of `layout.rows`.
    """
    for i in portion(thread, d.shape[1]):
        for k in range(d.shape[0]):
            for x in range(d.shape[2]):
                now = d[k, i, x]
                rest = load[k, i, x] - image[k, i, x] - springs * weight[k, i, x] * now
                step = scale * inverse[k, i, x] * rest + ahead * now
                out[k, i, x] = now + (step - back * out[k, i, x])


@parallel
def rest(thread, d, load, given, image, inverse, weight, springs, scale, out):
    """Compute out = scale (given load - (A + W) d), with 0 at fixed components.

    `image` is A d, and may be the array `out`. Arrays are those of `layout.rows`.
    """
    for i in portion(thread, d.shape[1]):
        for k in range(d.shape[0]):
            for x in range(d.shape[2]):
                left = given * load[k, i, x] - image[k, i, x]
                left = scale * (left - springs * weight[k, i, x] * d[k, i, x])
                out[k, i, x] = left if inverse[k, i, x] > float32(0) else float32(0)
