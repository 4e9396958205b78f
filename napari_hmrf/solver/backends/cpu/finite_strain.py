"""Compiled loops in double precision for Neo-Hookean tissue: energy, forces and step lengths.

`solver.priors.finite_strain` documents the equations and names. Displacements are planes in pixels,
and an element has the index of its first site.

`solid` contains seven numbers per element, in the order of `Moduli`: mu, which is 0 if the element
does not exist; the Lame parameter lambda of a volume; the coefficient of the volume term at rest;
the stiffness of the twist, which multiplies half its square; and the components RR, RC and CC of
the matrix that removes growth from the sides. `about` contains five numbers: 1 / (2 side) for the
row side and the column side of a pixel; True if tissue may bulge out of the plane; and the strength
and threshold of the barrier.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import math

import numpy as np

from napari_hmrf.solver.backends.cpu.compiled import (
    bounds_of_part,
    callee,
    disjoint_parallel,
    inline,
    portion,
)

# Indices of the parameters of an element in `solid`.
SHEAR, FIRST, WHOLE, TWIST, RR, RC, CC = np.arange(7)


@inline
def deformed(d, i, j, rows, cols):
    """Return the deformed sides (per undeformed side) and the twist of element (i, j)."""
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
def volumes(a0, a1, b0, b1, x0, x1, rows, cols):
    """Return the mean Jacobian and its increments toward the next row and the next column."""
    return (
        a0 * b1 - a1 * b0,
        cols * (a0 * x1 - a1 * x0),
        rows * (x0 * b1 - x1 * b0),
    )


@inline
def elastic(a0, a1, b0, b1, solid, i, j):
    """Return the sides without growth, and the factor that removes growth from a Jacobian."""
    rr, rc, cc = solid[RR, i, j], solid[RC, i, j], solid[CC, i, j]
    return (
        rr * a0 + rc * b0,
        rr * a1 + rc * b1,
        rc * a0 + cc * b0,
        rc * a1 + cc * b1,
        rr * cc - rc * rc,
    )


@inline
def bulk(j, mu, lam, whole, bulges):
    """Return the first and second derivatives of the volume term with respect to Jacobian j."""
    if bulges:
        thick = mu + 0.5 * lam * j * j
        return -whole * mu / (j * thick), whole * mu * (thick + lam * j * j) / (j * thick) ** 2
    return 0.5 * lam * j - whole / j, 0.5 * lam + whole / (j * j)


@inline
def barrier(j, start):
    """Return the barrier function of one corner and its first two derivatives."""
    if j >= start:
        return 0.0, 0.0, 0.0
    below, log = j - start, math.log(j / start)
    return (
        -below * below * log,
        -below * (2.0 * log + below / j),
        -2.0 * log - 4.0 * below / j + (below / j) ** 2,
    )


@callee
def _energy_part(d, solid, about, row_energy, row_least, first, last):
    rows, cols, bulges, strength, start = about
    for i in range(first + 2, last + 2):
        total, least = 0.0, np.inf
        for j in range(2, d.shape[2] - 2):
            shear = solid[SHEAR, i, j]
            if shear <= 0:
                continue
            a0, a1, b0, b1, x0, x1 = deformed(d, i, j, rows, cols)
            mean, down, right = volumes(a0, a1, b0, b1, x0, x1, rows, cols)
            low = mean - abs(down) - abs(right)
            least = min(least, low)
            if low <= 0:
                continue
            a0, a1, b0, b1, gain = elastic(a0, a1, b0, b1, solid, i, j)
            mean, down, right, low = gain * mean, gain * down, gain * right, gain * low
            lam, whole = solid[FIRST, i, j], solid[WHOLE, i, j]
            # Computing the energy relative to the rest state preserves more digits.
            stretch = (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1) - 2.0
            if bulges:
                thick = (shear + 0.5 * lam * mean * mean) / whole
                volume = whole * (0.5 * math.log(thick) - math.log(mean))
            else:
                volume = 0.25 * lam * (mean * mean - 1.0) - whole * math.log(mean)
            here = 0.5 * shear * stretch + volume
            here += 0.5 * solid[TWIST, i, j] * (x0 * x0 + x1 * x1)
            if low < start:
                wall = (
                    barrier(mean - down - right, start)[0]
                    + barrier(mean - down + right, start)[0]
                    + barrier(mean + down - right, start)[0]
                    + barrier(mean + down + right, start)[0]
                )
                here += 0.25 * strength * shear * wall
            total += here
        row_energy[i - 2] = total
        row_least[i - 2] = least


@disjoint_parallel
def energy(thread, d, solid, about, row_energy, row_least, count):
    """Compute the energy and the smallest corner Jacobian of each row of elements.

    The Jacobian includes growth. Folded elements contribute no energy.
    """
    height = len(row_energy)
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, height)
        _energy_part(d, solid, about, row_energy, row_least, first, last)


@callee
def _element_row(d, solid, about, i, out):
    """Compute the derivatives of the energy with respect to D_r, D_c, D_x for element row i."""
    rows, cols, bulges, strength, start = about
    for j in range(2, d.shape[2] - 2):
        shear = solid[SHEAR, i, j]
        if shear <= 0:
            for k in range(6):
                out[k, j] = 0.0
            continue
        a0, a1, b0, b1, x0, x1 = deformed(d, i, j, rows, cols)
        e0, e1, f0, f1, gain = elastic(a0, a1, b0, b1, solid, i, j)
        mean, down, right = volumes(a0, a1, b0, b1, x0, x1, rows, cols)
        mean, down, right = gain * mean, gain * down, gain * right
        of_mean = bulk(mean, shear, solid[FIRST, i, j], solid[WHOLE, i, j], bulges)[0]
        of_down, of_right = 0.0, 0.0
        if mean - abs(down) - abs(right) < start:
            weight = 0.25 * strength * shear
            k00 = weight * barrier(mean - down - right, start)[1]
            k01 = weight * barrier(mean - down + right, start)[1]
            k10 = weight * barrier(mean + down - right, start)[1]
            k11 = weight * barrier(mean + down + right, start)[1]
            of_mean += (k00 + k01) + (k10 + k11)
            of_down = (k10 + k11) - (k00 + k01)
            of_right = (k01 + k11) - (k00 + k10)
        of_mean, of_down, of_right = gain * of_mean, gain * of_down * cols, gain * of_right * rows
        rr, rc, cc = shear * solid[RR, i, j], shear * solid[RC, i, j], shear * solid[CC, i, j]
        twist = solid[TWIST, i, j]
        out[0, j] = rows * (rr * e0 + rc * f0 + of_mean * b1 + of_down * x1)
        out[1, j] = rows * (rr * e1 + rc * f1 - of_mean * b0 - of_down * x0)
        out[2, j] = cols * (rc * e0 + cc * f0 - of_mean * a1 - of_right * x1)
        out[3, j] = cols * (rc * e1 + cc * f1 + of_mean * a0 + of_right * x0)
        out[4, j] = twist * x0 - of_down * a1 + of_right * b1
        out[5, j] = twist * x1 + of_down * a0 - of_right * b0


@callee
def _forces_part(d, solid, about, out, first, last):
    width = d.shape[2]
    above, here = np.zeros((6, width)), np.zeros((6, width))
    _element_row(d, solid, about, first + 1, above)
    for i in range(first + 2, last + 2):
        _element_row(d, solid, about, i, here)
        for component in range(2):
            up_r, up_c, up_x = above[component], above[2 + component], above[4 + component]
            r, c, x = here[component], here[2 + component], here[4 + component]
            for j in range(2, width - 2):
                here_after = (x[j] - r[j] - c[j]) + (c[j - 1] - r[j - 1] - x[j - 1])
                before = (up_r[j] - up_c[j] - up_x[j]) + (up_r[j - 1] + up_c[j - 1] + up_x[j - 1])
                out[component, i, j] = here_after + before
        above, here = here, above


@disjoint_parallel
def forces(thread, d, solid, about, out, count):
    """Compute the gradient of the energy with respect to the displacement of each site."""
    height = d.shape[1] - 4
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, height)
        _forces_part(d, solid, about, out, first, last)


@inline
def _until(now, slope, bend, part, floor):
    """Return the step t at which a corner's Jacobian decreases to its lower bound.

    The Jacobian is ``now + slope * t + bend * t**2``. The bound is ``max(part * now, floor)``, or
    `now` itself if `now` is already below the floor.
    """
    c = now - max(part * now, min(now, floor))
    if c <= 0:
        if slope < 0:
            return 0.0
        # A Jacobian that increases at first may still decrease to zero later in the step.
        return -slope / bend if bend < 0 else np.inf
    # Smallest positive root of c + slope t + bend t^2, in a form without cancellation.
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
def _length_part(d, way, solid, about, part, floor, row_length, first, last, each):
    rows, cols = about[0], about[1]
    for i in range(first + 2, last + 2):
        least = np.inf
        for j in range(2, d.shape[2] - 2):
            if solid[SHEAR, i, j] <= 0:
                continue
            a0, a1, b0, b1, x0, x1 = deformed(d, i, j, rows, cols)
            u0, u1, v0, v1, y0, y1 = deformed(way, i, j, rows, cols)
            u0, v1 = u0 - 1.0, v1 - 1.0
            mean, down, right = volumes(a0, a1, b0, b1, x0, x1, rows, cols)
            bend, bend_down, bend_right = volumes(u0, u1, v0, v1, y0, y1, rows, cols)
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


@disjoint_parallel
def length(thread, d, way, solid, about, part, floor, row_length, each, count):
    """Compute the largest valid step along `way` for each row of elements.

    A step is valid if each corner Jacobian stays above `part` times its current value and above
    `floor`. If `each` is not empty, the largest step of each element is stored in it.
    """
    height = len(row_length)
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, height)
        _length_part(d, way, solid, about, part, floor, row_length, first, last, each)
