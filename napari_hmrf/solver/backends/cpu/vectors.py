"""Compiled loops over vectors, for multigrid and Krylov iterations of any model.

All arrays have a border of void, two sites wide. `inverse` is the reciprocal of the model's
diagonal, and 0 where a component does not move. Scalar products are returned per row. Loops that
treat rows independently also accept volumes as views of all rows (`level.rows`).
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, int32, int64, prange

from napari_hmrf.solver.backends.cpu.compiled import (
    disjoint,
    inline,
    parallel,
    reduction,
    strict_callee,
)


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
def hold(inverse, held, pins, spans):
    """Replace a diagonal with its reciprocal, or 0 where `held` is True; set `pins` to 1 or 0."""
    past = inverse.shape[2] - 2
    for n in prange(inverse.shape[1] - 4):
        i = n + 2
        for k in range(len(inverse)):
            hold_line(inverse[k, i, 2:past], held[k, i, 2:past], pins[k, i, 2:past])
        span(inverse[:, i, 2:past], 0, spans[n])


@parallel
def spring(inverse, pins, most, strength, weight, spans):
    """Set the springs of a coarser level, and replace its diagonal D with 1 / (D + springs).

    The strength of a spring is ``strength * min(pins, most) * diagonal``.
    """
    past = inverse.shape[2] - 2
    for n in prange(inverse.shape[1] - 4):
        i = n + 2
        for k in range(len(inverse)):
            lines = inverse[k, i, 2:past], pins[k, i, 2:past], weight[k, i, 2:past]
            spring_line(lines[0], lines[1], lines[2], most, strength)
        span(inverse[:, i, 2:past], 0, spans[n])


@parallel
def smooth_first(load, inverse, step, d, scale):
    """Compute the first Chebyshev step from d = 0: ``step = d = scale * D^-1 load``."""
    for i in prange(load.shape[1] - 4):
        for j in range(load.shape[2]):
            row = scale * inverse[0, i + 2, j] * load[0, i + 2, j]
            col = scale * inverse[1, i + 2, j] * load[1, i + 2, j]
            step[0, i + 2, j] = row
            step[1, i + 2, j] = col
            d[0, i + 2, j] = row
            d[1, i + 2, j] = col


@disjoint
def restrict_row(above, here, below, coarse):
    """Compute one row of `restrict` for one component from three fine rows."""
    half = float32(0.5)
    for j in range(len(coarse) - 4):
        left = here[2 * j + 1] + half * (above[2 * j + 1] + below[2 * j + 1])
        middle = here[2 * j + 2] + half * (above[2 * j + 2] + below[2 * j + 2])
        right = here[2 * j + 3] + half * (above[2 * j + 3] + below[2 * j + 3])
        coarse[j + 2] = middle + half * (left + right)


@parallel
def restrict(fine, coarse):
    """Apply the transpose of `interpolate`; coarse site i coincides with fine site 2 i."""
    for i in prange(coarse.shape[1] - 4):
        for component in range(len(coarse)):
            restrict_row(
                fine[component, 2 * i + 1],
                fine[component, 2 * i + 2],
                fine[component, 2 * i + 3],
                coarse[component, i + 2],
            )


@parallel
def interpolate(coarse, fine, inverse):
    """Add the bilinearly interpolated coarse correction to the components that move."""
    for i in prange(fine.shape[1] - 4):
        near = i // 2 + 2
        far = near + i % 2
        for component in range(2):
            for j in range((fine.shape[2] - 3) // 2):
                here = coarse[component, near, j + 2] + coarse[component, far, j + 2]
                after = coarse[component, near, j + 3] + coarse[component, far, j + 3]
                here *= float32(0.5)
                between = float32(0.5) * here + float32(0.25) * after
                moves = inverse[component, i + 2, 2 * j + 2] > float32(0)
                fine[component, i + 2, 2 * j + 2] += here if moves else float32(0)
                moves = inverse[component, i + 2, 2 * j + 3] > float32(0)
                fine[component, i + 2, 2 * j + 3] += between if moves else float32(0)


@parallel
def advance(d, share, rest, direction, image, length, row_totals):
    """Add ``share * direction`` to `d`, and subtract ``length * image`` from `rest`.

    Store ``rest . rest`` of each row in `row_totals`.
    """
    for i in prange(d.shape[1] - 4):
        for component in range(len(d)):
            for j in range(d.shape[2]):
                d[component, i + 2, j] += share * direction[component, i + 2, j]
                rest[component, i + 2, j] -= length * image[component, i + 2, j]
        row_totals[i] = row_product(rest, rest, i + 2)


@parallel
def lean(rest, direction, image, share, stride):
    """Compute ``direction = rest + share * (direction - stride * image)``."""
    for i in prange(direction.shape[1] - 4):
        for component in range(len(direction)):
            for j in range(direction.shape[2]):
                direction[component, i + 2, j] = rest[component, i + 2, j] + share * (
                    direction[component, i + 2, j] - stride * image[component, i + 2, j]
                )


@parallel
def product(a, b, row_totals):
    """Compute the scalar product of two vectors, per row."""
    for i in prange(a.shape[1] - 4):
        row_totals[i] = row_product(a, b, i + 2)


@strict_callee
def row_largest(a: Any, row: int) -> Any:
    """Return the largest absolute value of one row, or NaN if the row contains NaN.

    Without the sign bit, floating-point numbers are ordered like their bits as integers, and
    integer comparisons vectorize.
    """
    most = int32(0)
    for component in range(len(a)):
        bits = a[component, row].view(np.int32)
        for j in range(len(bits)):
            most = max(most, bits[j] & int32(0x7FFFFFFF))
    return np.int32(most).view(np.float32)


@parallel
def largest(a, row_most):
    """Compute the largest absolute value of each row."""
    for i in prange(a.shape[1] - 4):
        row_most[i] = row_largest(a, i + 2)


@parallel
def weigh(a, b, row_most, row_totals):
    """Compute `largest` of `a` and `product` of `a` and `b` in one pass."""
    for i in prange(a.shape[1] - 4):
        row_most[i] = row_largest(a, i + 2)
        row_totals[i] = row_product(a, b, i + 2)
