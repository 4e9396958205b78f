"""Neo-Hookean volumes as compiled loops: energy, forces and second derivatives of all elements.

`solver.priors.finite_bricks` has the equations and the names. Displacements are planes in voxels,
and an element has the index of its first site (least plane, row and column).

`solid` has two numbers for each element, mu and lambda, both 0 in void. With growth it has eight:
mu and lambda times the growth of the volume, and the components 00, 01, 02, 11, 12 and 22 of the
matrix G that removes growth from the sides. `q` has the three factors of `BrickShape`.

Each step is one loop along a line of elements, which vectorises. Lines of scratch memory have a
constant distance, so that the compiler can exclude overlaps. Elements of even planes are processed
before those of odd planes, so that no two threads add to the same site.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import math
from typing import Any

import numpy as np

from napari_hmrf.solver.backends.cpu.bernstein import (
    barrier_energy,
    barrier_forces,
    longest_step,
)
from napari_hmrf.solver.backends.cpu.compiled import (
    by_parity,
    callee,
    portion,
    scratch_parallel,
    shared,
)
from napari_hmrf.solver.backends.cpu.forces import clear, planes_of, planes_of_turn

#: Number of elements of a block; a line of scratch memory has room for all elements of a block.
BLOCK = 64
STEP = BLOCK + 16
# Numbers of the scratch lines: seven modes of each component of the displacement, of a direction
# and of the pulls; the elastic parameters; and the matrix G, its square and its determinant.
MODES, WAYS, PULLS = 0, 21, 42
MU, LAM, VOLUME, RATE, LIVE, LOW, STRETCH, PRODUCT = 63, 64, 65, 66, 67, 68, 69, 70
GROWTH, SQUARE, GAIN, _LINES = 71, 77, 83, 84
# Numbers of the lines of the eight points, in a scratch array of their own: the Jacobian, the
# change of volume in a direction, and the derivative of the energy with respect to the Jacobian.
_JACOBIANS, _TILTS, _SLOPES, _POINT_LINES = 0, 8, 16, 24
#: Numbers in the scratch arrays of lines and of points.
FLOATS, POINTS = _LINES * STEP, _POINT_LINES * STEP
# Coordinate of a Gauss point along each axis.
_POINT = 1 / math.sqrt(3)
#: Least eigenvalue of second derivatives that are made positive, relative to mu.
LEAST = 0.01


@shared
def line(number):
    """Return the index at which a scratch line begins."""
    return number * STEP


@shared
def of_points(points, number):
    """Return a line of the points."""
    return points[number * STEP : (number + 1) * STEP]


@shared
def modes(d, z, y, begin, count, f, first):
    """Write the modes of a block of elements to scratch lines: 100, 010, 001, 110, 101, 011, 111.

    A mode is the sum over the corners of an element, with the sign of each along the mode's axes.
    """
    for k in range(3):
        past, at = begin + count + 1, line(first + 7 * k)
        a, b = d[k, z, y, begin:past], d[k, z, y + 1, begin:past]
        c, e = d[k, z + 1, y, begin:past], d[k, z + 1, y + 1, begin:past]
        for x in range(count):
            along_a, along_b = a[x + 1] - a[x], b[x + 1] - b[x]
            along_c, along_e = c[x + 1] - c[x], e[x + 1] - e[x]
            near = (b[x] - a[x]) + (b[x + 1] - a[x + 1])
            far = (e[x] - c[x]) + (e[x + 1] - c[x + 1])
            left = (c[x] - a[x]) + (c[x + 1] - a[x + 1])
            right = (e[x] - b[x]) + (e[x + 1] - b[x + 1])
            f[at + x] = left + right
            f[at + STEP + x] = near + far
            f[at + 2 * STEP + x] = (along_a + along_b) + (along_c + along_e)
            f[at + 3 * STEP + x] = right - left
            f[at + 4 * STEP + x] = (along_c - along_a) + (along_e - along_b)
            f[at + 5 * STEP + x] = (along_b - along_a) + (along_e - along_c)
            f[at + 6 * STEP + x] = (along_e - along_c) - (along_b - along_a)


@shared
def add_pulls(f, z, y, begin, count, out):
    """Add the forces of the modes of a block of elements to the sites."""
    for k in range(3):
        past, at = begin + count, line(PULLS + 7 * k)
        for corner in range(8):
            s, t, r = place(corner, f.dtype.type(1))
            shift = corner % 2
            force = out[k, z + corner // 4, y + corner % 4 // 2, begin + shift : past + shift]
            st, sr, tr, both = s * t, s * r, t * r, s * t * r
            for x in range(count):
                force[x] += (
                    (s * f[at + x] + t * f[at + STEP + x])
                    + (r * f[at + 2 * STEP + x] + st * f[at + 3 * STEP + x])
                    + (sr * f[at + 4 * STEP + x] + tr * f[at + 5 * STEP + x])
                    + both * f[at + 6 * STEP + x]
                )


@shared
def read_solid(solid, z, y, begin, count, f):
    """Copy the parameters of a block of elements to scratch lines; return whether any is tissue."""
    one, any_tissue = f.dtype.type, False
    mu, lam = solid[0, z, y, begin : begin + count], solid[1, z, y, begin : begin + count]
    for x in range(count):
        f[line(MU) + x], f[line(LAM) + x] = one(mu[x]), one(lam[x])
        f[line(LIVE) + x] = one(1) if mu[x] > 0 else one(0)
        any_tissue |= mu[x] > 0
    if solid.shape[0] == 2:
        for x in range(count):
            for n in range(6):
                value = one(1) if n == 0 or n == 3 or n == 5 else one(0)
                f[line(GROWTH + n) + x] = f[line(SQUARE + n) + x] = value
            f[line(GAIN) + x] = one(1)
        return any_tissue
    for x in range(count):
        a, b, c = solid[2, z, y, begin + x], solid[3, z, y, begin + x], solid[4, z, y, begin + x]
        p, s, t = solid[5, z, y, begin + x], solid[6, z, y, begin + x], solid[7, z, y, begin + x]
        if mu[x] <= 0:
            a, b, c, p, s, t = 1.0, 0.0, 0.0, 1.0, 0.0, 1.0
        f[line(GROWTH) + x], f[line(GROWTH + 1) + x] = one(a), one(b)
        f[line(GROWTH + 2) + x], f[line(GROWTH + 3) + x] = one(c), one(p)
        f[line(GROWTH + 4) + x], f[line(GROWTH + 5) + x] = one(s), one(t)
        f[line(SQUARE) + x] = one(a * a + b * b + c * c)
        f[line(SQUARE + 1) + x] = one(a * b + b * p + c * s)
        f[line(SQUARE + 2) + x] = one(a * c + b * s + c * t)
        f[line(SQUARE + 3) + x] = one(b * b + p * p + s * s)
        f[line(SQUARE + 4) + x] = one(b * c + p * s + s * t)
        f[line(SQUARE + 5) + x] = one(c * c + s * s + t * t)
        f[line(GAIN) + x] = one(a * (p * t - s * s) - b * (b * t - s * c) + c * (b * s - p * c))
    return any_tissue


@shared
def gradient(f, first, x, q, s, t, r):
    """Return the derivatives of one component along the three axes at a Gauss point."""
    at = line(first) + x
    both_110, both_101 = f[at + 3 * STEP], f[at + 4 * STEP]
    both_011, all_111 = f[at + 5 * STEP], f[at + 6 * STEP]
    return (
        q[0] * ((f[at] + t * both_110) + (r * both_101 + (t * r) * all_111)),
        q[1] * ((f[at + STEP] + s * both_110) + (r * both_011 + (s * r) * all_111)),
        q[2] * ((f[at + 2 * STEP] + s * both_101) + (t * both_011 + (s * t) * all_111)),
    )


@shared
def _gradients(f, first, x, q, s, t, r):
    """Return the nine derivatives of all components at a Gauss point, row by row."""
    a, b, c = gradient(f, first, x, q, s, t, r)
    e, g, h = gradient(f, first + 7, x, q, s, t, r)
    i, j, k = gradient(f, first + 14, x, q, s, t, r)
    return a, b, c, e, g, h, i, j, k


@shared
def deformed(f, x, q, s, t, r):
    """Return the nine components of F at a Gauss point of an element; the identity in void."""
    live, one = f[line(LIVE) + x], f.dtype.type(1)
    a, b, c, e, g, h, i, j, k = _gradients(f, MODES, x, q, s, t, r)
    return (
        one + live * a, live * b, live * c,
        live * e, one + live * g, live * h,
        live * i, live * j, one + live * k,
    )  # fmt: skip


@shared
def cofactor(m):
    """Return the cofactors of a matrix of nine numbers: the derivative of its determinant."""
    a, b, c, d, e, f, g, h, i = m
    return (
        e * i - f * h, f * g - d * i, d * h - e * g,
        c * h - b * i, a * i - c * g, b * g - a * h,
        b * f - c * e, c * d - a * f, a * e - b * d,
    )  # fmt: skip


@shared
def determinant(m):
    """Return the determinant of a matrix of nine numbers."""
    c0, c1 = m[4] * m[8] - m[5] * m[7], m[5] * m[6] - m[3] * m[8]
    return m[0] * c0 + m[1] * c1 + m[2] * (m[3] * m[7] - m[4] * m[6])


@shared
def product(m, w):
    """Return the sum of the products of the components of two matrices of nine numbers."""
    upper = (m[0] * w[0] + m[1] * w[1] + m[2] * w[2]) + (m[3] * w[3] + m[4] * w[4] + m[5] * w[5])
    return upper + (m[6] * w[6] + m[7] * w[7] + m[8] * w[8])


@shared
def _column_norms(m):
    """Return the norms of the three columns of a matrix of nine numbers."""
    return (
        math.sqrt(m[0] * m[0] + m[3] * m[3] + m[6] * m[6]),
        math.sqrt(m[1] * m[1] + m[4] * m[4] + m[7] * m[7]),
        math.sqrt(m[2] * m[2] + m[5] * m[5] + m[8] * m[8]),
    )


@shared
def twisted(m, w):
    """Return the derivative of the cofactors of `m` in the direction `w`; both have nine numbers.

    It is symmetric in `m` and `w`.
    """
    a, b, c, d, e, f, g, h, i = m
    o, p, q, r, s, t, u, v, w = w
    return (
        (e * w + s * i) - (f * v + t * h),
        (f * u + t * g) - (d * w + r * i),
        (d * v + r * h) - (e * u + s * g),
        (c * v + q * h) - (b * w + p * i),
        (a * w + o * i) - (c * u + q * g),
        (b * u + p * g) - (a * v + o * h),
        (b * t + p * f) - (c * s + q * e),
        (c * r + q * d) - (a * t + o * f),
        (a * s + o * e) - (b * r + p * d),
    )  # fmt: skip


@shared
def volumes(f, points, q, count):
    """Compute the Jacobian at each Gauss point, the volume, and a bound below all Jacobians."""
    point = f.dtype.type(_POINT)
    for x in range(count):
        f[line(VOLUME) + x] = 0
    for n in range(8):
        s, t, r = place(n, point)
        jacobians = of_points(points, _JACOBIANS + n)
        for x in range(count):
            m = deformed(f, x, q, s, t, r)
            jacobian = determinant(m)
            jacobians[x] = jacobian
            f[line(VOLUME) + x] += jacobian
    eighth = f.dtype.type(0.125)
    for x in range(count):
        f[line(VOLUME) + x] = f[line(GAIN) + x] * (eighth * f[line(VOLUME) + x])


@shared
def _spread_of(f, first, x, q):
    """Return bounds of the deviation of the three sides of an element from their means."""
    a = b = c = f.dtype.type(0)
    for k in range(3):
        at = line(first + 7 * k) + x
        m110, m101 = abs(f[at + 3 * STEP]), abs(f[at + 4 * STEP])
        m011, m111 = abs(f[at + 5 * STEP]), abs(f[at + 6 * STEP])
        a += (m110 + m101 + m111) ** 2
        b += (m110 + m011 + m111) ** 2
        c += (m101 + m011 + m111) ** 2
    return q[0] * math.sqrt(a), q[1] * math.sqrt(b), q[2] * math.sqrt(c)


@shared
def bound_below(f, q, count):
    """Compute a bound below the Jacobian everywhere in each element, with growth."""
    none = f.dtype.type(0)
    for x in range(count):
        m = deformed(f, x, q, none, none, none)
        mean = determinant(m)
        a, b, c = _column_norms(m)
        of_a, of_b, of_c = _spread_of(f, MODES, x, q)
        apart = (a + of_a) * (b + of_b) * (c + of_c) - a * b * c
        f[line(LOW) + x] = f[line(GAIN) + x] * (mean - f[line(LIVE) + x] * apart)


def sweep_of(read: Any, finish: Any) -> Any:
    """Return a loop over the blocks of elements of some planes.

    Parameters
    ----------
    read : callable
        Compiled function ``read(model, z, y, begin, count, f)`` that copies parameters of a block
        of elements to the scratch lines `f`, and returns whether any of them is tissue.
    finish : callable
        Compiled function ``finish(d, q, block, f, points, about)``, called for each block with
        tissue, when the modes of its displacement are in scratch lines. `block` is
        (z, y, begin, count). The loop passes on `about`.

    Returns
    -------
    callable
        Loop ``sweep(planes, d, model, q, like, about)`` in the precision of the array `like`.
    """

    @callee
    def sweep(planes, d, model, q, like, about):
        sides = q[0], q[1], q[2]
        f, points = np.zeros(FLOATS, like.dtype), np.zeros(POINTS, like.dtype)
        for z in planes:
            for y in range(2, d.shape[2] - 2):
                for begin in range(2, d.shape[3] - 2, BLOCK):
                    count = min(BLOCK, d.shape[3] - 2 - begin)
                    if read(model, z, y, begin, count, f):
                        modes(d, z, y, begin, count, f, MODES)
                        finish(d, sides, (z, y, begin, count), f, points, about)

    return sweep


@shared
def _add_energy(d, q, block, f, points, about):
    z, y, begin, count = block
    strength, start, energies, least, edges, net = about
    bound_below(f, q, count)
    volumes(f, points, q, count)
    for x in range(count):
        f[line(STRETCH) + x], f[line(PRODUCT) + x] = 0.0, 1.0
    for n in range(8):
        s, t, r = place(n, _POINT)
        jacobians = of_points(points, _JACOBIANS + n)
        for x in range(count):
            m = deformed(f, x, q, s, t, r)
            p = times_growth(f, SQUARE, x, m)
            f[line(STRETCH) + x] += product(m, p)
            f[line(PRODUCT) + x] *= f[line(GAIN) + x] * jacobians[x]
    total, lowest = energies[z - 2], least[z - 2]
    for x in range(count):
        mu, lam = f[line(MU) + x], f[line(LAM) + x]
        if mu <= 0:
            continue
        gain, low = f[line(GAIN) + x], f[line(LOW) + x]
        if low < start:
            low, wall = barrier_energy(d, z, y, begin + x, q, gain, start, edges, net)
            total += strength * mu * wall
        lowest = min(lowest, low)
        if low <= 0:
            continue
        volume = f[line(VOLUME) + x]
        total += 0.5 * mu * (0.125 * f[line(STRETCH) + x] - 3.0)
        total -= 0.125 * mu * math.log(f[line(PRODUCT) + x])
        total += lam * (0.25 * (volume * volume - 1.0) - 0.5 * math.log(volume))
    energies[z - 2], least[z - 2] = total, lowest


_energy_sweep = sweep_of(read_solid, _add_energy)


@scratch_parallel
def energy(thread, d, solid, q, barrier, energies, least):
    """Compute the energy of each plane of elements, and a bound below their Jacobians.

    The bound is the least Bernstein coefficient where it is less than the start of the barrier.
    Folded elements contribute no energy. `barrier` has the strength and the start of the barrier.
    """
    planes = planes_of(thread, d.shape[1])
    for z in planes:
        energies[z - 2], least[z - 2] = 0.0, np.inf
    about = (*barrier, energies, least, np.empty((3, 4, 3)), np.empty(27))
    _energy_sweep(planes, d, solid, q, d, about)


@shared
def clear_pulls(f, count):
    """Set the pulls of all modes to zero."""
    for n in range(21):
        for x in range(count):
            f[line(PULLS + n) + x] = 0


@shared
def place(n, far):
    """Return the coordinates of corner or Gauss point n, which are `far` or its negative."""
    return far if n >= 4 else -far, far if n % 4 >= 2 else -far, far if n % 2 else -far


@shared
def times_growth(f, first, x, m):
    """Return the product of `m` and a symmetric matrix in scratch lines, G or G G."""
    a, b, c = f[line(first) + x], f[line(first + 1) + x], f[line(first + 2) + x]
    e, g, h = f[line(first + 3) + x], f[line(first + 4) + x], f[line(first + 5) + x]
    return (
        m[0] * a + m[1] * b + m[2] * c,
        m[0] * b + m[1] * e + m[2] * g,
        m[0] * c + m[1] * g + m[2] * h,
        m[3] * a + m[4] * b + m[5] * c,
        m[3] * b + m[4] * e + m[5] * g,
        m[3] * c + m[4] * g + m[5] * h,
        m[6] * a + m[7] * b + m[8] * c,
        m[6] * b + m[7] * e + m[8] * g,
        m[6] * c + m[7] * g + m[8] * h,
    )


@shared
def _add_stress(f, x, k, q, s, t, r, a, b, c):
    """Add the stress of one component at a Gauss point to the pulls of its modes."""
    at = line(PULLS + 7 * k) + x
    a, b, c = q[0] * a, q[1] * b, q[2] * c
    f[at] += a
    f[at + STEP] += b
    f[at + 2 * STEP] += c
    f[at + 3 * STEP] += t * a + s * b
    f[at + 4 * STEP] += r * a + s * c
    f[at + 5 * STEP] += r * b + t * c
    f[at + 6 * STEP] += (t * r) * a + ((s * r) * b + (s * t) * c)


@shared
def _add_stresses(f, x, q, s, t, r, p):
    """Add the stress at a Gauss point, nine numbers, to the pulls of all modes."""
    _add_stress(f, x, 0, q, s, t, r, p[0], p[1], p[2])
    _add_stress(f, x, 1, q, s, t, r, p[3], p[4], p[5])
    _add_stress(f, x, 2, q, s, t, r, p[6], p[7], p[8])


@shared
def _combined(a, m, b, n, c, w):
    """Return a m + b n + c w, for matrices of nine numbers."""
    return (
        a * m[0] + (b * n[0] + c * w[0]),
        a * m[1] + (b * n[1] + c * w[1]),
        a * m[2] + (b * n[2] + c * w[2]),
        a * m[3] + (b * n[3] + c * w[3]),
        a * m[4] + (b * n[4] + c * w[4]),
        a * m[5] + (b * n[5] + c * w[5]),
        a * m[6] + (b * n[6] + c * w[6]),
        a * m[7] + (b * n[7] + c * w[7]),
        a * m[8] + (b * n[8] + c * w[8]),
    )


@shared
def _add_forces(d, q, block, f, points, about):
    z, y, begin, count = block
    strength, start, out, edges, net, pulls = about
    bound_below(f, q, count)
    volumes(f, points, q, count)
    clear_pulls(f, count)
    for n in range(8):
        s, t, r = place(n, _POINT)
        jacobians = of_points(points, _JACOBIANS + n)
        for x in range(count):
            m = deformed(f, x, q, s, t, r)
            cof = cofactor(m)
            volume, gain = f[line(VOLUME) + x], f[line(GAIN) + x]
            mu = 0.125 * f[line(MU) + x]
            slope = 0.0625 * f[line(LAM) + x] * gain * (volume - 1.0 / volume)
            slope -= mu / jacobians[x]
            same = times_growth(f, SQUARE, x, m)
            stresses = _combined(mu, same, slope, cof, 0.0, cof)
            _add_stresses(f, x, q, s, t, r, stresses)
    for x in range(count):
        if f[line(LOW) + x] < start and f[line(MU) + x] > 0:
            scale, gain = strength * f[line(MU) + x], f[line(GAIN) + x]
            barrier_forces(d, z, y, begin + x, q, gain, start, scale, edges, net, pulls, out)
    for n in range(21):
        for x in range(count):
            if f[line(MU) + x] <= 0:
                f[line(PULLS + n) + x] = 0.0
    add_pulls(f, z, y, begin, count, out)


_force_sweep = sweep_of(read_solid, _add_forces)


@by_parity
def forces(thread, d, solid, q, barrier, out):
    """Compute the gradient of the energy with respect to the displacement of each site."""
    if thread[2] == 0:
        clear(thread, out)
    else:
        edges, net, pulls = np.empty((3, 4, 3)), np.empty(27), np.empty((3, 4, 3))
        planes, about = planes_of_turn(thread, d.shape[1]), (*barrier, out, edges, net, pulls)
        _force_sweep(planes, d, solid, q, d, about)


@shared
def largest_stretch(m):
    """Return a bound above the largest singular value of a matrix of nine numbers."""
    a = m[0] * m[0] + m[3] * m[3] + m[6] * m[6]
    b = m[1] * m[1] + m[4] * m[4] + m[7] * m[7]
    c = m[2] * m[2] + m[5] * m[5] + m[8] * m[8]
    ab = m[0] * m[1] + m[3] * m[4] + m[6] * m[7]
    ac = m[0] * m[2] + m[3] * m[5] + m[6] * m[8]
    bc = m[1] * m[2] + m[4] * m[5] + m[7] * m[8]
    mean = (a + b + c) / 3
    a, b, c = a - mean, b - mean, c - mean
    apart = math.sqrt((a * a + b * b + c * c + 2 * (ab * ab + ac * ac + bc * bc)) / 6)
    return math.sqrt(mean + 2 * apart)


@shared
def _add_image(d, q, block, f, points, about):
    z, y, begin, count = block
    way, positive, out = about
    point, eighth, one = f.dtype.type(_POINT), f.dtype.type(0.125), f.dtype.type(1)
    half, most = f.dtype.type(0.5), f.dtype.type(1 - LEAST)
    modes(way, z, y, begin, count, f, WAYS)
    volumes(f, points, q, count)
    clear_pulls(f, count)
    for x in range(count):
        f[line(RATE) + x] = 0
    for n in range(8):
        s, t, r = place(n, point)
        jacobians = of_points(points, _JACOBIANS + n)
        tilts, slopes = of_points(points, _TILTS + n), of_points(points, _SLOPES + n)
        for x in range(count):
            m = deformed(f, x, q, s, t, r)
            cof = cofactor(m)
            w = _gradients(f, WAYS, x, q, s, t, r)
            tilt = product(cof, w)
            tilts[x] = tilt
            f[line(RATE) + x] += tilt
            volume = f[line(VOLUME) + x]
            slope = half * f[line(LAM) + x] * f[line(GAIN) + x] * (volume - one / volume)
            slope -= f[line(MU) + x] / jacobians[x]
            slopes[x] = slope
        if positive > 0:
            for x in range(count):
                m = times_growth(f, GROWTH, x, deformed(f, x, q, s, t, r))
                bound = most * f[line(MU) + x] * f[line(GAIN) + x] / largest_stretch(m)
                slope = slopes[x]
                safe = min(max(slope, -bound), bound)
                slopes[x] = slope + positive * (safe - slope)
    for n in range(8):
        s, t, r = place(n, point)
        jacobians = of_points(points, _JACOBIANS + n)
        tilts, slopes = of_points(points, _TILTS + n), of_points(points, _SLOPES + n)
        for x in range(count):
            m = deformed(f, x, q, s, t, r)
            cof = cofactor(m)
            w = _gradients(f, WAYS, x, q, s, t, r)
            turn = twisted(m, w)
            mu, jacobian = eighth * f[line(MU) + x], jacobians[x]
            slope = eighth * slopes[x]
            volume, gain = f[line(VOLUME) + x], f[line(GAIN) + x]
            bend = (mu / (jacobian * jacobian)) * tilts[x]
            stiff = half * f[line(LAM) + x] * (one + one / (volume * volume))
            bend += eighth * eighth * gain * gain * stiff * f[line(RATE) + x]
            same = times_growth(f, SQUARE, x, w)
            stresses = _combined(mu, same, slope, turn, bend, cof)
            _add_stresses(f, x, q, s, t, r, stresses)
    for n in range(21):
        for x in range(count):
            f[line(PULLS + n) + x] *= f[line(LIVE) + x]
    add_pulls(f, z, y, begin, count, out)


_image_sweep = sweep_of(read_solid, _add_image)


@by_parity
def image(thread, d, way, solid, q, positive, out):
    """Compute the second derivative of the energy in the direction `way`, without the barrier.

    `positive` is the share of the indefinite terms that is left out; with 1 the matrix is positive
    definite. The precision is that of `way`.
    """
    if thread[2] == 0:
        clear(thread, out)
    else:
        planes = planes_of_turn(thread, d.shape[1])
        _image_sweep(planes, d, solid, q, way, (way, positive, out))


@shared
def _shorten(d, q, block, f, points, about):
    z, y, begin, count = block
    way, part, floor, lengths, each, work = about
    none, least = 0.0, lengths[z - 2]
    modes(way, z, y, begin, count, f, WAYS)
    for x in range(count):
        m = deformed(f, x, q, none, none, none)
        mean = determinant(m)
        a, b, c = _column_norms(m)
        of_a, of_b, of_c = _spread_of(f, MODES, x, q)
        high = mean + (a + of_a) * (b + of_b) * (c + of_c) - a * b * c
        to_a, to_b, to_c = _spread_of(f, WAYS, x, q)
        by_a, by_b, by_c = _column_norms(_gradients(f, WAYS, x, q, none, none, none))
        to_a, to_b, to_c = to_a + of_a + by_a, to_b + of_b + by_b, to_c + of_c + by_c
        low = mean + a * b * c - (a + to_a) * (b + to_b) * (c + to_c)
        gain = f[line(GAIN) + x]
        f[line(LOW) + x] = gain * low - max(part * gain * high, min(gain * high, floor))
    for x in range(count):
        if f[line(MU) + x] <= 0:
            continue
        here = np.inf
        if f[line(LOW) + x] < 0:
            gain = f[line(GAIN) + x]
            here = longest_step(d, way, z, y, begin + x, q, part, floor, gain, work)
        if each.size > 0:
            each[z, y, begin + x] = here
        least = min(least, here)
    lengths[z - 2] = least


_length_sweep = sweep_of(read_solid, _shorten)


@scratch_parallel
def length(thread, d, way, solid, q, part, floor, plane_length, each):
    """Compute the largest step along `way` for each plane of elements, infinite if it is above 1.

    Each Bernstein coefficient stays at least `part` of its present value, and above `floor`; see
    `bernstein.longest_step`. Unless `each` is empty, it gets the largest step of each element.
    """
    planes = planes_of(thread, d.shape[1])
    for z in planes:
        plane_length[z - 2] = np.inf
    edges, ways, moved = np.empty((3, 4, 3)), np.empty((3, 4, 3)), np.empty((3, 4, 3))
    nets = np.empty((4, 27))
    work = edges, ways, moved, nets[0], nets[1], nets[2], nets[3]
    _length_sweep(planes, d, solid, q, d, (way, part, floor, plane_length, each, work))


@callee
def _element_matrix(d, solid, q, positive, z, y, x, f, points, slopes, tilts, rate, out):
    """Compute the second derivatives of one element, (24, 24); see `image`."""
    read_solid(solid, z, y, x, 1, f)
    modes(d, z, y, x, 1, f, MODES)
    volumes(f, points, q, 1)
    mu, lam, gain, volume = f[line(MU)], f[line(LAM)], f[line(GAIN)], f[line(VOLUME)]
    out[:] = 0.0
    rate[:] = 0.0
    square = (
        f[line(SQUARE)], f[line(SQUARE + 1)], f[line(SQUARE + 2)],
        f[line(SQUARE + 3)], f[line(SQUARE + 4)], f[line(SQUARE + 5)],
    )  # fmt: skip
    pressure = 0.5 * lam * gain * (volume - 1.0 / volume)
    for n in range(8):
        s, t, r = place(n, _POINT)
        jacobian = of_points(points, _JACOBIANS + n)[0]
        m = deformed(f, 0, q, s, t, r)
        c = cofactor(m)
        bound = (1 - LEAST) * mu * gain / largest_stretch(times_growth(f, GROWTH, 0, m))
        slope = pressure - mu / jacobian
        slope += positive * (min(max(slope, -bound), bound) - slope)
        for corner in range(8):
            a, b, e = place(corner, 1.0)
            slopes[corner, 0] = q[0] * a * (1 + b * t) * (1 + e * r)
            slopes[corner, 1] = q[1] * b * (1 + a * s) * (1 + e * r)
            slopes[corner, 2] = q[2] * e * (1 + a * s) * (1 + b * t)
            for k in range(3):
                tilt = c[3 * k] * slopes[corner, 0] + c[3 * k + 1] * slopes[corner, 1]
                tilt += c[3 * k + 2] * slopes[corner, 2]
                tilts[3 * corner + k] = tilt
                rate[3 * corner + k] += 0.125 * gain * tilt
        bend = 0.125 * mu / (jacobian * jacobian)
        for i in range(24):
            for j in range(24):
                out[i, j] += bend * tilts[i] * tilts[j]
        for one in range(8):
            u0, u1, u2 = slopes[one, 0], slopes[one, 1], slopes[one, 2]
            for two in range(8):
                v0, v1, v2 = slopes[two, 0], slopes[two, 1], slopes[two, 2]
                own = u0 * (square[0] * v0 + square[1] * v1 + square[2] * v2)
                own += u1 * (square[1] * v0 + square[3] * v1 + square[4] * v2)
                own += u2 * (square[2] * v0 + square[4] * v1 + square[5] * v2)
                own *= 0.125 * mu
                # The direction normal to both slopes, deformed, couples different components.
                w0, w1, w2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
                g0 = 0.125 * slope * (m[0] * w0 + m[1] * w1 + m[2] * w2)
                g1 = 0.125 * slope * (m[3] * w0 + m[4] * w1 + m[5] * w2)
                g2 = 0.125 * slope * (m[6] * w0 + m[7] * w1 + m[8] * w2)
                i, j = 3 * one, 3 * two
                out[i, j] += own
                out[i + 1, j + 1] += own
                out[i + 2, j + 2] += own
                out[i, j + 1] += g2
                out[i + 1, j] -= g2
                out[i + 1, j + 2] += g0
                out[i + 2, j + 1] -= g0
                out[i + 2, j] += g1
                out[i, j + 2] -= g1
    bulk = 0.5 * lam * (1.0 + 1.0 / (volume * volume))
    for i in range(24):
        for j in range(24):
            out[i, j] += bulk * rate[i] * rate[j]


@scratch_parallel
def add_element_matrices(thread, d, elements, solid, q, positive, out):
    """Add the second derivatives of some elements, as in `image`, to `out`, (N, 24, 24).

    The order of components is that of `bernstein.barrier_matrices`.
    """
    for n in portion(thread, len(elements)):
        f, points, made = np.zeros(FLOATS), np.zeros(POINTS), np.empty((24, 24))
        slopes, tilts, rate = np.empty((8, 3)), np.empty(24), np.empty(24)
        z, y, x = elements[n]
        _element_matrix(d, solid, q, positive, z, y, x, f, points, slopes, tilts, rate, made)
        out[n] += made
