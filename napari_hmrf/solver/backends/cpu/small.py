"""V-cycle over the small levels of elastic tissue.

The last sites of a row do not fill a vector instruction. In a short row, these sites take as long
as all other sites together. This module therefore treats a level as one long row from its first
site to its last site. The long row includes the border of void between the rows of the level, where
all forces and corrections are zero.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32

from napari_hmrf.solver.backends.cpu import forces, small_cycle
from napari_hmrf.solver.backends.cpu.compiled import (
    ALONE,
    callee,
    disjoint_callee,
    portion,
    scratch_parallel,
    shared,
    strict,
)
from napari_hmrf.solver.backends.cpu.data_weights import filtered, relaxed

#: Number of model planes per level: the two Lame parameters.
PLANES = np.int64(2)
#: Same with a data term.
DATA_PLANES = np.int64(4)
# Index of the first site of a row in padded arrays, and of the first row.
_FIRST = 2


@callee
def _length(d):
    """Return the number of sites of the long row."""
    return (d.shape[1] - 5) * d.shape[2] + d.shape[2] - 4


@disjoint_callee
def _smooth(d, load, lame, inverse, weight, shape, out, scale, ahead, back):
    """Compute a Chebyshev step; see `elastic.smooth`."""
    for k in range(_length(d)):
        j = _FIRST + k
        row, col = forces.rest(d, load, lame, weight, shape, _FIRST, j)
        row = scale * inverse[0, _FIRST, j] * row + ahead * d[0, _FIRST, j]
        col = scale * inverse[1, _FIRST, j] * col + ahead * d[1, _FIRST, j]
        row -= back * out[0, _FIRST, j]
        col -= back * out[1, _FIRST, j]
        out[0, _FIRST, j] = d[0, _FIRST, j] + row
        out[1, _FIRST, j] = d[1, _FIRST, j] + col


@disjoint_callee
def _residual(d, load, lame, inverse, weight, shape, out):
    """Write load - (A + W) d to `out`, or 0 at components that do not move."""
    for k in range(_length(d)):
        j = _FIRST + k
        row, col = forces.rest(d, load, lame, weight, shape, _FIRST, j)
        out[0, _FIRST, j] = row if inverse[0, _FIRST, j] > float32(0) else row - row
        out[1, _FIRST, j] = col if inverse[1, _FIRST, j] > float32(0) else col - col


_cycle = small_cycle.cycle_of(PLANES, small_cycle.start, _smooth, _residual, small_cycle.add_coarse)


@strict
def cycle(values, table, shape, down, up, coarsest):
    """Run a V-cycle over small levels; see `small_cycle.cycle_of`."""
    _cycle(values, table, shape, down, up, coarsest)


@scratch_parallel
def responses(thread, values, table, shape, down, up, coarsest, number, at, found):
    """Run a V-cycle for a unit load at each of several values of the first level.

    `at` contains the indices of the values in the flattened planes of the level, and `number` the
    array with its correction. The correction at value l for a load at value k is ``found[k, l]``.
    """
    own = values.copy()
    load = small_cycle.plane(own, table, 0, small_cycle.LOAD).reshape(-1)
    correction = small_cycle.plane(own, table, 0, number).reshape(-1)
    load[:] = float32(0)
    for k in portion(thread, len(at)):
        load[at[k]] = float32(1)
        _cycle(own, table, shape, down, up, coarsest)
        load[at[k]] = float32(0)
        for column in range(len(at)):
            found[k, column] = correction[at[column]]


# With a data term, the last two planes of a level are those of `data_weights.couple`: the mixed
# component of W, and that of the block of the smoother.


@callee
def start_data(load, own, inverse, d, scale):
    """Compute the first step from zero, ``d = scale * (D + W)^-1 load``."""
    of_block = own[-1]
    for k in range(_length(d)):
        j = _FIRST + k
        row, col, mixed = load[0, _FIRST, j], load[1, _FIRST, j], of_block[_FIRST, j]
        d[0, _FIRST, j] = scale * (inverse[0, _FIRST, j] * row + mixed * col)
        d[1, _FIRST, j] = scale * (mixed * row + inverse[1, _FIRST, j] * col)


@disjoint_callee
def _smooth_data(d, load, own, inverse, weight, shape, out, scale, ahead, back):
    """Compute a Chebyshev step; see `elastic.smooth`."""
    for k in range(_length(d)):
        j = _FIRST + k
        row, col = forces.rest(d, load, own, weight, shape, _FIRST, j)
        row -= own[2, _FIRST, j] * d[1, _FIRST, j]
        col -= own[2, _FIRST, j] * d[0, _FIRST, j]
        mixed = own[3, _FIRST, j]
        row, col = (
            inverse[0, _FIRST, j] * row + mixed * col,
            mixed * row + inverse[1, _FIRST, j] * col,
        )
        row = scale * row + ahead * d[0, _FIRST, j] - back * out[0, _FIRST, j]
        col = scale * col + ahead * d[1, _FIRST, j] - back * out[1, _FIRST, j]
        out[0, _FIRST, j] = d[0, _FIRST, j] + row
        out[1, _FIRST, j] = d[1, _FIRST, j] + col


@shared
def _blocks(inverse, weight, own):
    """Return the arguments of `filtered` for the level as one long row."""
    return (
        (inverse[0, _FIRST], inverse[1, _FIRST]),
        (weight[0, _FIRST], weight[1, _FIRST]),
        (own[-2, _FIRST], own[-1, _FIRST]),
    )


@disjoint_callee
def _residual_data(d, load, own, inverse, weight, shape, out):
    """Write the filtered residual to `out`, or 0 at components that do not move."""
    pairs = _blocks(inverse, weight, own)
    for k in range(_length(d)):
        j = _FIRST + k
        row, col = forces.rest(d, load, own, weight, shape, _FIRST, j)
        row -= own[2, _FIRST, j] * d[1, _FIRST, j]
        col -= own[2, _FIRST, j] * d[0, _FIRST, j]
        row, col = filtered(row, col, *pairs, j)
        out[0, _FIRST, j] = row if inverse[0, _FIRST, j] > float32(0) else row - row
        out[1, _FIRST, j] = col if inverse[1, _FIRST, j] > float32(0) else col - col


@callee
def add_coarse_data(coarse, d, spare, own, inverse, weight):
    """Add the interpolated coarse correction, filtered (`data_weights`)."""
    spare[:] = 0
    small_cycle.interpolate(ALONE, coarse, spare, inverse)
    pairs = _blocks(inverse, weight, own)
    for k in range(_length(d)):
        j = _FIRST + k
        row, col = spare[0, _FIRST, j], spare[1, _FIRST, j]
        row, col = relaxed(row, col, *pairs, j)
        d[0, _FIRST, j] += row
        d[1, _FIRST, j] += col


_data_cycle = small_cycle.cycle_of(
    DATA_PLANES, start_data, _smooth_data, _residual_data, add_coarse_data
)


@strict
def data_cycle(values, table, shape, down, up, coarsest):
    """Run a V-cycle over small levels of a model with a data term."""
    _data_cycle(values, table, shape, down, up, coarsest)
