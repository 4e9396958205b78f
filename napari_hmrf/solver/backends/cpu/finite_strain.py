"""Neo-Hookean tissue as compiled loops in double precision: energy, forces, tangents, lengths.

`solver.priors.finite_strain` has the equations and the names. Displacements are planes of pixels,
and an element has the number of its first site. `mu` is 0 in elements that do not exist, `lam` is
Lame's lambda as of a volume; `twist` is what resists half the square of an element's twist. `about`
is half of one over the sides of a pixel, whether tissue may bulge out of the plane, and the
strength and the beginning of the barrier.

A tangent is that of the differences D_r, D_c, D_x of an element, two components each: the numbers
RR (3), CC (3), RC (4), XX (3), and RX (4), CX (4).
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import math

import numpy as np
from numba import prange

from napari_hmrf.solver.backends.cpu.compiled import alone, callee, inline, parallel

#: What a tangent that is made positive keeps of mu at least.
_LEAST = 0.05
# Elements all of whose corners keep this Jacobian, and that are not stretched, are as at rest.
_CALM = 0.9


@inline
def _deformed(d, i, j, rows, cols):
    """What the sides (per pixel) and the twist of element (i, j) have become."""
    left_0, right_0 = d[0, i + 1, j] - d[0, i, j], d[0, i + 1, j + 1] - d[0, i, j + 1]
    left_1, right_1 = d[1, i + 1, j] - d[1, i, j], d[1, i + 1, j + 1] - d[1, i, j + 1]
    top_0, low_0 = d[0, i, j + 1] - d[0, i, j], d[0, i + 1, j + 1] - d[0, i + 1, j]
    top_1, low_1 = d[1, i, j + 1] - d[1, i, j], d[1, i + 1, j + 1] - d[1, i + 1, j]
    return (
        1.0 + rows * (left_0 + right_0),
        rows * (left_1 + right_1),
        cols * (top_0 + low_0),
        1.0 + cols * (top_1 + low_1),
        right_0 - left_0,
        right_1 - left_1,
    )


@inline
def _volumes(a0, a1, b0, b1, x0, x1, rows, cols):
    """The mean Jacobian, and what it gains towards the next row and the next column of sites."""
    return (
        a0 * b1 - a1 * b0,
        cols * (a0 * x1 - a1 * x0),
        rows * (x0 * b1 - x1 * b0),
    )


@inline
def _slope(j, mu, lam, bulges):
    """The first and the second derivative of the energy of a change of volume."""
    whole = mu + 0.5 * lam
    if bulges:
        thick = mu + 0.5 * lam * j * j
        return -whole * mu / (j * thick), whole * mu * (thick + lam * j * j) / (j * thick) ** 2
    return 0.5 * lam * j - whole / j, 0.5 * lam + whole / (j * j)


@inline
def _barrier(j, start):
    """The barrier of one corner: its value, and two derivatives."""
    if j >= start:
        return 0.0, 0.0, 0.0
    below, log = j - start, math.log(j / start)
    return (
        -below * below * log,
        -below * (2.0 * log + below / j),
        -2.0 * log - 4.0 * below / j + (below / j) ** 2,
    )


@callee
def _energy_part(d, mu, lam, twist, about, row_energy, row_least, first, last):
    rows, cols, bulges, strength, start = about
    for i in range(first + 2, last + 2):
        total, least = 0.0, np.inf
        for j in range(2, d.shape[2] - 2):
            shear = mu[i, j]
            if shear <= 0:
                continue
            a0, a1, b0, b1, x0, x1 = _deformed(d, i, j, rows, cols)
            mean, down, right = _volumes(a0, a1, b0, b1, x0, x1, rows, cols)
            low = mean - abs(down) - abs(right)
            least = min(least, low)
            if low <= 0:
                continue
            whole = shear + 0.5 * lam[i, j]
            # From that of rest: of what remains more digits are left.
            stretch = (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1) - 2.0
            if bulges:
                thick = (shear + 0.5 * lam[i, j] * mean * mean) / whole
                volume = whole * (0.5 * math.log(thick) - math.log(mean))
            else:
                volume = 0.25 * lam[i, j] * (mean * mean - 1.0) - whole * math.log(mean)
            here = 0.5 * shear * stretch + volume + 0.5 * twist[i, j] * (x0 * x0 + x1 * x1)
            if low < start:
                wall = (
                    _barrier(mean - down - right, start)[0]
                    + _barrier(mean - down + right, start)[0]
                    + _barrier(mean + down - right, start)[0]
                    + _barrier(mean + down + right, start)[0]
                )
                here += 0.25 * strength * shear * wall
            total += here
        row_energy[i - 2] = total
        row_least[i - 2] = least


@parallel
def energy(d, mu, lam, twist, about, row_energy, row_least, count):
    """The energy of each row of elements, and its least corner Jacobian.

    Elements that have folded count as if they had no energy.
    """
    height = len(row_energy)
    for number in prange(count):
        first, last = number * height // count, (number + 1) * height // count
        _energy_part(d, mu, lam, twist, about, row_energy, row_least, first, last)


@callee
def _element_row(d, mu, lam, twist, about, i, out):
    """What row i of elements pulls with along D_r, D_c, D_x."""
    rows, cols, bulges, strength, start = about
    for j in range(2, d.shape[2] - 2):
        shear = mu[i, j]
        if shear <= 0:
            for k in range(6):
                out[k, j] = 0.0
            continue
        a0, a1, b0, b1, x0, x1 = _deformed(d, i, j, rows, cols)
        mean, down, right = _volumes(a0, a1, b0, b1, x0, x1, rows, cols)
        of_mean = _slope(mean, shear, lam[i, j], bulges)[0]
        of_down, of_right = 0.0, 0.0
        if mean - abs(down) - abs(right) < start:
            weight = 0.25 * strength * shear
            k00 = weight * _barrier(mean - down - right, start)[1]
            k01 = weight * _barrier(mean - down + right, start)[1]
            k10 = weight * _barrier(mean + down - right, start)[1]
            k11 = weight * _barrier(mean + down + right, start)[1]
            of_mean += (k00 + k01) + (k10 + k11)
            of_down = (k10 + k11) - (k00 + k01)
            of_right = (k01 + k11) - (k00 + k10)
        out[0, j] = rows * (shear * a0 + of_mean * b1 + of_down * cols * x1)
        out[1, j] = rows * (shear * a1 - of_mean * b0 - of_down * cols * x0)
        out[2, j] = cols * (shear * b0 - of_mean * a1 - of_right * rows * x1)
        out[3, j] = cols * (shear * b1 + of_mean * a0 + of_right * rows * x0)
        out[4, j] = twist[i, j] * x0 - of_down * cols * a1 + of_right * rows * b1
        out[5, j] = twist[i, j] * x1 + of_down * cols * a0 - of_right * rows * b0


@callee
def _forces_part(d, mu, lam, twist, about, out, first, last):
    width = d.shape[2]
    above, here = np.zeros((6, width)), np.zeros((6, width))
    _element_row(d, mu, lam, twist, about, first + 1, above)
    for i in range(first + 2, last + 2):
        _element_row(d, mu, lam, twist, about, i, here)
        for component in range(2):
            up_r, up_c, up_x = above[component], above[2 + component], above[4 + component]
            r, c, x = here[component], here[2 + component], here[4 + component]
            for j in range(2, width - 2):
                here_after = (x[j] - r[j] - c[j]) + (c[j - 1] - r[j - 1] - x[j - 1])
                before = (up_r[j] - up_c[j] - up_x[j]) + (up_r[j - 1] + up_c[j - 1] + up_x[j - 1])
                out[component, i, j] = here_after + before
        above, here = here, above


@parallel
def forces(d, mu, lam, twist, about, out, count):
    """The derivative of the energy by each site's displacement."""
    height = d.shape[1] - 4
    for number in prange(count):
        first, last = number * height // count, (number + 1) * height // count
        _forces_part(d, mu, lam, twist, about, out, first, last)


@inline
def _positive(a0, a1, b0, b1, shear, of_mean, bend):
    """The tangent of stretch and volume, with what is negative of it made small and positive."""
    # Of a conformal part P and another one Q the Jacobian is (P^2 - Q^2) / 2: in their directions
    # and across them the tangent is one block of two by two and two numbers.
    half = math.sqrt(0.5)
    p0, p1, q0, q1 = half * (a0 + b1), half * (a1 - b0), half * (a0 - b1), half * (a1 + b0)
    p, q = math.hypot(p0, p1), math.hypot(q0, q1)
    least = _LEAST * shear
    across_p, across_q = max(shear + of_mean, least), max(shear - of_mean, least)
    one = shear + of_mean + bend * p * p
    two = shear - of_mean + bend * q * q
    both = -bend * p * q
    middle, apart = 0.5 * (one + two), math.hypot(0.5 * (one - two), both)
    low, high = middle - apart, middle + apart
    if low < least:
        kept_low, kept_high = max(low, least), max(high, least)
        # What the eigenvalues become, by their projections.
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
    # Back: a0 = (P0 + Q0) / sqrt 2, a1 = (P1 + Q1) / sqrt 2, b0 = (Q1 - P1) / sqrt 2, and so on.
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
    """The tangent of stretch and volume as it is."""
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
def _entry(t, p, q, s, t_, u, v):
    """An entry of an element's matrix: component p of corner (s, t_), q of (u, v)."""
    along_rows, along_cols, twist = t[p + q], t[3 + p + q], t[10 + p + q]
    mixed = s * v * t[6 + 2 * p + q] + t_ * u * t[6 + 2 * q + p]
    return (s * u * along_rows + t_ * v * along_cols) + (mixed + s * t_ * u * v * twist)


@callee
def _spread(t):
    """The norm of an element's matrix, scaled to a diagonal of ones: no less than its spectrum."""
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
def _tangent_part(d, mu, lam, twist, about, positive, calm, out, cycled, first, last):
    rows, cols, bulges, strength, start = about
    way, image, sums = np.zeros((3, 6)), np.zeros((3, 6)), np.zeros((3, 3))
    full, tangent = np.zeros((6, 6)), np.zeros(13)
    rr, cc, rc = rows * rows, cols * cols, rows * cols
    for i in range(first + 2, last + 2):
        for j in range(2, d.shape[2] - 2):
            shear = mu[i, j]
            if shear <= 0:
                continue
            a0, a1, b0, b1, x0, x1 = _deformed(d, i, j, rows, cols)
            mean, down, right = _volumes(a0, a1, b0, b1, x0, x1, rows, cols)
            of_mean, bend = _slope(mean, shear, lam[i, j], bulges)
            of_down, of_right = 0.0, 0.0
            walled = mean - abs(down) - abs(right) < start
            if walled:
                weight = 0.25 * strength * shear
                sums[:] = 0.0
                for corner in range(4):
                    s, t = (1.0 if corner >= 2 else -1.0), (1.0 if corner % 2 else -1.0)
                    _, one, two = _barrier(mean + s * down + t * right, start)
                    of_mean += weight * one
                    of_down += weight * s * one
                    of_right += weight * t * one
                    two *= weight
                    sums[0, 0] += two
                    sums[0, 1] += s * two
                    sums[0, 2] += t * two
                    sums[1, 2] += s * t * two
                sums[1, 0], sums[2, 0], sums[2, 1] = sums[0, 1], sums[0, 2], sums[1, 2]
                sums[1, 1] = sums[2, 2] = sums[0, 0]
                way[0, 0], way[0, 1], way[0, 2], way[0, 3] = b1, -b0, -a1, a0
                way[1, 0], way[1, 1] = cols * x1, -cols * x0
                way[1, 4], way[1, 5] = -cols * a1, cols * a0
                way[2, 2], way[2, 3] = -rows * x1, rows * x0
                way[2, 4], way[2, 5] = rows * b1, -rows * b0
                for k in range(3):
                    for n in range(6):
                        image[k, n] = (sums[k, 0] * way[0, n] + sums[k, 1] * way[1, n]) + sums[
                            k, 2
                        ] * way[2, n]
                for k in range(6):
                    for n in range(6):
                        full[k, n] = (way[0, k] * image[0, n] + way[1, k] * image[1, n]) + way[
                            2, k
                        ] * image[2, n]
            safe = _positive(a0, a1, b0, b1, shear, of_mean, bend)
            true = safe if positive else _exact(a0, a1, b0, b1, shear, of_mean, bend)
            resists = twist[i, j]
            out[10, i, j] = out[12, i, j] = cycled[10, i, j] = cycled[12, i, j] = resists
            out[11, i, j] = cycled[11, i, j] = 0.0
            for k in range(8):
                out[13 + k, i, j] = 0.0
            if walled:
                # The tangents of both are symmetric: of RR, CC and XX three numbers each.
                for values, kept in ((true, out), (safe, cycled)):
                    kept[0, i, j] = rr * (values[0] + full[0, 0])
                    kept[1, i, j] = rr * (values[1] + full[0, 1])
                    kept[2, i, j] = rr * (values[2] + full[1, 1])
                    kept[3, i, j] = cc * (values[3] + full[2, 2])
                    kept[4, i, j] = cc * (values[4] + full[2, 3])
                    kept[5, i, j] = cc * (values[5] + full[3, 3])
                    kept[6, i, j] = rc * (values[6] + full[0, 2])
                    kept[7, i, j] = rc * (values[7] + full[0, 3])
                    kept[8, i, j] = rc * (values[8] + full[1, 2])
                    kept[9, i, j] = rc * (values[9] + full[1, 3])
                    kept[10, i, j] = resists + full[4, 4]
                    kept[11, i, j] = full[4, 5]
                    kept[12, i, j] = resists + full[5, 5]
                if not positive:
                    full[0, 5] += of_down * cols
                    full[1, 4] -= of_down * cols
                    full[3, 4] += of_right * rows
                    full[2, 5] -= of_right * rows
                out[13, i, j], out[14, i, j] = rows * full[0, 4], rows * full[0, 5]
                out[15, i, j], out[16, i, j] = rows * full[1, 4], rows * full[1, 5]
                out[17, i, j], out[18, i, j] = cols * full[2, 4], cols * full[2, 5]
                out[19, i, j], out[20, i, j] = cols * full[3, 4], cols * full[3, 5]
            else:
                for values, kept in ((true, out), (safe, cycled)):
                    kept[0, i, j], kept[1, i, j] = rr * values[0], rr * values[1]
                    kept[2, i, j], kept[3, i, j] = rr * values[2], cc * values[3]
                    kept[4, i, j], kept[5, i, j] = cc * values[4], cc * values[5]
                    kept[6, i, j], kept[7, i, j] = rc * values[6], rc * values[7]
                    kept[8, i, j], kept[9, i, j] = rc * values[8], rc * values[9]
            cycled[13, i, j] = 1.0
            if mean - abs(down) - abs(right) < _CALM or a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1 > 2.3:
                for k in range(13):
                    tangent[k] = cycled[k, i, j]
                cycled[13, i, j] = max(1.0, _spread(tangent) / calm)


@parallel
def tangents(d, mu, lam, twist, about, positive, calm, out, cycled, count):
    """The tangent of each element (21 numbers), and one without what is negative for cycles (13).

    If `positive`, the first is without what is negative, too. A last plane of the second gets how
    much more its smoother must be damped than if it were at rest, where its spread is `calm`.
    """
    height = d.shape[1] - 4
    for number in prange(count):
        first, last = number * height // count, (number + 1) * height // count
        _tangent_part(d, mu, lam, twist, about, positive, calm, out, cycled, first, last)


@inline
def _until(now, slope, bend, part, floor):
    """How far along a way a corner keeps that part of its Jacobian, now + slope t + bend t^2."""
    # Nor may it fall below a floor; where it is below already, no further.
    c = now - max(part * now, min(now, floor))
    if c <= 0:
        return 0.0 if slope < 0 else np.inf
    # The least positive root of c + slope t + bend t^2, without cancellation.
    inside = slope * slope - 4.0 * bend * c
    if inside < 0:
        return np.inf
    root = math.sqrt(inside)
    if slope < 0:
        return 2.0 * c / (root - slope)
    if bend < 0:
        return -(slope + root) / (2.0 * bend)
    return np.inf


@callee
def _length_part(d, way, mu, about, part, floor, row_length, first, last, each):
    rows, cols = about[0], about[1]
    for i in range(first + 2, last + 2):
        least = np.inf
        for j in range(2, d.shape[2] - 2):
            if mu[i, j] <= 0:
                continue
            a0, a1, b0, b1, x0, x1 = _deformed(d, i, j, rows, cols)
            u0, u1, v0, v1, y0, y1 = _deformed(way, i, j, rows, cols)
            u0, v1 = u0 - 1.0, v1 - 1.0
            mean, down, right = _volumes(a0, a1, b0, b1, x0, x1, rows, cols)
            bend, bend_down, bend_right = _volumes(u0, u1, v0, v1, y0, y1, rows, cols)
            slope = (a0 * v1 - a1 * v0) + (u0 * b1 - u1 * b0)
            slope_down = cols * ((a0 * y1 - a1 * y0) + (u0 * x1 - u1 * x0))
            slope_right = rows * ((x0 * v1 - x1 * v0) + (y0 * b1 - y1 * b0))
            here = np.inf
            for corner in range(4):
                s, t = (1.0 if corner >= 2 else -1.0), (1.0 if corner % 2 else -1.0)
                here = min(
                    here,
                    _until(
                        mean + s * down + t * right,
                        slope + s * slope_down + t * slope_right,
                        bend + s * bend_down + t * bend_right,
                        part,
                        floor,
                    ),
                )
            if len(each) > 0:
                each[i, j] = here
            least = min(least, here)
        row_length[i - 2] = least


@parallel
def length(d, way, mu, about, part, floor, row_length, each, count):
    """How far along a way each row of elements keeps a part of its corners' Jacobians, and a floor.

    Where there are elements in `each`, it gets that of each of them.
    """
    height = len(row_length)
    for number in prange(count):
        first, last = number * height // count, (number + 1) * height // count
        _length_part(d, way, mu, about, part, floor, row_length, first, last, each)


@alone
def spread(tangent):
    """The norm of one element's matrix (13 numbers), scaled to a diagonal of ones."""
    return _spread(tangent)
