"""Compiled loops for elastic volumes: the multigrid operations on their levels.

All arrays have a border of void, two sites wide on every side. An element has the index of its
first site, and `backends.cpu.hexahedra` documents its parameters. A component that is prescribed,
or that does not belong to an element, has an inverse diagonal of 0, so its correction stays 0.
`weight` is the diagonal of the springs W of a coarse level. It is multiplied by `springs`, which is
0 on the finest level and 1 on the other levels.

Each kernel divides the planes among `count` threads. A thread starts one plane above its first
plane to compute the forces of that plane on the next plane, and discards its other results for that
plane.
In each padded row, kernels write only to the span of moving sites (`spans`), so the output must
already be 0 outside the spans.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32, float64, get_num_threads, prange

from napari_hmrf.solver.backends.cpu.compiled import (
    callee,
    contracted_reduction,
    disjoint,
    inline,
    parallel,
    shared,
)
from napari_hmrf.solver.backends.cpu.forces import part
from napari_hmrf.solver.backends.cpu.hexahedra import BLOCK, block_forces, force_of, scratch
from napari_hmrf.solver.backends.cpu.vectors import restrict_row

# Smallest number of planes per thread; with fewer planes, too many planes would be computed twice.
_FEW_PLANES = 8


def parts(depth: int) -> int:
    """Return the number of threads for a level with `depth` planes."""
    return max(1, min(get_num_threads(), depth // _FEW_PLANES))


@inline
def _join(spans, z, y, begin, past):
    """Return the span (begin, past), extended to cover the span of row (z, y)."""
    if spans[z, y, 1] > spans[z, y, 0]:
        if past == begin:
            begin, past = spans[z, y, 0], spans[z, y, 1]
        else:
            begin, past = min(begin, spans[z, y, 0]), max(past, spans[z, y, 1])
    return begin, past


@shared
def _reach(spans, z, y):
    """Return the span of the moving sites in rows y and y + 1 of planes z and z + 1."""
    begin, past = spans[z, y, 0], spans[z, y, 1]
    begin, past = _join(spans, z, y + 1, begin, past)
    begin, past = _join(spans, z + 1, y, begin, past)
    begin, past = _join(spans, z + 1, y + 1, begin, past)
    return max(begin, 0) + 2, past + 2


@disjoint
def _smooth_line(force, d, load, inverse, weight, springs, out, pace):
    scale, ahead, back = pace
    for x in range(len(d)):
        rest = load[x] - (force[x] + springs * weight[x] * d[x])
        step = scale * inverse[x] * rest + ahead * d[x]
        out[x] = d[x] + (step - back * out[x])


@inline
def _three(values, first, z, y, begin, past):
    """Return three lines of planes, from plane `first`; the loops over single lines vectorize."""
    return (
        values[first, z, y, begin:past],
        values[first + 1, z, y, begin:past],
        values[first + 2, z, y, begin:past],
    )


@disjoint
def _smooth_block(forces, d, load, inverse, weight, mixed, block, out, pace):
    """Compute a step with a block of the smoother for each site; see `data_weights`."""
    scale, ahead, back = pace
    force_0, force_1, force_2 = forces
    d_0, d_1, d_2 = d
    load_0, load_1, load_2 = load
    inverse_0, inverse_1, inverse_2 = inverse
    weight_0, weight_1, weight_2 = weight
    mixed_01, mixed_02, mixed_12 = mixed
    block_01, block_02, block_12 = block
    out_0, out_1, out_2 = out
    for x in range(len(d_0)):
        i, j, k = d_0[x], d_1[x], d_2[x]
        row = load_0[x] - (force_0[x] + weight_0[x] * i + mixed_01[x] * j + mixed_02[x] * k)
        col = load_1[x] - (force_1[x] + mixed_01[x] * i + weight_1[x] * j + mixed_12[x] * k)
        end = load_2[x] - (force_2[x] + mixed_02[x] * i + mixed_12[x] * j + weight_2[x] * k)
        step = inverse_0[x] * row + block_01[x] * col + block_02[x] * end
        out_0[x] = i + (scale * step + ahead * i - back * out_0[x])
        step = block_01[x] * row + inverse_1[x] * col + block_12[x] * end
        out_1[x] = j + (scale * step + ahead * j - back * out_1[x])
        step = block_02[x] * row + block_12[x] * col + inverse_2[x] * end
        out_2[x] = k + (scale * step + ahead * k - back * out_2[x])


@callee
def _smooth_part(d, tissue, weights, mixed, load, inverse, spans, out, pace, first, last):
    lame, share, shape = tissue
    weight, springs = weights
    lines, rows, planes = scratch(d)
    for z in range(max(first - 1, 0) + 2, last + 2):
        rows.fill(0)
        for y in range(2, d.shape[2] - 2):
            begin, past = _reach(spans, z, y)
            for x in range(begin, past, BLOCK):
                end = min(x + BLOCK, past)
                block_forces(d, lame, share, shape, z, y, x, end - x, lines, rows, planes)
                if z >= first + 2 and mixed is not None:
                    _smooth_block(
                        (force_of(lines, 0), force_of(lines, 1), force_of(lines, 2)),
                        _three(d, 0, z, y, x, end),
                        _three(load, 0, z, y, x, end),
                        _three(inverse, 0, z, y, x, end),
                        _three(weight, 0, z, y, x, end),
                        _three(mixed, 0, z, y, x, end),
                        _three(mixed, 3, z, y, x, end),
                        _three(out, 0, z, y, x, end),
                        pace,
                    )
                elif z >= first + 2:
                    for k in range(3):
                        _smooth_line(
                            force_of(lines, k),
                            d[k, z, y, x:end],
                            load[k, z, y, x:end],
                            inverse[k, z, y, x:end],
                            weight[k, z, y, x:end],
                            springs,
                            out[k, z, y, x:end],
                            pace,
                        )


@parallel
def smooth(
    d, other, load, lame, share, inverse, weight, springs, mixed, shape, spans, paces, count
):
    """Run Chebyshev steps with the coefficients (scale, ahead, back) in `paces`.

    A step is ``other = d + scale * D^-1 (load - (A + W) d) + ahead * d - back * other``. On entry,
    `other` contains the displacement before the previous step. The two arrays swap roles after each
    step. With a data term (`data_weights`), W also has the components `mixed`; otherwise `mixed` is
    None.
    """
    for step in range(len(paces)):
        source, target = (d, other) if step % 2 == 0 else (other, d)
        pace = paces[step, 0], paces[step, 1], paces[step, 2]
        tissue, weights = (lame, share, shape), (weight, springs)
        for number in prange(count):
            first, last = part(number, count, d.shape[1] - 4)
            _smooth_part(
                source, tissue, weights, mixed, load, inverse, spans, target, pace, first, last
            )


@parallel
def start(load, inverse, mixed, d, scale):
    """Compute the first step from zero, ``d = scale * D^-1 load``, for arrays from `level.rows`.

    `mixed` is None without a data term.
    """
    for i in prange(d.shape[1]):
        for k in range(len(d)):
            for j in range(d.shape[2]):
                d[k, i, j] = scale * inverse[k, i, j] * load[k, i, j]
        if mixed is not None:
            for j in range(d.shape[2]):
                x, y, z = load[0, i, j], load[1, i, j], load[2, i, j]
                d[0, i, j] += scale * (mixed[3, i, j] * y + mixed[4, i, j] * z)
                d[1, i, j] += scale * (mixed[3, i, j] * x + mixed[5, i, j] * z)
                d[2, i, j] += scale * (mixed[4, i, j] * x + mixed[5, i, j] * y)


@disjoint
def _rest_line(force, d, load, given, inverse, weight, springs, scale, out):
    for x in range(len(d)):
        rest = given * load[x] - (force[x] + springs * weight[x] * d[x])
        rest = out.dtype.type(scale * rest)
        out[x] = rest if inverse[x] > float32(0) else rest - rest


@disjoint
def _mixed_forces(forces, d, mixed):
    """Add the forces of the components `mixed` of W, in place."""
    force_0, force_1, force_2 = forces
    d_0, d_1, d_2 = d
    mixed_01, mixed_02, mixed_12 = mixed
    for x in range(len(d_0)):
        force_0[x] += mixed_01[x] * d_1[x] + mixed_02[x] * d_2[x]
        force_1[x] += mixed_01[x] * d_0[x] + mixed_12[x] * d_2[x]
        force_2[x] += mixed_02[x] * d_0[x] + mixed_12[x] * d_1[x]


@disjoint
def _filter_block(forces, d, load, inverse, weight, mixed, block, out):
    """Compute the residual, filtered for the data term; see `data_weights`."""
    force_0, force_1, force_2 = forces
    d_0, d_1, d_2 = d
    load_0, load_1, load_2 = load
    inverse_0, inverse_1, inverse_2 = inverse
    weight_0, weight_1, weight_2 = weight
    mixed_01, mixed_02, mixed_12 = mixed
    block_01, block_02, block_12 = block
    out_0, out_1, out_2 = out
    for x in range(len(d_0)):
        i, j, k = d_0[x], d_1[x], d_2[x]
        row = load_0[x] - (force_0[x] + weight_0[x] * i + mixed_01[x] * j + mixed_02[x] * k)
        col = load_1[x] - (force_1[x] + mixed_01[x] * i + weight_1[x] * j + mixed_12[x] * k)
        end = load_2[x] - (force_2[x] + mixed_02[x] * i + mixed_12[x] * j + weight_2[x] * k)
        i = inverse_0[x] * row + block_01[x] * col + block_02[x] * end
        j = block_01[x] * row + inverse_1[x] * col + block_12[x] * end
        k = block_02[x] * row + block_12[x] * col + inverse_2[x] * end
        row -= weight_0[x] * i + mixed_01[x] * j + mixed_02[x] * k
        col -= mixed_01[x] * i + weight_1[x] * j + mixed_12[x] * k
        end -= mixed_02[x] * i + mixed_12[x] * j + weight_2[x] * k
        out_0[x] = row if inverse_0[x] > float32(0) else row - row
        out_1[x] = col if inverse_1[x] > float32(0) else col - col
        out_2[x] = end if inverse_2[x] > float32(0) else end - end


@callee
def _leave_part(d, tissue, weight, mixed, load, inverse, spans, out, first, last):
    lame, share, shape = tissue
    lines, rows, planes = scratch(d)
    for z in range(max(first - 1, 0) + 2, last + 2):
        rows.fill(0)
        for y in range(2, d.shape[2] - 2):
            begin, past = _reach(spans, z, y)
            for x in range(begin, past, BLOCK):
                end = min(x + BLOCK, past)
                block_forces(d, lame, share, shape, z, y, x, end - x, lines, rows, planes)
                if z >= first + 2:
                    _filter_block(
                        (force_of(lines, 0), force_of(lines, 1), force_of(lines, 2)),
                        _three(d, 0, z, y, x, end),
                        _three(load, 0, z, y, x, end),
                        _three(inverse, 0, z, y, x, end),
                        _three(weight, 0, z, y, x, end),
                        _three(mixed, 0, z, y, x, end),
                        _three(mixed, 3, z, y, x, end),
                        _three(out, 0, z, y, x, end),
                    )


@parallel
def filtered_rest(d, load, lame, share, inverse, weight, mixed, shape, spans, out, count):
    """Write the residual load - (A + W) d, filtered for the data term (`data_weights`)."""
    for number in prange(count):
        first, last = part(number, count, d.shape[1] - 4)
        tissue = lame, share, shape
        _leave_part(d, tissue, weight, mixed, load, inverse, spans, out, first, last)


@callee
def _rest_part(d, tissue, weights, mixed, loads, inverse, spans, out, first, last):
    lame, share, shape = tissue
    (weight, springs), (load, given, scale) = weights, loads
    lines, rows, planes = scratch(d)
    for z in range(max(first - 1, 0) + 2, last + 2):
        rows.fill(0)
        for y in range(2, d.shape[2] - 2):
            begin, past = _reach(spans, z, y)
            for x in range(begin, past, BLOCK):
                end = min(x + BLOCK, past)
                block_forces(d, lame, share, shape, z, y, x, end - x, lines, rows, planes)
                if z >= first + 2:
                    if mixed is not None:
                        three = force_of(lines, 0), force_of(lines, 1), force_of(lines, 2)
                        along = _three(d, 0, z, y, x, end)
                        _mixed_forces(three, along, _three(mixed, 0, z, y, x, end))
                    for k in range(3):
                        _rest_line(
                            force_of(lines, k),
                            d[k, z, y, x:end],
                            load[k, z, y, x:end],
                            given,
                            inverse[k, z, y, x:end],
                            weight[k, z, y, x:end],
                            springs,
                            scale,
                            out[k, z, y, x:end],
                        )


@parallel
def rest(
    d, load, given, lame, share, inverse, weight, springs, mixed, shape, spans, scale, out, count
):
    """Write ``scale * (given * load - (A + W) d)`` to `out`, or 0 at fixed components."""
    for number in prange(count):
        first, last = part(number, count, d.shape[1] - 4)
        tissue, weights, loads = (lame, share, shape), (weight, springs), (load, given, scale)
        _rest_part(d, tissue, weights, mixed, loads, inverse, spans, out, first, last)


@callee
def _pull_part(d, lame, share, shape, out, first, last):
    lines, rows, planes = scratch(d)
    for z in range(max(first - 1, 0) + 2, last + 2):
        rows.fill(0)
        for y in range(2, d.shape[2] - 2):
            for x in range(2, d.shape[3] - 2, BLOCK):
                end = min(x + BLOCK, d.shape[3] - 2)
                block_forces(d, lame, share, shape, z, y, x, end - x, lines, rows, planes)
                if z >= first + 2:
                    for k in range(3):
                        force, line = force_of(lines, k), out[k, z, y, x:end]
                        for i in range(len(line)):
                            line[i] = -force[i]


@parallel
def pull(d, lame, share, shape, out, count):
    """Write -A d to `out`, including its values at prescribed components."""
    for number in prange(count):
        first, last = part(number, count, d.shape[1] - 4)
        _pull_part(d, lame, share, shape, out, first, last)


@contracted_reduction
def _work_line(force, d):
    product, square = 0.0, 0.0
    for x in range(len(d)):
        product += d[x] * force[x]
        square += force[x] * force[x]
    return product, square


@disjoint
def _tensor_forces(forces, d, weight):
    """Add the forces of the diagonal of W, in place."""
    force_0, force_1, force_2 = forces
    d_0, d_1, d_2 = d
    weight_0, weight_1, weight_2 = weight
    for x in range(len(d_0)):
        force_0[x] += weight_0[x] * d_0[x]
        force_1[x] += weight_1[x] * d_1[x]
        force_2[x] += weight_2[x] * d_2[x]


@callee
def _work_part(d, lame, share, data, shape, products, squares, first, last):
    lines, rows, planes = scratch(d)
    for z in range(max(first - 1, 0) + 2, last + 2):
        rows.fill(0)
        for y in range(2, d.shape[2] - 2):
            for x in range(2, d.shape[3] - 2, BLOCK):
                end = min(x + BLOCK, d.shape[3] - 2)
                block_forces(d, lame, share, shape, z, y, x, end - x, lines, rows, planes)
                if z >= first + 2:
                    if data is not None:
                        three = force_of(lines, 0), force_of(lines, 1), force_of(lines, 2)
                        along = _three(d, 0, z, y, x, end)
                        _tensor_forces(three, along, _three(data, 0, z, y, x, end))
                        _mixed_forces(three, along, _three(data, 3, z, y, x, end))
                    for k in range(3):
                        product, square = _work_line(force_of(lines, k), d[k, z, y, x:end])
                        products[z - 2] += product
                        squares[z - 2] += square


@parallel
def work(d, lame, share, data, shape, products, squares, count):
    """Add d . A d and ||A d||^2 of each plane to `products` and `squares`.

    `data` contains the tensors of the data term, which are part of A, or is None.
    """
    for number in prange(count):
        first, last = part(number, count, d.shape[1] - 4)
        _work_part(d, lame, share, data, shape, products, squares, first, last)


# Transfer between levels


@disjoint
def _between(above, here, below, line):
    """Compute ``line = here + (above + below) / 2``, the restriction along the plane axis."""
    half = float32(0.5)
    for x in range(len(line)):
        line[x] = here[x] + half * (above[x] + below[x])


@parallel
def restrict(fine, coarse):
    """Apply the transpose of `interpolate`; coarse site i coincides with fine site 2 i."""
    for n in prange(coarse.shape[1] - 4):
        lines = np.empty((3, fine.shape[3]), dtype=fine.dtype)
        z = 2 * np.int64(n) + 2
        for k in range(len(coarse)):
            for m in range(coarse.shape[2] - 4):
                for row in range(3):
                    y = 2 * m + 1 + row
                    _between(fine[k, z - 1, y], fine[k, z, y], fine[k, z + 1, y], lines[row])
                restrict_row(lines[0], lines[1], lines[2], coarse[k, n + 2, m + 2])


@disjoint
def _interpolate_row(near, right, far, across, inverse, line, fine):
    half, quarter = float32(0.5), float32(0.25)
    for x in range(len(line)):
        line[x] = quarter * ((near[x] + right[x]) + (far[x] + across[x]))
    for x in range((len(fine) - 3) // 2):
        here, between = line[x + 2], half * (line[x + 2] + line[x + 3])
        fine[2 * x + 2] += here if inverse[2 * x + 2] > float32(0) else float32(0)
        fine[2 * x + 3] += between if inverse[2 * x + 3] > float32(0) else float32(0)


@parallel
def interpolate(coarse, fine, inverse):
    """Add the trilinearly interpolated coarse correction to the components that move."""
    for number in prange(fine.shape[1] - 4):
        n = np.int64(number)
        line = np.empty(coarse.shape[3], dtype=fine.dtype)
        near, z = n // 2 + 2, n + 2
        far = near + n % 2
        for k in range(3):
            for m in range(fine.shape[2] - 4):
                left, y = m // 2 + 2, m + 2
                right = left + m % 2
                one, other = coarse[k, near, left], coarse[k, near, right]
                third, last = coarse[k, far, left], coarse[k, far, right]
                _interpolate_row(one, other, third, last, inverse[k, z, y], line, fine[k, z, y])


@disjoint
def _add_relaxed_line(lines, inverse, weight, mixed, block, out):
    """Multiply an interpolated correction by T (`data_weights`), and add it to `out`."""
    line_0, line_1, line_2 = lines
    inverse_0, inverse_1, inverse_2 = inverse
    weight_0, weight_1, weight_2 = weight
    mixed_01, mixed_02, mixed_12 = mixed
    block_01, block_02, block_12 = block
    out_0, out_1, out_2 = out
    for x in range(len(out_0)):
        i, j, k = line_0[x], line_1[x], line_2[x]
        row = weight_0[x] * i + mixed_01[x] * j + mixed_02[x] * k
        col = mixed_01[x] * i + weight_1[x] * j + mixed_12[x] * k
        end = mixed_02[x] * i + mixed_12[x] * j + weight_2[x] * k
        out_0[x] += i - (inverse_0[x] * row + block_01[x] * col + block_02[x] * end)
        out_1[x] += j - (block_01[x] * row + inverse_1[x] * col + block_12[x] * end)
        out_2[x] += k - (block_02[x] * row + block_12[x] * col + inverse_2[x] * end)


@parallel
def add_relaxed(coarse, inverse, weight, mixed, out):
    """Interpolate a coarse correction, filter it for the data term, and add it to `out`."""
    for number in prange(out.shape[1] - 4):
        n, past = np.int64(number), out.shape[3]
        line = np.empty(coarse.shape[3], dtype=out.dtype)
        lines = np.empty((3, past), dtype=out.dtype)
        near, z = n // 2 + 2, n + 2
        far = near + n % 2
        for m in range(out.shape[2] - 4):
            left, y = m // 2 + 2, m + 2
            right = left + m % 2
            lines.fill(0)
            for k in range(3):
                one, other = coarse[k, near, left], coarse[k, near, right]
                third, last = coarse[k, far, left], coarse[k, far, right]
                _interpolate_row(one, other, third, last, inverse[k, z, y], line, lines[k])
            _add_relaxed_line(
                (lines[0], lines[1], lines[2]),
                _three(inverse, 0, z, y, 0, past),
                _three(weight, 0, z, y, 0, past),
                _three(mixed, 0, z, y, 0, past),
                _three(mixed, 3, z, y, 0, past),
                _three(out, 0, z, y, 0, past),
            )


# Parameters of the tissue on each level


@disjoint
def _sum_line(near, right, far, across, line):
    """Compute the sum over the corners of each element, or 0 if the value at any corner is 0."""
    for x in range(len(line)):
        one, other = float64(near[x]), float64(near[x + 1])
        low, total = min(one, other), one + other
        one, other = float64(right[x]), float64(right[x + 1])
        low, total = min(low, min(one, other)), total + (one + other)
        one, other = float64(far[x]), float64(far[x + 1])
        low, total = min(low, min(one, other)), total + (one + other)
        one, other = float64(across[x]), float64(across[x + 1])
        low, total = min(low, min(one, other)), total + (one + other)
        line[x] = total if low > 0 else 0.0


@parallel
def elements(m, each, one, scale, lame):
    """Compute the parameters of each element from the means of its sites; 0 if a site is void.

    If `one` is True, Poisson's ratio is uniform, and mu is `scale` times the sum of `m` over the
    corners. Otherwise, `each` contains the ratio at each site, and `scale` times the sum is Young's
    modulus.
    """
    for n in prange(m.shape[0] - 1):
        total, ratio = np.empty(m.shape[2] - 1), np.empty(m.shape[2] - 1)
        for y in range(m.shape[1] - 1):
            shear = lame[0, n + 2, y + 2, 2:]
            _sum_line(m[n, y], m[n, y + 1], m[n + 1, y], m[n + 1, y + 1], total)
            if one:
                for x in range(len(total)):
                    shear[x] = scale * total[x]
            else:
                first = lame[lame.shape[0] - 1, n + 2, y + 2, 2:]
                for x in range(len(total)):
                    four = float64(each[n, y, x]) + float64(each[n, y + 1, x])
                    four += float64(each[n + 1, y, x]) + float64(each[n + 1, y + 1, x])
                    ratio[x] = 0.125 * four
                    four = float64(each[n, y, x + 1]) + float64(each[n, y + 1, x + 1])
                    four += float64(each[n + 1, y, x + 1]) + float64(each[n + 1, y + 1, x + 1])
                    ratio[x] += 0.125 * four
                for x in range(len(total)):
                    nu = ratio[x] if total[x] > 0 else 0.0  # ratios in void may be invalid
                    mu = scale * total[x] / (2 + 2 * nu)
                    shear[x] = mu
                    first[x] = 2 * mu * nu / (1 - 2 * nu)


@parallel
def coarsen(fine, coarse):
    """Compute the parameters of coarse elements: a quarter of the sum over eight fine elements.

    This is twice their mean, because the energy of an element is proportional to its side length.
    """
    quarter = float32(0.25)
    for n in prange(coarse.shape[1] - 4):
        for k in range(len(coarse)):
            for y in range(coarse.shape[2] - 4):
                out = coarse[k, n + 2, y + 2]
                near, right = fine[k, 2 * n + 2, 2 * y + 2], fine[k, 2 * n + 2, 2 * y + 3]
                far, across = fine[k, 2 * n + 3, 2 * y + 2], fine[k, 2 * n + 3, 2 * y + 3]
                for x in range(len(out) - 4):
                    one = (near[2 * x + 2] + right[2 * x + 2]) + (
                        far[2 * x + 2] + across[2 * x + 2]
                    )
                    other = near[2 * x + 3] + right[2 * x + 3]
                    other += far[2 * x + 3] + across[2 * x + 3]
                    out[x + 2] = quarter * (one + other)


@parallel
def diagonal(lame, share, shape, out):
    """Compute the diagonal of the stiffness matrix."""
    for n in prange(lame.shape[1] - 4):
        z, last = n + 2, lame.shape[0] - 1
        for k in range(3):
            stretch, slide = share * shape[k] * shape[k], float32(16) * shape[9 + k]
            for y in range(2, lame.shape[2] - 2):
                line = out[k, z, y]
                near, right = lame[0, z - 1, y - 1], lame[0, z - 1, y]
                far, across = lame[0, z, y - 1], lame[0, z, y]
                for x in range(len(line) - 4):
                    one = (near[x + 1] + right[x + 1]) + (far[x + 1] + across[x + 1])
                    other = (near[x + 2] + right[x + 2]) + (far[x + 2] + across[x + 2])
                    line[x + 2] = slide * (one + other)
                near, right = lame[last, z - 1, y - 1], lame[last, z - 1, y]
                far, across = lame[last, z, y - 1], lame[last, z, y]
                for x in range(len(line) - 4):
                    one = (near[x + 1] + right[x + 1]) + (far[x + 1] + across[x + 1])
                    other = (near[x + 2] + right[x + 2]) + (far[x + 2] + across[x + 2])
                    line[x + 2] += stretch * (one + other)
