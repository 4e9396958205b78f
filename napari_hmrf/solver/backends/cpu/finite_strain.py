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
    shared,
)
from napari_hmrf.solver.backends.cpu.forces import site_sweep_of

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
def walls(jacobians, start):
    """Return the sum of the barrier functions of an element's corners, and its derivatives.

    Parameters
    ----------
    jacobians : tuple of 3 floats
        Mean Jacobian, and its increments toward the next row and the next column.
    start : float
        Threshold of the barrier.

    Returns
    -------
    value : float
        Sum of the barrier functions.
    slopes : tuple of 3 floats
        First derivatives with respect to the three numbers.
    bends : tuple of 4 floats
        Second derivatives: the one in the diagonal, which is the same for all three numbers, and
        those for the numbers 0 and 1, 0 and 2, and 1 and 2.
    """
    mean, down, right = jacobians
    value = slope_0 = slope_1 = slope_2 = 0.0
    bend = bend_01 = bend_02 = bend_12 = 0.0
    for corner in range(4):
        s, t = (1.0 if corner >= 2 else -1.0), (1.0 if corner % 2 else -1.0)
        own, one, two = barrier(mean + s * down + t * right, start)
        value += own
        slope_0, slope_1, slope_2 = slope_0 + one, slope_1 + s * one, slope_2 + t * one
        bend, bend_12 = bend + two, bend_12 + s * t * two
        bend_01, bend_02 = bend_01 + s * two, bend_02 + t * two
    return value, (slope_0, slope_1, slope_2), (bend, bend_01, bend_02, bend_12)


@shared
def smallest(jacobians):
    """Return the smallest corner Jacobian, from the mean and its increments."""
    mean, down, right = jacobians
    return mean - abs(down) - abs(right)


@shared
def state(d, solid, about, i, j):
    """Return the deformation of element (i, j).

    Returns
    -------
    sides : tuple of 6 floats
        Result of `deformed`.
    free : tuple of 4 floats
        Sides without growth.
    gain : float
        Factor that removes growth from a Jacobian.
    jacobians : tuple of 3 floats
        Result of `volumes`, without growth.
    """
    rows, cols = about[0], about[1]
    sides = deformed(d, i, j, rows, cols)
    a0, a1, b0, b1, x0, x1 = sides
    e0, e1, f0, f1, gain = elastic(a0, a1, b0, b1, solid, i, j)
    mean, down, right = volumes(a0, a1, b0, b1, x0, x1, rows, cols)
    return sides, (e0, e1, f0, f1), gain, (gain * mean, gain * down, gain * right)


@callee
def _energy_part(d, solid, about, row_energy, row_least, first, last):
    _, _, bulges, strength, start = about
    for i in range(first, last):
        total, least = 0.0, np.inf
        for j in range(2, d.shape[2] - 2):
            shear, lam, whole = solid[SHEAR, i, j], solid[FIRST, i, j], solid[WHOLE, i, j]
            if shear <= 0:
                continue
            sides, (a0, a1, b0, b1), gain, jacobians = state(d, solid, about, i, j)
            low, mean = smallest(jacobians), jacobians[0]
            least = min(least, low / gain)
            if low <= 0:
                continue
            # Computing the energy relative to the rest state preserves more digits.
            stretch = (a0 * a0 + a1 * a1 + b0 * b0 + b1 * b1) - 2.0
            if bulges:
                thick = (shear + 0.5 * lam * mean * mean) / whole
                volume = whole * (0.5 * math.log(thick) - math.log(mean))
            else:
                volume = 0.25 * lam * (mean * mean - 1.0) - whole * math.log(mean)
            here = 0.5 * shear * stretch + volume
            here += 0.5 * solid[TWIST, i, j] * (sides[4] * sides[4] + sides[5] * sides[5])
            if low < start:
                here += 0.25 * strength * shear * walls(jacobians, start)[0]
            total += here
        row_energy[i - 2] = total
        row_least[i - 2] = least


@disjoint_parallel
def energy(thread, d, solid, about, row_energy, row_least, count):
    """Compute the energy and the smallest corner Jacobian of each row of elements.

    The Jacobian includes growth. Folded elements contribute no energy.
    """
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(row_energy))
        _energy_part(d, solid, about, row_energy, row_least, first + 2, last + 2)


@callee
def _element_row(d, model, i, out):
    """Compute the derivatives of the energy of row i of elements; see `forces.site_sweep_of`."""
    solid, about = model
    rows, cols, bulges, strength, start = about
    for j in range(2, d.shape[2] - 2):
        if solid[SHEAR, i, j] <= 0:
            for k in range(6):
                out[k, j] = 0.0
            continue
        (a0, a1, b0, b1, x0, x1), (e0, e1, f0, f1), gain, jacobians = state(d, solid, about, i, j)
        shear, twist = solid[SHEAR, i, j], solid[TWIST, i, j]
        of_mean = bulk(jacobians[0], shear, solid[FIRST, i, j], solid[WHOLE, i, j], bulges)[0]
        of_down, of_right = 0.0, 0.0
        if smallest(jacobians) < start:
            slopes, weight = walls(jacobians, start)[1], 0.25 * strength * shear
            of_mean += weight * slopes[0]
            of_down, of_right = weight * slopes[1], weight * slopes[2]
        of_mean, of_down, of_right = gain * of_mean, gain * of_down * cols, gain * of_right * rows
        rr, rc, cc = shear * solid[RR, i, j], shear * solid[RC, i, j], shear * solid[CC, i, j]
        of_c0 = cols * (rc * e0 + cc * f0 - of_mean * a1 - of_right * x1)
        of_c1 = cols * (rc * e1 + cc * f1 + of_mean * a0 + of_right * x0)
        of_x0 = twist * x0 - of_down * a1 + of_right * b1
        of_x1 = twist * x1 + of_down * a0 - of_right * b0
        out[0, j] = rows * (rr * e0 + rc * f0 + of_mean * b1 + of_down * x1)
        out[1, j] = rows * (rr * e1 + rc * f1 - of_mean * b0 - of_down * x0)
        out[2, j], out[3, j] = of_x0 - of_c0, of_x1 - of_c1
        out[4, j], out[5, j] = of_x0 + of_c0, of_x1 + of_c1


@shared
def _write_forces(forces, d, out, i):
    # Numba would compile an assignment of arrays for seconds.
    for k in range(2):
        for x in range(d.shape[2] - 4):
            out[k, i, x + 2] = forces[k, x]


_force_sweep = site_sweep_of(_element_row, _write_forces)


@disjoint_parallel
def forces(thread, d, solid, about, out, count):
    """Compute the gradient of the energy with respect to the displacement of each site."""
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, d.shape[1] - 4)
        _force_sweep(d, (solid, about), out, first + 2, last + 2)


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
