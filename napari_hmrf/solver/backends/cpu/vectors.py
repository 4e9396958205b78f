"""Compiled loops over vectors, for multigrid and Krylov iterations of any model.

Planes have a border of void, two sites wide. `inverse` is the reciprocal of the model's
diagonal, and 0 where a component does not move. Scalar products are returned per row. Loops that
treat rows independently also accept volumes as views of all rows (`layout.rows`), and loops that
visit all values in any order accept each layout (`layout`).
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, int32, int64

from napari_hmrf.solver.backends.cpu.compiled import (
    disjoint,
    disjoint_parallel,
    inline,
    parallel,
    portion,
    reduction,
    strict_callee,
)


@reduction
def line_product(a: Any, b: Any) -> Any:
    """Return the scalar product of one component of a row."""
    total = float32(0)
    for j in range(len(a)):
        total += a[j] * b[j]
    return total


@reduction
def row_product(a: Any, b: Any, row: int) -> float:
    """Return the scalar product of one row."""
    total = float32(0)
    for component in range(len(a)):
        for j in range(a.shape[2]):
            total += a[component, row, j] * b[component, row, j]
    return total


@inline
def span(inverse, first, out):
    """Store the start and stop column of the moving sites of a row in `out`.

    `inverse` contains the row from column `first`, counted without the border.
    """
    begin, past = int64(0), int64(0)
    for j in range(inverse.shape[1]):
        for k in range(len(inverse)):
            if inverse[k, j] > float32(0):
                if past == 0:
                    begin = first + j
                past = first + j + 1
    out[0] = begin
    out[1] = past


@inline
def hold_line(inverse, held, pins):
    """Compute `hold` for one component of a row."""
    for j in range(len(inverse)):
        diagonal, here = inverse[j], held[j]
        moves = diagonal > float32(0) and not here
        inverse[j] = float32(1) / diagonal if moves else float32(0)
        pins[j] = float32(1) if here else float32(0)


@inline
def spring_line(inverse, pins, weight, most, strength):
    """Compute `spring` for one component of a row."""
    for j in range(len(inverse)):
        diagonal = inverse[j]
        pins[j] = min(pins[j], most)
        weight[j] = strength * pins[j] * diagonal
        whole = diagonal + weight[j]
        inverse[j] = float32(1) / whole if whole > float32(0) else float32(0)


@parallel
def hold(thread, inverse, at, held, of_held, pins, of_pins, tissue, spans):
    """Replace a diagonal with its reciprocal, or 0 where `held` is True; set `pins` to 1 or 0.

    Each array has a table of rows (`layout`). Visit only the columns `tissue` of each row; store
    the columns with components that move in `spans`.
    """
    for n in portion(thread, len(spans)):
        i = n + 2
        first, count = tissue[i, 0], tissue[i, 1] - tissue[i, 0]
        own, other, third = at[i] + first + 2, of_held[i] + first + 2, of_pins[i] + first + 2
        for k in range(len(inverse)):
            hold_line(
                inverse[k, own : own + count],
                held[k, other : other + count],
                pins[k, third : third + count],
            )
        span(inverse[:, own : own + count], first, spans[n])


@parallel
def spring(thread, inverse, weight, at, pins, of_pins, most, strength, tissue, spans):
    """Set the springs of a coarser level, and replace its diagonal D with 1 / (D + springs).

    The strength of a spring is ``strength * min(pins, most) * diagonal``. `at` is the table of rows
    of `inverse` and `weight`; see `hold`.
    """
    for n in portion(thread, len(spans)):
        i = n + 2
        first, count = tissue[i, 0], tissue[i, 1] - tissue[i, 0]
        own, other = at[i] + first + 2, of_pins[i] + first + 2
        for k in range(len(inverse)):
            spring_line(
                inverse[k, own : own + count],
                pins[k, other : other + count],
                weight[k, own : own + count],
                most,
                strength,
            )
        span(inverse[:, own : own + count], first, spans[n])


@disjoint_parallel
def element_spans(thread, shear, spans):
    """Store the start and stop column of the elements of each row that are not void in `spans`.

    `shear` contains the shear modulus of the elements of each padded row.
    """
    for i in portion(thread, len(spans)):
        begin, past = int64(0), int64(0)
        for j in range(shear.shape[1]):
            if shear[i, j] > 0:
                if past == 0:
                    begin = j
                past = j + 1
        spans[i, 0] = begin
        spans[i, 1] = past


@disjoint_parallel
def copy_rows(thread, source, of_source, target, of_target, stored):
    """Copy the columns `stored` of each row from one layout to another."""
    for i in portion(thread, len(stored)):
        begin, past = stored[i, 0], stored[i, 1]
        for k in range(len(source)):
            for j in range(begin, past):
                target[k, of_target[i] + j] = source[k, of_source[i] + j]


@disjoint_parallel
def smooth_first(thread, load, inverse, step, d, scale):
    """Compute the first Chebyshev step from d = 0: ``step = d = scale * D^-1 load``."""
    for i in portion(thread, load.shape[1] - 4):
        for j in range(load.shape[2]):
            row = scale * inverse[0, i + 2, j] * load[0, i + 2, j]
            col = scale * inverse[1, i + 2, j] * load[1, i + 2, j]
            step[0, i + 2, j] = row
            step[1, i + 2, j] = col
            d[0, i + 2, j] = row
            d[1, i + 2, j] = col


@disjoint
def restrict_row(above, here, below, coarse):
    """Compute one row of `restrict` for one component from three fine rows.

    The fine rows begin one site before the first coarse site.
    """
    half = float32(0.5)
    for j in range(len(coarse)):
        left = here[2 * j] + half * (above[2 * j] + below[2 * j])
        middle = here[2 * j + 1] + half * (above[2 * j + 1] + below[2 * j + 1])
        right = here[2 * j + 2] + half * (above[2 * j + 2] + below[2 * j + 2])
        coarse[j] = middle + half * (left + right)


@parallel
def restrict(thread, fine, coarse):
    """Apply the transpose of `interpolate`; coarse site i coincides with fine site 2 i."""
    past = coarse.shape[2] - 2
    for i in portion(thread, coarse.shape[1] - 4):
        for component in range(len(coarse)):
            restrict_row(
                fine[component, 2 * i + 1, 1:],
                fine[component, 2 * i + 2, 1:],
                fine[component, 2 * i + 3, 1:],
                coarse[component, i + 2, 2:past],
            )


@disjoint
def interpolate_row(near, far, inverse, fine):
    """Compute one row of `interpolate` for one component; all rows begin at a coarse site.

    `near` and `far` are the coarse rows around the fine row.
    """
    for j in range(len(fine) // 2):
        here = float32(0.5) * (near[j] + far[j])
        after = float32(0.25) * (near[j + 1] + far[j + 1])
        between = float32(0.5) * here + after
        fine[2 * j] += here if inverse[2 * j] > float32(0) else float32(0)
        fine[2 * j + 1] += between if inverse[2 * j + 1] > float32(0) else float32(0)


@parallel
def interpolate(thread, coarse, fine, inverse):
    """Add the bilinearly interpolated coarse correction to the components that move."""
    past = fine.shape[2] - 2 + fine.shape[2] % 2  # the last pair may extend into the border
    for i in portion(thread, fine.shape[1] - 4):
        near = i // 2 + 2
        far = near + i % 2
        for component in range(2):
            interpolate_row(
                coarse[component, near, 2:],
                coarse[component, far, 2:],
                inverse[component, i + 2, 2:past],
                fine[component, i + 2, 2:past],
            )


@disjoint_parallel
def advance(thread, d, share, rest, direction, image, length, row_totals):
    """Add ``share * direction`` to `d`, and subtract ``length * image`` from `rest`.

    Store ``rest . rest`` of each row in `row_totals`.
    """
    for i in portion(thread, d.shape[1] - 4):
        for component in range(len(d)):
            for j in range(d.shape[2]):
                d[component, i + 2, j] += share * direction[component, i + 2, j]
                rest[component, i + 2, j] -= length * image[component, i + 2, j]
        row_totals[i] = row_product(rest, rest, i + 2)


@disjoint_parallel
def lean(thread, rest, direction, image, share, stride):
    """Compute ``direction = rest + share * (direction - stride * image)``."""
    for i in portion(thread, direction.shape[1] - 4):
        for component in range(len(direction)):
            for j in range(direction.shape[2]):
                direction[component, i + 2, j] = rest[component, i + 2, j] + share * (
                    direction[component, i + 2, j] - stride * image[component, i + 2, j]
                )


@disjoint_parallel
def product(thread, a, b, row_totals):
    """Compute the scalar product of two vectors, per row."""
    for i in portion(thread, a.shape[1] - 4):
        row_totals[i] = row_product(a, b, i + 2)


@strict_callee
def line_largest(a: Any) -> Any:
    """Return the bits of the largest absolute value of one component of a row, or those of NaN.

    Without the sign bit, floating-point numbers are ordered like their bits as integers, and
    integer comparisons vectorize.
    """
    bits, most = a.view(np.int32), int32(0)
    for j in range(len(bits)):
        most = max(most, bits[j] & int32(0x7FFFFFFF))
    return most


@strict_callee
def row_largest(a: Any, row: int) -> Any:
    """Return the largest absolute value of one row, or NaN if the row contains NaN."""
    most = int32(0)
    for component in range(len(a)):
        most = max(most, line_largest(a[component, row]))
    return np.int32(most).view(np.float32)


@disjoint_parallel
def largest(thread, a, row_most):
    """Compute the largest absolute value of each row."""
    for i in portion(thread, a.shape[1] - 4):
        row_most[i] = row_largest(a, i + 2)


@disjoint_parallel
def weigh(thread, a, b, row_most, row_totals):
    """Compute `largest` of `a` and `product` of `a` and `b` in one pass."""
    for i in portion(thread, a.shape[1] - 4):
        row_most[i] = row_largest(a, i + 2)
        row_totals[i] = row_product(a, b, i + 2)
