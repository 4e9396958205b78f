"""Bernstein coefficients of the Jacobian of a trilinear element, and the barrier that uses them.

The Jacobian of a trilinear element is quadratic in each of its three coordinates. Its 27
coefficients in the Bernstein basis bound it everywhere in the element: if all are positive, the
element is folded nowhere. Positive corners, which are eight of the coefficients, are not enough.

Let a_jk, b_ik and c_ij be the sides of the deformed element along the three axes, each divided by
its length at rest; the indices are 0 or 1 along the other two axes. A coefficient is the weighted
sum of the determinants of all triples whose indices add up to its own index:

    B_lmn = sum of w_l w_m w_n det(a_jk, b_ik', c_i'j'),  l = i + i', m = j + j', n = k + k'
    w = 1, 1/2, 1

The barrier of an element is the mean of b(J) over its coefficients, times growth if it grew:

    b(J) = -(J - J_0)^2 ln(J / J_0) for J < J_0, else 0
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import math

import numpy as np

from napari_hmrf.solver.backends.cpu.compiled import (
    alone,
    callee,
    portion,
    scratch_parallel,
    shared,
)
from napari_hmrf.solver.backends.cpu.finite_strain import barrier

_COUNT = 27
_MEAN = 1 / _COUNT


@shared
def _weight(l, m, n):  # noqa: E741
    return (0.5 if l == 1 else 1.0) * (0.5 if m == 1 else 1.0) * (0.5 if n == 1 else 1.0)


@callee
def sides_of(d, z, y, x, q, edges, rest):
    """Write the sides of an element to `edges`, (axis, side, component).

    `rest` is the length of a side without displacement: 1, or 0 for a direction.
    """
    for near in range(2):
        for far in range(2):
            side = 2 * near + far
            for k in range(3):
                own = rest if k == 0 else 0.0
                step = d[k, z + 1, y + near, x + far] - d[k, z, y + near, x + far]
                edges[0, side, k] = own + 4 * q[0] * step
                own = rest if k == 1 else 0.0
                step = d[k, z + near, y + 1, x + far] - d[k, z + near, y, x + far]
                edges[1, side, k] = own + 4 * q[1] * step
                own = rest if k == 2 else 0.0
                step = d[k, z + near, y + far, x + 1] - d[k, z + near, y + far, x]
                edges[2, side, k] = own + 4 * q[2] * step


@callee
def coefficients(edges, net):
    """Write the 27 Bernstein coefficients of the Jacobian to `net`; return the least."""
    for n in range(_COUNT):
        net[n] = 0.0
    for i in range(2):
        for k in range(2):
            b = edges[1, 2 * i + k]
            for other_i in range(2):
                for other_j in range(2):
                    c = edges[2, 2 * other_i + other_j]
                    p = b[1] * c[2] - b[2] * c[1]
                    r = b[2] * c[0] - b[0] * c[2]
                    s = b[0] * c[1] - b[1] * c[0]
                    for j in range(2):
                        for other_k in range(2):
                            a = edges[0, 2 * j + other_k]
                            l, m, n = i + other_i, j + other_j, k + other_k  # noqa: E741
                            det = a[0] * p + a[1] * r + a[2] * s
                            net[9 * l + 3 * m + n] += _weight(l, m, n) * det
    least = net[0]
    for n in range(1, _COUNT):
        least = min(least, net[n])
    return least


@callee
def least_of(d, z, y, x, q, gain, edges, net):
    """Return the least Bernstein coefficient of an element, with growth."""
    sides_of(d, z, y, x, q, edges, 1.0)
    return gain * coefficients(edges, net)


@callee
def barrier_energy(d, z, y, x, q, gain, start, edges, net):
    """Return the least Bernstein coefficient of an element and its barrier, both with growth."""
    least = least_of(d, z, y, x, q, gain, edges, net)
    wall = 0.0
    if 0 < least < start:
        for n in range(_COUNT):
            wall += barrier(gain * net[n], start)[0]
    return least, _MEAN * wall


@callee
def barrier_slopes(d, z, y, x, q, gain, start, edges, net):
    """Return the least coefficient of an element, and the mean derivatives of b over all."""
    least = least_of(d, z, y, x, q, gain, edges, net)
    first, second = 0.0, 0.0
    if 0 < least < start:
        for n in range(_COUNT):
            _, slope, bend = barrier(gain * net[n], start)
            first, second = first + slope, second + bend
    return least, _MEAN * first, _MEAN * second


@callee
def _spread_pull(edges, weights, pulls):
    """Compute the derivatives of a weighted sum of the coefficients with respect to the sides."""
    pulls[:] = 0.0
    for i in range(2):
        for k in range(2):
            b = edges[1, 2 * i + k]
            for other_i in range(2):
                for other_j in range(2):
                    c = edges[2, 2 * other_i + other_j]
                    for j in range(2):
                        for other_k in range(2):
                            l, m, n = i + other_i, j + other_j, k + other_k  # noqa: E741
                            share = weights[9 * l + 3 * m + n]
                            if share == 0:
                                continue
                            share *= _weight(l, m, n)
                            a = edges[0, 2 * j + other_k]
                            for e in range(3):
                                f, g = (e + 1) % 3, (e + 2) % 3
                                pulls[0, 2 * j + other_k, e] += share * (b[f] * c[g] - b[g] * c[f])
                                pulls[1, 2 * i + k, e] += share * (c[f] * a[g] - c[g] * a[f])
                                pulls[2, 2 * other_i + other_j, e] += share * (
                                    a[f] * b[g] - a[g] * b[f]
                                )


@callee
def barrier_forces(d, z, y, x, q, gain, start, scale, edges, net, pulls, out):
    """Add the derivatives of `scale` times the barrier of an element to the forces at its sites."""
    least = least_of(d, z, y, x, q, gain, edges, net)
    if least >= start or least <= 0:
        return
    for n in range(_COUNT):
        net[n] = scale * _MEAN * gain * barrier(gain * net[n], start)[1]
    _spread_pull(edges, net, pulls)
    for near in range(2):
        for far in range(2):
            side = 2 * near + far
            for k in range(3):
                pull = 4 * q[0] * pulls[0, side, k]
                out[k, z + 1, y + near, x + far] += pull
                out[k, z, y + near, x + far] -= pull
                pull = 4 * q[1] * pulls[1, side, k]
                out[k, z + near, y + 1, x + far] += pull
                out[k, z + near, y, x + far] -= pull
                pull = 4 * q[2] * pulls[2, side, k]
                out[k, z + near, y + far, x + 1] += pull
                out[k, z + near, y + far, x] -= pull


# Indices of the corners, 4 i + 2 j + k, at the end and at the begin of each side.
_ENDS = np.array(
    [
        [[4, 0], [5, 1], [6, 2], [7, 3]],
        [[2, 0], [3, 1], [6, 4], [7, 5]],
        [[1, 0], [3, 2], [5, 4], [7, 6]],
    ]
)


@callee
def _to_corners(pulls, q, out):
    """Convert derivatives with respect to the sides into derivatives at the corners, (24,)."""
    out[:] = 0.0
    for axis in range(3):
        for side in range(4):
            end, begin = _ENDS[axis, side, 0], _ENDS[axis, side, 1]
            for k in range(3):
                pull = 4 * q[axis] * pulls[axis, side, k]
                out[3 * end + k] += pull
                out[3 * begin + k] -= pull


@callee
def _barrier_matrix(d, z, y, x, q, gain, start, scale, positive, work, out):
    """Compute the second derivatives of `scale` times the barrier of an element, (24, 24)."""
    edges, net, weights, pulls, moved, gradient = work
    least = least_of(d, z, y, x, q, gain, edges, net)
    out[:] = 0
    if least <= 0:
        return least
    slopes = np.zeros(_COUNT)
    for n in range(_COUNT):
        if gain * net[n] >= start:
            continue
        _, slope, bend = barrier(gain * net[n], start)
        slopes[n] = scale * _MEAN * gain * slope
        bend *= scale * _MEAN * gain * gain
        weights[:] = 0.0
        weights[n] = 1.0
        _spread_pull(edges, weights, pulls)
        _to_corners(pulls, q, gradient)
        for i in range(24):
            for j in range(24):
                out[i, j] += bend * gradient[i] * gradient[j]
    if positive < 1:
        # The coefficients are linear in each side, so differences of their derivatives are exact.
        for corner in range(8):
            for k in range(3):
                _move(edges, moved, corner, k, q, 0.5)
                _spread_pull(moved, slopes, pulls)
                _to_corners(pulls, q, gradient)
                for i in range(24):
                    out[3 * corner + k, i] += (1 - positive) * gradient[i]
                _move(edges, moved, corner, k, q, -0.5)
                _spread_pull(moved, slopes, pulls)
                _to_corners(pulls, q, gradient)
                for i in range(24):
                    out[3 * corner + k, i] -= (1 - positive) * gradient[i]
    return least


@callee
def _move(edges, moved, corner, k, q, far):
    """Copy the sides of an element, with one component of one corner moved."""
    moved[:] = edges
    for axis in range(3):
        for side in range(4):
            if _ENDS[axis, side, 0] == corner:
                moved[axis, side, k] += 4 * q[axis] * far
            if _ENDS[axis, side, 1] == corner:
                moved[axis, side, k] -= 4 * q[axis] * far


@scratch_parallel
def barrier_matrices(thread, d, elements, gains, scales, q, start, positive, out):
    """Compute the second derivatives of the barrier of some elements, (N, 24, 24).

    `elements` has the indices (z, y, x) of each in padded arrays. The order of the 24 components is
    that of the corners 000, 001, 010 ... 111, with three components each.
    """
    sides = q[0], q[1], q[2]
    for n in portion(thread, len(elements)):
        edges, net, weights = np.empty((3, 4, 3)), np.empty(27), np.empty(27)
        pulls, moved, gradient = np.empty((3, 4, 3)), np.empty((3, 4, 3)), np.empty(24)
        work = edges, net, weights, pulls, moved, gradient
        made = np.empty((24, 24))
        z, y, x = elements[n]
        _barrier_matrix(d, z, y, x, sides, gains[n], start, scales[n], positive, work, made)
        out[n] = made


@alone
def add_images(way, elements, matrices, out):
    """Add the product of each element's matrix and a direction to `out`."""
    values, made = np.empty(24, dtype=way.dtype), np.empty(24, dtype=way.dtype)
    for n in range(len(elements)):
        z, y, x = elements[n]
        for c in range(8):
            for k in range(3):
                values[3 * c + k] = way[k, z + c // 4, y + c % 4 // 2, x + c % 2]
        for i in range(24):
            total = way.dtype.type(0)
            for j in range(24):
                total += matrices[n, i, j] * values[j]
            made[i] = total
        for c in range(8):
            for k in range(3):
                out[k, z + c // 4, y + c % 4 // 2, x + c % 2] += made[3 * c + k]


@shared
def _cubic(c0, c1, c2, c3, t):
    return ((c3 * t + c2) * t + c1) * t + c0


@callee
def _first_root(c0, c1, c2, c3):
    """Return the least step t in (0, 1] at which a cubic falls below 0; infinite if none."""
    if c0 <= 0:
        return 0.0 if c1 < 0 or (c1 == 0 and c2 < 0) else np.inf
    # The cubic is monotone between the roots of its derivative.
    a, b, c = 3 * c3, 2 * c2, c1
    first, second = 1.0, 1.0
    if abs(a) < 1e-300:
        if b != 0:
            first = -c / b
    else:
        inside = b * b - 4 * a * c
        if inside > 0:
            root = math.sqrt(inside)
            half = -0.5 * (b + math.copysign(root, b))
            one, two = half / a, (c / half if half != 0 else half / a)
            first, second = min(one, two), max(one, two)
    low = 0.0
    for stop in range(3):
        high = first if stop == 0 else (second if stop == 1 else 1.0)
        high = min(high, 1.0)
        if high <= low:
            continue
        if _cubic(c0, c1, c2, c3, high) < 0:
            for _ in range(60):
                middle = 0.5 * (low + high)
                if _cubic(c0, c1, c2, c3, middle) < 0:
                    high = middle
                else:
                    low = middle
            return low
        low = high
    return np.inf


@callee
def longest_step(d, way, z, y, x, q, part, floor, gain, work):
    """Return the largest step along `way` for an element, infinite if it is above 1.

    Each coefficient stays at least `part` of its present value, and above `floor`. A coefficient
    below the floor must keep its present value.
    """
    edges, ways, moved, now, after, before, twice = work
    sides_of(d, z, y, x, q, edges, 1.0)
    sides_of(way, z, y, x, q, ways, 0.0)
    coefficients(edges, now)
    # Values at the steps 1, -1 and 2 determine the cubic of each coefficient.
    for step, net in ((1.0, after), (-1.0, before), (2.0, twice)):
        for axis in range(3):
            for side in range(4):
                for k in range(3):
                    moved[axis, side, k] = edges[axis, side, k] + step * ways[axis, side, k]
        coefficients(moved, net)
    least = np.inf
    for n in range(_COUNT):
        value = gain * now[n]
        even = 0.5 * (after[n] + before[n]) - now[n]
        odd = 0.5 * (after[n] - before[n])
        third = (twice[n] - now[n] - 4 * even - 2 * odd) / 6
        bound = max(part * value, min(value, floor))
        step = _first_root(value - bound, gain * (odd - third), gain * even, gain * third)
        least = min(least, step)
    return least


@alone
def add_diagonals(elements, matrices, out):
    """Add the diagonal of each element's matrix, times the norm of its scaled matrix, to `out`.

    The norm is that of the matrix scaled to a diagonal of ones, so that the smoother stays stable.
    """
    way = np.empty(24)
    for n in range(len(elements)):
        z, y, x = elements[n]
        for i in range(24):
            way[i] = 1.0
        norm = 1.0
        for _ in range(4):
            total = 0.0
            for i in range(24):
                total += way[i] * way[i]
            total = 1.0 / math.sqrt(total) if total > 0 else 0.0
            for i in range(24):
                way[i] *= total
            made = np.zeros(24)
            for i in range(24):
                if matrices[n, i, i] <= 0:
                    continue
                for j in range(24):
                    if matrices[n, j, j] > 0:
                        scale = math.sqrt(matrices[n, i, i] * matrices[n, j, j])
                        made[i] += matrices[n, i, j] / scale * way[j]
            norm = 0.0
            for i in range(24):
                norm += made[i] * way[i]
                way[i] = made[i]
        for c in range(8):
            for k in range(3):
                own = matrices[n, 3 * c + k, 3 * c + k] * max(norm, 1.0)
                out[k, z + c // 4, y + c % 4 // 2, x + c % 2] += np.float32(own)
