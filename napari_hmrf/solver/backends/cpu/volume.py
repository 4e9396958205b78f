"""Compiled loops for elastic volumes: the multigrid operations on their levels.

Arrays have shape (C, N). They contain padded rows, one after another, and a table with the index of
column 0 of each row (`layout`). An element has the index of its first site, and
`backends.cpu.hexahedra` documents its parameters. A component that is prescribed,
or that does not belong to an element, has an inverse diagonal of 0, so its correction stays 0.
`weight` is the diagonal of the springs W of a coarse level. It is multiplied by `springs`, which is
0 on the finest level and 1 on the other levels.

Each kernel divides the planes among `count` threads. A thread starts one plane above its first
plane to compute the forces of that plane on the next plane, and discards its other results for that
plane.
In each padded row, kernels write only to the span of moving sites (`spans`), or only to the span of
tissue, so the output must already be 0 outside the spans.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32, float64, get_num_threads

from napari_hmrf.solver.backends.cpu.compiled import (
    bounds_of_part,
    callee,
    contracted_reduction,
    disjoint,
    disjoint_parallel,
    inline,
    parallel,
    portion,
    scratch_parallel,
    shared,
)
from napari_hmrf.solver.backends.cpu.endings import residual_line, smooth_line
from napari_hmrf.solver.backends.cpu.hexahedra import BLOCK, block_forces, force_of, scratch

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


def _sweep(finish):
    """Return a loop over the blocks of sites of some planes, which computes the forces A d.

    Parameters
    ----------
    finish : callable
        Compiled function ``finish(lines, d, data, about, at, of_d, z)`` that uses the forces
        `lines` of a block of sites in plane `z`. The block is `at` = (first, past) in the rows of
        the level, and `of_d` in the rows of `d`, which may be stored in another way. The loop
        passes on `data`, which may be None, and `about`.
    """

    @callee
    def sweep(d, of_d, tissue, where, data, about, first, last):
        lame, share, shape = tissue
        at, spans, width = where
        lines, rows, planes = scratch(d, at.shape[1], width)
        for z in range(max(first - 1, 0) + 2, last + 2):
            rows.fill(0)
            for y in range(2, at.shape[1] - 2):
                begin, past = _reach(spans, z, y)
                for x in range(begin, past, BLOCK):
                    end, count = min(x + BLOCK, past), min(BLOCK, past - x)
                    block_forces(
                        d, of_d, lame, at, share, shape, z, y, x, count, lines, rows, planes
                    )
                    if z >= first + 2:
                        block = at[z, y] + x, at[z, y] + end
                        finish(lines, d, data, about, block, (of_d[z, y] + x, of_d[z, y] + end), z)

    return sweep


@inline
def _forces_of(lines):
    """Return the three components of the forces of a block."""
    return force_of(lines, 0), force_of(lines, 1), force_of(lines, 2)


@inline
def _three(values, first, begin, past):
    """Return three lines of planes, from plane `first`; the loops over single lines vectorize."""
    return values[first, begin:past], values[first + 1, begin:past], values[first + 2, begin:past]


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


@shared
def _smooth_finish(lines, d, data, about, at, of_d, z):
    load, inverse, weight, springs, out, pace = about
    i, j = at
    if data is not None:
        _smooth_block(
            _forces_of(lines),
            _three(d, 0, i, j),
            _three(load, 0, i, j),
            _three(inverse, 0, i, j),
            _three(weight, 0, i, j),
            _three(data, 0, i, j),
            _three(data, 3, i, j),
            _three(out, 0, i, j),
            pace,
        )
    else:
        for k in range(3):
            smooth_line(
                force_of(lines, k),
                d[k, i:j],
                load[k, i:j],
                inverse[k, i:j],
                weight[k, i:j],
                springs,
                out[k, i:j],
                pace,
            )


_smooth_sweep = _sweep(_smooth_finish)


@disjoint_parallel
def smooth(
    thread, d, other, load, lame, share, inverse, weight, springs, mixed, shape, where, paces, count
):
    """Run Chebyshev steps with the coefficients (scale, ahead, back) in `paces`, one in each turn.

    A step is ``other = d + scale * D^-1 (load - (A + W) d) + ahead * d - back * other``. On entry,
    `other` contains the displacement before the previous step. The two arrays swap roles after each
    step. With a data term (`data_weights`), W also has the components `mixed`; otherwise `mixed` is
    None. `where` consists of the table of rows, the spans, and the width of a padded plane.
    """
    at = where[0]
    step = thread[2]
    source, target = (d, other) if step % 2 == 0 else (other, d)
    pace = paces[step, 0], paces[step, 1], paces[step, 2]
    tissue, about = (lame, share, shape), (load, inverse, weight, springs, target, pace)
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(at) - 4)
        _smooth_sweep(source, at, tissue, where, mixed, about, first, last)


@disjoint_parallel
def start(thread, load, inverse, mixed, d, scale):
    """Compute the first step from zero, ``d = scale * D^-1 load``, for arrays from `layout.rows`.

    `mixed` is None without a data term.
    """
    for i in portion(thread, d.shape[1]):
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


@shared
def _filter_finish(lines, d, data, about, at, of_d, z):
    load, inverse, weight, out = about
    i, j = at
    _filter_block(
        _forces_of(lines),
        _three(d, 0, i, j),
        _three(load, 0, i, j),
        _three(inverse, 0, i, j),
        _three(weight, 0, i, j),
        _three(data, 0, i, j),
        _three(data, 3, i, j),
        _three(out, 0, i, j),
    )


_filter_sweep = _sweep(_filter_finish)


@parallel
def filtered_rest(thread, d, load, lame, share, inverse, weight, mixed, shape, where, out, count):
    """Write the residual load - (A + W) d, filtered for the data term (`data_weights`)."""
    at = where[0]
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(at) - 4)
        tissue, about = (lame, share, shape), (load, inverse, weight, out)
        _filter_sweep(d, at, tissue, where, mixed, about, first, last)


@shared
def _rest_finish(lines, d, data, about, at, of_d, z):
    load, given, inverse, weight, springs, scale, out = about
    (i, j), (before, after) = at, of_d
    if data is not None:
        along = _three(d, 0, before, after)
        _mixed_forces(_forces_of(lines), along, _three(data, 0, i, j))
    for k in range(3):
        residual_line(
            force_of(lines, k),
            d[k, before:after],
            load[k, before:after],
            given,
            inverse[k, i:j],
            weight[k, i:j],
            springs,
            scale,
            out[k, i:j],
        )


_rest_sweep = _sweep(_rest_finish)


@disjoint_parallel
def rest(
    thread,
    d,
    load,
    given,
    of_d,
    lame,
    share,
    inverse,
    weight,
    springs,
    mixed,
    shape,
    where,
    scale,
    out,
    count,
):
    """Write ``scale * (given * load - (A + W) d)`` to `out`, or 0 at fixed components.

    `of_d` is the table of rows of `d` and `load`, which may differ from that of the other arrays.
    """
    at = where[0]
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(at) - 4)
        about = load, given, inverse, weight, springs, scale, out
        _rest_sweep(d, of_d, (lame, share, shape), where, mixed, about, first, last)


@shared
def _pull_finish(lines, d, data, out, at, of_d, z):
    for k in range(3):
        force, line = force_of(lines, k), out[k, of_d[0] :]
        for i in range(of_d[1] - of_d[0]):
            line[i] = -force[i]


_pull_sweep = _sweep(_pull_finish)


@parallel
def pull(thread, d, of_d, lame, share, shape, where, out, count):
    """Write -A d to `out`, including its values at prescribed components.

    `of_d` is the table of rows of `d` and `out`, and `where` contains the spans of the tissue.
    """
    at = where[0]
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(at) - 4)
        _pull_sweep(d, of_d, (lame, share, shape), where, None, out, first, last)


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


@shared
def _work_finish(lines, d, data, about, at, of_d, z):
    products, squares = about
    i, j = of_d
    if data is not None:
        along = _three(d, 0, i, j)
        _tensor_forces(_forces_of(lines), along, _three(data, 0, i, j))
        _mixed_forces(_forces_of(lines), along, _three(data, 3, i, j))
    for k in range(3):
        product, square = _work_line(force_of(lines, k), d[k, i:j])
        products[z - 2] += product
        squares[z - 2] += square


_work_sweep = _sweep(_work_finish)


@disjoint_parallel
def work(thread, d, of_d, lame, share, data, shape, where, products, squares, count):
    """Add d . A d and ||A d||^2 of each plane to `products` and `squares`.

    `of_d` is the table of rows of `d`, and `where` contains the spans of the tissue. `data`
    contains the tensors of the data term, which are part of A, or is None.
    """
    at = where[0]
    for number in portion(thread, count):
        first, last = bounds_of_part(number, count, len(at) - 4)
        about = products, squares
        _work_sweep(d, of_d, (lame, share, shape), where, data, about, first, last)


# Vectors


@disjoint
def _advance_line(d, share, direction):
    for x in range(len(d)):
        d[x] += share * direction[x]


@disjoint
def _subtract_line(rest, length, image):
    for x in range(len(rest)):
        rest[x] -= length * image[x]


@contracted_reduction
def _square_line(rest):
    total = rest.dtype.type(0)
    for x in range(len(rest)):
        total += rest[x] * rest[x]
    return total


@parallel
def advance(thread, d, of_d, share, rest, direction, image, length, at, spans, totals):
    """Add ``share * direction`` to `d`, and subtract ``length * image`` from `rest`.

    Store ``rest . rest`` of each plane in `totals`. `of_d` is the table of rows of `d`.
    """
    for n in portion(thread, len(at) - 4):
        z, total = n + 2, 0.0
        for y in range(2, at.shape[1] - 2):
            i, count = at[z, y] + spans[z, y, 0] + 2, spans[z, y, 1] - spans[z, y, 0]
            before = of_d[z, y] + spans[z, y, 0] + 2
            for k in range(3):
                _advance_line(d[k, before : before + count], share, direction[k, i : i + count])
                line = rest[k, i : i + count]
                _subtract_line(line, length, image[k, i : i + count])
                total += _square_line(line)
        totals[n] = total


# Transfer between levels


@disjoint
def _add_line(line, weight, fine):
    for x in range(len(fine)):
        line[x] += weight * fine[x]


@disjoint
def _sum_pairs(line, coarse):
    """Compute the restriction along a row; `line` begins one site before the first coarse site."""
    half = float32(0.5)
    for x in range(len(coarse)):
        coarse[x] = line[2 * x + 1] + half * (line[2 * x] + line[2 * x + 2])


@scratch_parallel
def restrict(thread, fine, of_fine, stored, coarse, of_coarse, spans):
    """Apply the transpose of `interpolate`; coarse site i coincides with fine site 2 i.

    `stored` contains the stored columns of each fine row, and `spans` those of each coarse row that
    are written.
    """
    for n in portion(thread, len(of_coarse) - 4):
        z = 2 * n + 2
        sums = np.empty(2 * np.int64(spans[n + 2, :, 1].max()) + 4, dtype=fine.dtype)
        for m in range(of_coarse.shape[1] - 4):
            y, begin, past = 2 * m + 2, spans[n + 2, m + 2, 0] + 2, spans[n + 2, m + 2, 1] + 2
            if past <= begin:
                continue
            first, last = 2 * begin - 3, 2 * past - 2  # fine columns
            line = sums[: last - first]
            for k in range(len(coarse)):
                line.fill(0)
                for row in range(9):
                    i, j = row // 3 - 1, row % 3 - 1
                    weight = float32(0.5 if i else 1) * float32(0.5 if j else 1)
                    at = of_fine[z + i, y + j]
                    low = max(first, stored[z + i, y + j, 0])
                    high = min(last, stored[z + i, y + j, 1])
                    if high > low:
                        _add_line(line[low - first :], weight, fine[k, at + low : at + high])
                at = of_coarse[n + 2, m + 2]
                _sum_pairs(line, coarse[k, at + begin : at + past])


@disjoint
def _mean_line(near, right, far, across, line):
    quarter = float32(0.25)
    for x in range(len(line)):
        line[x] = quarter * ((near[x] + right[x]) + (far[x] + across[x]))


@disjoint
def _add_between(line, inverse, fine):
    """Add the interpolation of `line` along a row, whose first site is a coarse site."""
    half = float32(0.5)
    for x in range(len(fine) // 2):
        here, between = line[x], half * (line[x] + line[x + 1])
        fine[2 * x] += here if inverse[2 * x] > float32(0) else float32(0)
        fine[2 * x + 1] += between if inverse[2 * x + 1] > float32(0) else float32(0)


@inline
def _mean_of_rows(coarse, of_coarse, k, n, m, first, line):
    """Compute the mean of the coarse rows around fine row (n, m), from coarse column `first`."""
    near, left = n // 2 + 2, m // 2 + 2
    far, right = near + n % 2, left + m % 2
    _mean_line(
        coarse[k, of_coarse[near, left] + first :],
        coarse[k, of_coarse[near, right] + first :],
        coarse[k, of_coarse[far, left] + first :],
        coarse[k, of_coarse[far, right] + first :],
        line,
    )


@scratch_parallel
def interpolate(thread, coarse, of_coarse, fine, of_fine, inverse, spans):
    """Add the trilinearly interpolated coarse correction to the components that move.

    `spans` contains the columns of each fine row with components that move.
    """
    for n in portion(thread, len(of_fine) - 4):
        means = np.empty(np.int64(spans[n + 2, :, 1].max()) // 2 + 4, dtype=fine.dtype)
        for m in range(of_fine.shape[1] - 4):
            begin, past = spans[n + 2, m + 2, 0], spans[n + 2, m + 2, 1]
            if past <= begin:
                continue
            begin -= begin % 2
            count = (past - begin + 1) // 2
            line = means[: count + 1]
            i = of_fine[n + 2, m + 2] + begin + 2
            for k in range(3):
                _mean_of_rows(coarse, of_coarse, k, n, m, begin // 2 + 2, line)
                _add_between(line, inverse[k, i:], fine[k, i : i + 2 * count])


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


@scratch_parallel
def add_relaxed(thread, coarse, of_coarse, fine, of_fine, inverse, weight, mixed, spans):
    """Interpolate a coarse correction, filter it for the data term, and add it to `fine`.

    `spans` contains the columns of each fine row with components that move.
    """
    for n in portion(thread, len(of_fine) - 4):
        most = np.int64(spans[n + 2, :, 1].max())
        means, lines = np.empty(most // 2 + 4, fine.dtype), np.zeros((3, most + 4), fine.dtype)
        for m in range(of_fine.shape[1] - 4):
            begin, past = spans[n + 2, m + 2, 0], spans[n + 2, m + 2, 1]
            if past <= begin:
                continue
            begin -= begin % 2
            count = (past - begin + 1) // 2
            i = of_fine[n + 2, m + 2] + begin + 2
            j = i + 2 * count
            lines.fill(0)
            for k in range(3):
                line = means[: count + 1]
                _mean_of_rows(coarse, of_coarse, k, n, m, begin // 2 + 2, line)
                _add_between(line, inverse[k, i:], lines[k, : 2 * count])
            _add_relaxed_line(
                (lines[0], lines[1], lines[2]),
                _three(inverse, 0, i, j),
                _three(weight, 0, i, j),
                _three(mixed, 0, i, j),
                _three(mixed, 3, i, j),
                _three(fine, 0, i, j),
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


@scratch_parallel
def elements(thread, m, each, one, scale, lame):
    """Compute the parameters of each element from the means of its sites; 0 if a site is void.

    If `one` is True, Poisson's ratio is uniform, and mu is `scale` times the sum of `m` over the
    corners. Otherwise, `each` contains the ratio at each site, and `scale` times the sum is Young's
    modulus.
    """
    for n in portion(thread, m.shape[0] - 1):
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
def coarsen(thread, fine, coarse):
    """Compute the parameters of coarse elements: a quarter of the sum over eight fine elements.

    This is twice their mean, because the energy of an element is proportional to its side length.
    """
    quarter = float32(0.25)
    for n in portion(thread, coarse.shape[1] - 4):
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


@disjoint
def _diagonal_line(near, right, far, across, factor, line):
    """Add `factor` times the sum over the elements at each site; lines begin one site before."""
    for x in range(len(line)):
        one = (near[x] + right[x]) + (far[x] + across[x])
        other = (near[x + 1] + right[x + 1]) + (far[x + 1] + across[x + 1])
        line[x] += factor * (one + other)


@parallel
def diagonal(thread, lame, share, shape, at, spans, out):
    """Compute the diagonal of the stiffness matrix within the spans of the tissue."""
    for n in portion(thread, len(at) - 4):
        z, last = n + 2, len(lame) - 1
        for k in range(3):
            stretch, slide = share * shape[k] * shape[k], float32(16) * shape[9 + k]
            for y in range(2, at.shape[1] - 2):
                begin, past = spans[z, y, 0] + 2, spans[z, y, 1] + 2
                if past <= begin:
                    continue
                line, before = out[k, at[z, y] + begin : at[z, y] + past], begin - 1
                one, two = at[z - 1, y - 1] + before, at[z - 1, y] + before
                three, four = at[z, y - 1] + before, at[z, y] + before
                line.fill(0)
                mu = lame[0, one:], lame[0, two:], lame[0, three:], lame[0, four:]
                _diagonal_line(*mu, slide, line)
                first = lame[last, one:], lame[last, two:], lame[last, three:], lame[last, four:]
                _diagonal_line(*first, stretch, line)
