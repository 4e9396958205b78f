"""Compiled loops for the tangents of Neo-Hookean tissue: its linear model at a displacement.

A tangent is the matrix of second derivatives of an element's energy with respect to D_r, D_c and
D_x, which have two components each. It is stored as 21 numbers: the blocks RR (3 numbers), CC (3),
RC (4), XX (3), RX (4) and CX (4). Arrays have the layout of `backends.cpu.finite_strain`.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import math

import numpy as np

from napari_hmrf.solver.backends.cpu.compiled import (
    alone,
    bounds_of_part,
    callee,
    disjoint_parallel,
    inline,
    portion,
)
from napari_hmrf.solver.backends.cpu.finite_strain import (
    CC,
    FIRST,
    RC,
    RR,
    SHEAR,
    TWIST,
    WHOLE,
    bulk,
    smallest,
    state,
    walls,
)

#: Smallest eigenvalue of a tangent after it is made positive, relative to mu.
LEAST = 0.05
# Limits for elements without extra damping: smallest corner Jacobian, and largest sum of squared
# sides.
_CALM, _STRETCHED = 0.9, 2.3


@inline
def _positive(a0, a1, b0, b1, shear, of_mean, bend):
    """Return the tangent of stretch and volume, with eigenvalues of at least `LEAST` mu."""
    # Split the sides into a conformal part P and an anticonformal part Q. The Jacobian is
    # (|P|^2 - |Q|^2) / 2. The tangent is a 2 x 2 block in the directions of P and Q, and diagonal
    # in the directions perpendicular to P and to Q.
    half = math.sqrt(0.5)
    p0, p1, q0, q1 = half * (a0 + b1), half * (a1 - b0), half * (a0 - b1), half * (a1 + b0)
    p, q = math.hypot(p0, p1), math.hypot(q0, q1)
    least = LEAST * shear
    across_p, across_q = max(shear + of_mean, least), max(shear - of_mean, least)
    one = shear + of_mean + bend * p * p
    two = shear - of_mean + bend * q * q
    both = -bend * p * q
    middle, apart = 0.5 * (one + two), math.hypot(0.5 * (one - two), both)
    low, high = middle - apart, middle + apart
    if low < least:
        kept_low, kept_high = max(low, least), max(high, least)
        # Replace both eigenvalues of the block, and preserve the eigenvectors.
        share = (kept_high - kept_low) / (high - low) if high > low else 0.0
        one, two = kept_low + share * (one - low), kept_low + share * (two - low)
        both *= share
    c0, c1 = (p0 / p, p1 / p) if p > 0 else (1.0, 0.0)
    s0, s1 = (q0 / q, q1 / q) if q > 0 else (1.0, 0.0)
    pp00 = across_p * (1 - c0 * c0) + one * c0 * c0
    pp11 = across_p * (1 - c1 * c1) + one * c1 * c1
    pp01 = (one - across_p) * c0 * c1
    qq00 = across_q * (1 - s0 * s0) + two * s0 * s0
    qq11 = across_q * (1 - s1 * s1) + two * s1 * s1
    qq01 = (two - across_q) * s0 * s1
    pq00, pq01, pq10, pq11 = both * c0 * s0, both * c0 * s1, both * c1 * s0, both * c1 * s1
    # Transform back to the sides: a0 = (P0 + Q0) / sqrt 2, a1 = (P1 + Q1) / sqrt 2,
    # b0 = (Q1 - P1) / sqrt 2 and b1 = (P0 - Q0) / sqrt 2.
    return (
        0.5 * (pp00 + qq00) + pq00,
        0.5 * ((pp01 + qq01) + (pq01 + pq10)),
        0.5 * (pp11 + qq11) + pq11,
        0.5 * (pp11 + qq11) - pq11,
        0.5 * ((pq01 + pq10) - (pp01 + qq01)),
        0.5 * (pp00 + qq00) - pq00,
        0.5 * ((qq01 - pp01) + (pq01 - pq10)),
        0.5 * (pp00 - qq00),
        0.5 * (qq11 - pp11),
        0.5 * ((pp01 - qq01) + (pq01 - pq10)),
    )


@inline
def _exact(a0, a1, b0, b1, shear, of_mean, bend):
    """Return the exact tangent of stretch and volume."""
    return (
        shear + bend * b1 * b1,
        -bend * b1 * b0,
        shear + bend * b0 * b0,
        shear + bend * a1 * a1,
        -bend * a1 * a0,
        shear + bend * a0 * a0,
        -bend * b1 * a1,
        of_mean + bend * b1 * a0,
        -of_mean + bend * b0 * a1,
        -bend * b0 * a0,
    )


@inline
def _grown(values, rr, rc, cc):
    """Transform a tangent in the order of `_exact` from sides without growth to deformed sides."""
    r0, r1, r2, c0, c1, c2, m00, m01, m10, m11 = values
    one, two, both, across = rr * rr, cc * cc, rr * rc, rc * rc
    back, mixed = rc * cc, rr * cc
    twice = m01 + m10
    return (
        one * r0 + both * (m00 + m00) + across * c0,
        one * r1 + both * twice + across * c1,
        one * r2 + both * (m11 + m11) + across * c2,
        across * r0 + back * (m00 + m00) + two * c0,
        across * r1 + back * twice + two * c1,
        across * r2 + back * (m11 + m11) + two * c2,
        both * r0 + (mixed + across) * m00 + back * c0,
        both * r1 + mixed * m01 + across * m10 + back * c1,
        both * r1 + mixed * m10 + across * m01 + back * c1,
        both * r2 + (mixed + across) * m11 + back * c2,
    )


@inline
def _blend(true, safe, share):
    """Return ``(1 - share) * true + share * safe`` for tangents in the order of `_exact`."""
    left = 1.0 - share
    return (
        left * true[0] + share * safe[0],
        left * true[1] + share * safe[1],
        left * true[2] + share * safe[2],
        left * true[3] + share * safe[3],
        left * true[4] + share * safe[4],
        left * true[5] + share * safe[5],
        left * true[6] + share * safe[6],
        left * true[7] + share * safe[7],
        left * true[8] + share * safe[8],
        left * true[9] + share * safe[9],
    )


@inline
def _entry(t, p, q, s, t_, u, v):
    """Return an entry of an element's matrix: component p of corner (s, t_) and q of (u, v)."""
    along_rows, along_cols, twist = t[p + q], t[3 + p + q], t[10 + p + q]
    mixed = s * v * t[6 + 2 * p + q] + t_ * u * t[6 + 2 * q + p]
    return (s * u * along_rows + t_ * v * along_cols) + (mixed + s * t_ * u * v * twist)


@callee
def _spread(t):
    """Return the Frobenius norm of an element's matrix, scaled to a unit diagonal.

    This norm is an upper bound of the spectrum.
    """
    total = 0.0
    for k in range(8):
        p, s, v = k // 4, 2.0 * (k // 2 % 2) - 1.0, 2.0 * (k % 2) - 1.0
        own = _entry(t, p, p, s, v, s, v)
        for n in range(k + 1):
            q, u, w = n // 4, 2.0 * (n // 2 % 2) - 1.0, 2.0 * (n % 2) - 1.0
            both = _entry(t, p, q, s, v, u, w)
            part = both * both / (own * _entry(t, q, q, u, w, u, w))
            total += part if n == k else part + part
    return math.sqrt(total)


@callee
def _add_walls(sides, about, factors, bends, positive, work, out, cycled, i, j):
    """Add the second derivatives of the barrier to the tangents of element (i, j).

    `factors` contains the factor that removes growth from a Jacobian, and the derivatives of the
    energy with respect to the increments of the Jacobian. `bends` contains the second derivatives.
    """
    rows, cols = about[0], about[1]
    rr, cc, rc = rows * rows, cols * cols, rows * cols
    a0, a1, b0, b1, x0, x1 = sides
    gain, of_down, of_right = factors
    bend, bend_01, bend_02, bend_12 = bends
    way, image, full, sums = work
    sums[0, 0] = sums[1, 1] = sums[2, 2] = bend
    sums[0, 1] = sums[1, 0] = bend_01
    sums[0, 2] = sums[2, 0] = bend_02
    sums[1, 2] = sums[2, 1] = bend_12
    # Derivatives of the mean Jacobian and of its increments with respect to D_r, D_c and D_x.
    way[:] = 0.0
    way[0, 0], way[0, 1], way[0, 2], way[0, 3] = b1, -b0, -a1, a0
    way[1, 0], way[1, 1] = cols * x1, -cols * x0
    way[1, 4], way[1, 5] = -cols * a1, cols * a0
    way[2, 2], way[2, 3] = -rows * x1, rows * x0
    way[2, 4], way[2, 5] = rows * b1, -rows * b0
    for k in range(3):
        for n in range(6):
            way[k, n] *= gain
    for k in range(3):
        for n in range(6):
            image[k, n] = (sums[k, 0] * way[0, n] + sums[k, 1] * way[1, n]) + sums[k, 2] * way[2, n]
    for k in range(6):
        for n in range(6):
            full[k, n] = way[0, k] * image[0, n] + way[1, k] * image[1, n]
            full[k, n] += way[2, k] * image[2, n]
    # The blocks RR, CC and XX are symmetric, so three numbers per block suffice.
    for kept in (out, cycled):
        kept[0, i, j] += rr * full[0, 0]
        kept[1, i, j] += rr * full[0, 1]
        kept[2, i, j] += rr * full[1, 1]
        kept[3, i, j] += cc * full[2, 2]
        kept[4, i, j] += cc * full[2, 3]
        kept[5, i, j] += cc * full[3, 3]
        kept[6, i, j] += rc * full[0, 2]
        kept[7, i, j] += rc * full[0, 3]
        kept[8, i, j] += rc * full[1, 2]
        kept[9, i, j] += rc * full[1, 3]
        kept[10, i, j] += full[4, 4]
        kept[11, i, j] += full[4, 5]
        kept[12, i, j] += full[5, 5]
    of_down, of_right = (1.0 - positive) * of_down, (1.0 - positive) * of_right
    out[13, i, j], out[14, i, j] = rows * full[0, 4], rows * (full[0, 5] + of_down)
    out[15, i, j], out[16, i, j] = rows * (full[1, 4] - of_down), rows * full[1, 5]
    out[17, i, j], out[18, i, j] = cols * full[2, 4], cols * (full[2, 5] - of_right)
    out[19, i, j], out[20, i, j] = cols * (full[3, 4] + of_right), cols * full[3, 5]


@callee
def _tangent_part(d, solid, about, positive, calm, out, cycled, first, last):
    work = np.zeros((3, 6)), np.zeros((3, 6)), np.zeros((6, 6)), np.zeros((3, 3))
    tangent = np.zeros(13)
    for i in range(first, last):
        for j in range(2, d.shape[2] - 2):
            if solid[SHEAR, i, j] <= 0:
                continue
            rows, cols, bulges, strength, start = about
            rr, cc, rc = rows * rows, cols * cols, rows * cols
            sides, (e0, e1, f0, f1), gain, jacobians = state(d, solid, about, i, j)
            shear, resists = solid[SHEAR, i, j], solid[TWIST, i, j]
            of_mean, bend = bulk(
                jacobians[0], shear, solid[FIRST, i, j], solid[WHOLE, i, j], bulges
            )
            low, weight = smallest(jacobians), 0.25 * strength * shear
            if low < start:
                of_mean += weight * walls(jacobians, start)[1][0]
            safe = _positive(e0, e1, f0, f1, shear, of_mean, bend)
            true = _exact(e0, e1, f0, f1, shear, of_mean, bend)
            grown_r, mixed, grown_c = solid[RR, i, j], solid[RC, i, j], solid[CC, i, j]
            safe = _grown(safe, grown_r, mixed, grown_c)
            true = _blend(_grown(true, grown_r, mixed, grown_c), safe, positive)
            for values, kept in ((true, out), (safe, cycled)):
                kept[0, i, j], kept[1, i, j] = rr * values[0], rr * values[1]
                kept[2, i, j], kept[3, i, j] = rr * values[2], cc * values[3]
                kept[4, i, j], kept[5, i, j] = cc * values[4], cc * values[5]
                kept[6, i, j], kept[7, i, j] = rc * values[6], rc * values[7]
                kept[8, i, j], kept[9, i, j] = rc * values[8], rc * values[9]
                kept[10, i, j], kept[11, i, j], kept[12, i, j] = resists, 0.0, resists
            for k in range(8):
                out[13 + k, i, j] = 0.0
            if low < start:
                _, (_, down, right), (one, two, three, four) = walls(jacobians, start)
                factors = gain, gain * weight * down * cols, gain * weight * right * rows
                bends = weight * one, weight * two, weight * three, weight * four
                _add_walls(sides, about, factors, bends, positive, work, out, cycled, i, j)
            cycled[13, i, j] = 1.0
            if low < _CALM or e0 * e0 + e1 * e1 + f0 * f0 + f1 * f1 > _STRETCHED:
                for k in range(13):
                    tangent[k] = cycled[k, i, j]
                cycled[13, i, j] = max(1.0, _spread(tangent) / calm)


@disjoint_parallel
def tangents(thread, d, solid, about, positive, calm, out, cycled, count):
    """Compute the tangent of each element (21 numbers), and a positive tangent for cycles (13).

    The tangent in `out` is (1 - positive) times the exact tangent plus `positive` times the
    positive tangent. The last plane of `cycled` is the damping of the smoother: the norm of the
    element's matrix relative to `calm`, and at least 1.
    """
    height = d.shape[1] - 4
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, height)
        _tangent_part(d, solid, about, positive, calm, out, cycled, first + 2, last + 2)


@alone
def spread(tangent):
    """Return the norm of an element's matrix (13 numbers), scaled to a unit diagonal."""
    return _spread(tangent)
