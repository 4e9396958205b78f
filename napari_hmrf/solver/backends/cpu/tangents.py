"""Compiled loops for tissue in large motion: the multigrid operations on its levels.

Arrays have the layout of `backends.cpu.elastic`, but each element has a tangent instead of Lame
parameters (see `backends.cpu.finite_tangents`). The full system uses all 21 numbers of a tangent,
while cycles use the first 13. Each row requires two loops, both of which vectorize: the first loop
computes the forces of the elements, and the second loop adds them at the sites.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32

from napari_hmrf.solver.backends.cpu import small, small_cycle
from napari_hmrf.solver.backends.cpu.compiled import (
    bounds_of_part,
    callee,
    disjoint,
    disjoint_callee,
    disjoint_parallel,
    portion,
    shared,
    strict,
)
from napari_hmrf.solver.backends.cpu.data_weights import filtered
from napari_hmrf.solver.backends.cpu.endings import residual_line, smooth_line
from napari_hmrf.solver.backends.cpu.forces import site_sweep_of
from napari_hmrf.solver.backends.cpu.vectors import row_product

#: Number of model planes per level: 13 numbers of each tangent, and its damping.
PLANES = np.int64(14)
#: Same with a data term, whose planes are the last two (`small`).
DATA_PLANES = np.int64(16)


@disjoint_callee
def _element_row(d, tangent, i, out):
    """Compute E_r, E_x - E_c and E_x + E_c for row i of elements; see `forces.left_of`."""
    for j in range(d.shape[2] - 1):
        left_0, right_0 = d[0, i + 1, j] - d[0, i, j], d[0, i + 1, j + 1] - d[0, i, j + 1]
        left_1, right_1 = d[1, i + 1, j] - d[1, i, j], d[1, i + 1, j + 1] - d[1, i, j + 1]
        r0, r1, x0, x1 = left_0 + right_0, left_1 + right_1, right_0 - left_0, right_1 - left_1
        c0 = (d[0, i, j + 1] - d[0, i, j]) + (d[0, i + 1, j + 1] - d[0, i + 1, j])
        c1 = (d[1, i, j + 1] - d[1, i, j]) + (d[1, i + 1, j + 1] - d[1, i + 1, j])
        t0, t1, t2 = tangent[0, i, j], tangent[1, i, j], tangent[2, i, j]
        t3, t4, t5 = tangent[3, i, j], tangent[4, i, j], tangent[5, i, j]
        t6, t7 = tangent[6, i, j], tangent[7, i, j]
        t8, t9 = tangent[8, i, j], tangent[9, i, j]
        of_c0 = t3 * c0 + t4 * c1 + t6 * r0 + t8 * r1
        of_c1 = t4 * c0 + t5 * c1 + t7 * r0 + t9 * r1
        of_x0 = tangent[10, i, j] * x0 + tangent[11, i, j] * x1
        of_x1 = tangent[11, i, j] * x0 + tangent[12, i, j] * x1
        out[0, j] = t0 * r0 + t1 * r1 + t6 * c0 + t7 * c1
        out[1, j] = t1 * r0 + t2 * r1 + t8 * c0 + t9 * c1
        out[2, j] = of_x0 - of_c0
        out[3, j] = of_x1 - of_c1
        out[4, j] = of_x0 + of_c0
        out[5, j] = of_x1 + of_c1


@disjoint_callee
def _add_coupled(d, tangent, i, out):
    """Add the terms that couple D_x with D_r and D_c to the result of `_element_row`."""
    for j in range(d.shape[2] - 1):
        left_0, right_0 = d[0, i + 1, j] - d[0, i, j], d[0, i + 1, j + 1] - d[0, i, j + 1]
        left_1, right_1 = d[1, i + 1, j] - d[1, i, j], d[1, i + 1, j + 1] - d[1, i, j + 1]
        r0, r1, x0, x1 = left_0 + right_0, left_1 + right_1, right_0 - left_0, right_1 - left_1
        c0 = (d[0, i, j + 1] - d[0, i, j]) + (d[0, i + 1, j + 1] - d[0, i + 1, j])
        c1 = (d[1, i, j + 1] - d[1, i, j]) + (d[1, i + 1, j + 1] - d[1, i + 1, j])
        r00, r01, r10, r11 = (
            tangent[13, i, j],
            tangent[14, i, j],
            tangent[15, i, j],
            tangent[16, i, j],
        )
        c00, c01, c10, c11 = (
            tangent[17, i, j],
            tangent[18, i, j],
            tangent[19, i, j],
            tangent[20, i, j],
        )
        of_x0 = r00 * r0 + r10 * r1 + c00 * c0 + c10 * c1
        of_x1 = r01 * r0 + r11 * r1 + c01 * c0 + c11 * c1
        of_c0, of_c1 = c00 * x0 + c01 * x1, c10 * x0 + c11 * x1
        out[0, j] += r00 * x0 + r01 * x1
        out[1, j] += r10 * x0 + r11 * x1
        out[2, j] += of_x0 - of_c0
        out[3, j] += of_x1 - of_c1
        out[4, j] += of_x0 + of_c0
        out[5, j] += of_x1 + of_c1


@shared
def _full_row(d, tangent, i, out):
    """Compute the derivatives of row i of elements for the full system."""
    _element_row(d, tangent, i, out)
    _add_coupled(d, tangent, i, out)


@shared
def _apply_finish(forces, d, about, i):
    inverse, weight, springs, out, row_totals = about
    past = d.shape[2] - 2
    for k in range(2):
        residual_line(
            forces[k],
            d[k, i, 2:past],
            d[k, i, 2:past],
            float32(0),
            inverse[k, i, 2:past],
            weight[k, i, 2:past],
            springs,
            float32(-1),
            out[k, i, 2:past],
        )
    row_totals[i - 2] = row_product(d, out, i)


_apply_sweep = site_sweep_of(_full_row, _apply_finish)


@disjoint_parallel
def apply(thread, d, tangent, inverse, weight, springs, out, row_totals, count):
    """Write (A + W) d to `out`, or 0 at fixed components; store d . out per row in `row_totals`.

    A is the matrix of the full system.
    """
    about = inverse, weight, springs, out, row_totals
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, d.shape[1] - 4)
        _apply_sweep(d, tangent, about, first + 2, last + 2)


@shared
def _smooth_finish(forces, d, about, i):
    load, inverse, weight, springs, out, pace = about
    past = d.shape[2] - 2
    for k in range(2):
        smooth_line(
            forces[k],
            d[k, i, 2:past],
            load[k, i, 2:past],
            inverse[k, i, 2:past],
            weight[k, i, 2:past],
            springs,
            out[k, i, 2:past],
            pace,
        )


_smooth_sweep = site_sweep_of(_element_row, _smooth_finish)


@disjoint_parallel
def smooth(thread, d, load, tangent, inverse, weight, springs, out, scale, ahead, back, count):
    """Compute a Chebyshev step with the coefficients `scale`, `ahead` and `back`.

    The step is ``out = d + scale * D^-1 (load - (A + W) d) + ahead * d - back * out``. On entry,
    `out` contains the displacement before the previous step.
    """
    about = load, inverse, weight, springs, out, (scale, ahead, back)
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, d.shape[1] - 4)
        _smooth_sweep(d, tangent, about, first + 2, last + 2)


@shared
def _rest_finish(forces, d, about, i):
    load, inverse, weight, springs, out = about
    past = d.shape[2] - 2
    for k in range(2):
        residual_line(
            forces[k],
            d[k, i, 2:past],
            load[k, i, 2:past],
            float32(1),
            inverse[k, i, 2:past],
            weight[k, i, 2:past],
            springs,
            float32(1),
            out[k, i, 2:past],
        )


_rest_sweep = site_sweep_of(_element_row, _rest_finish)


@disjoint_parallel
def rest(thread, d, load, tangent, inverse, weight, springs, out, count):
    """Write load - (A + W) d to `out`, or 0 at fixed components."""
    about = load, inverse, weight, springs, out
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, d.shape[1] - 4)
        _rest_sweep(d, tangent, about, first + 2, last + 2)


@disjoint_parallel
def start(thread, load, inverse, scale, out):
    """Compute the first step from zero: ``out = scale * D^-1 load``."""
    for i in portion(thread, load.shape[1] - 4):
        for component in range(2):
            for j in range(2, load.shape[2] - 2):
                step = scale * inverse[component, i + 2, j] * load[component, i + 2, j]
                out[component, i + 2, j] = step


@disjoint_parallel
def coarsen(thread, fine, coarse):
    """Compute coarse tangents as the mean of four fine elements, where void counts as 0.

    The damping of a coarse element is the maximum over the four fine elements.
    """
    for i in portion(thread, coarse.shape[1] - 4):
        for k in range(13):
            for j in range(coarse.shape[2] - 4):
                a = fine[k, 2 * i + 2, 2 * j + 2] + fine[k, 2 * i + 2, 2 * j + 3]
                b = fine[k, 2 * i + 3, 2 * j + 2] + fine[k, 2 * i + 3, 2 * j + 3]
                coarse[k, i + 2, j + 2] = float32(0.25) * (a + b)
        for j in range(coarse.shape[2] - 4):
            a = max(fine[13, 2 * i + 2, 2 * j + 2], fine[13, 2 * i + 2, 2 * j + 3])
            b = max(fine[13, 2 * i + 3, 2 * j + 2], fine[13, 2 * i + 3, 2 * j + 3])
            coarse[13, i + 2, j + 2] = max(a, b)


@disjoint_parallel
def diagonal(thread, tangent, out):
    """Compute the diagonal of the matrix for cycles, scaled by the damping of each element."""
    for n in portion(thread, tangent.shape[1] - 4):
        i = n + 2
        for component in range(2):
            of_r, of_c, of_x, both = 2 * component, 3 + 2 * component, 10 + 2 * component, 6
            both += 3 * component
            for k in range(tangent.shape[2] - 4):
                j = k + 2
                total = float32(0)
                for s in range(2):
                    for t in range(2):
                        own = tangent[of_r, i - s, j - t] + tangent[of_c, i - s, j - t]
                        own += tangent[of_x, i - s, j - t]
                        mixed = tangent[both, i - s, j - t]
                        own += mixed + mixed if s == t else -(mixed + mixed)
                        total += tangent[13, i - s, j - t] * own
                out[component, i, j] = total


# The same for small levels, on one thread.


@callee
def _smooth(d, load, own, inverse, weight, springs, out, scale, ahead, back):
    about = load, inverse, weight, springs, out, (scale, ahead, back)
    _smooth_sweep(d, own, about, 2, d.shape[1] - 2)


@callee
def _rest(d, load, own, inverse, weight, springs, out):
    _rest_sweep(d, own, (load, inverse, weight, springs, out), 2, d.shape[1] - 2)


_cycle = small_cycle.cycle_of(PLANES, small_cycle.start, _smooth, _rest, small_cycle.add_coarse)


@strict
def cycle(values, table, down, up, coarsest):
    """Run a V-cycle over small levels; see `small_cycle.cycle_of`."""
    _cycle(values, table, float32(1), down, up, coarsest)


# With a data term, the last two planes of a level are those of `data_weights.couple`: the mixed
# component of W, and that of the block of the smoother.


@shared
def _rest_with_data(forces, d, load, weight, mixed, i, j):
    """Return both components of load - (A + W) d at a site; the springs are part of `weight`."""
    row = load[0, i, j] - weight[0, i, j] * d[0, i, j] - mixed[i, j] * d[1, i, j]
    col = load[1, i, j] - weight[1, i, j] * d[1, i, j] - mixed[i, j] * d[0, i, j]
    return row - forces[0, j - 2], col - forces[1, j - 2]


@disjoint
def _smooth_data_finish(forces, d, about, i):
    load, own, inverse, weight, out, pace = about
    scale, ahead, back = pace
    for j in range(2, d.shape[2] - 2):
        row, col = _rest_with_data(forces, d, load, weight, own[14], i, j)
        mixed = own[15, i, j]
        first = scale * (inverse[0, i, j] * row + mixed * col) + ahead * d[0, i, j]
        second = scale * (mixed * row + inverse[1, i, j] * col) + ahead * d[1, i, j]
        out[0, i, j] = d[0, i, j] + (first - back * out[0, i, j])
        out[1, i, j] = d[1, i, j] + (second - back * out[1, i, j])


_smooth_data_sweep = site_sweep_of(_element_row, _smooth_data_finish)


@callee
def _smooth_data(d, load, own, inverse, weight, springs, out, scale, ahead, back):
    about = load, own, inverse, weight, out, (scale, ahead, back)
    _smooth_data_sweep(d, own, about, 2, d.shape[1] - 2)


@disjoint
def _rest_data_finish(forces, d, about, i):
    load, own, inverse, weight, out = about
    pairs = (
        (inverse[0, i], inverse[1, i]),
        (weight[0, i], weight[1, i]),
        (own[14, i], own[15, i]),
    )
    for j in range(2, d.shape[2] - 2):
        row, col = _rest_with_data(forces, d, load, weight, own[14], i, j)
        row, col = filtered(row, col, *pairs, j)
        out[0, i, j] = row if inverse[0, i, j] > float32(0) else row - row
        out[1, i, j] = col if inverse[1, i, j] > float32(0) else col - col


_rest_data_sweep = site_sweep_of(_element_row, _rest_data_finish)


@callee
def _rest_data(d, load, own, inverse, weight, springs, out):
    _rest_data_sweep(d, own, (load, own, inverse, weight, out), 2, d.shape[1] - 2)


_data_cycle = small_cycle.cycle_of(
    DATA_PLANES, small.start_data, _smooth_data, _rest_data, small.add_coarse_data
)


@strict
def data_cycle(values, table, down, up, coarsest):
    """Run a V-cycle over small levels of a model with a data term."""
    _data_cycle(values, table, float32(1), down, up, coarsest)
