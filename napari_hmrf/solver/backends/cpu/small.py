"""The small levels of elastic tissue's V-cycle.

The end of each row, where a loop has too few sites left for a vector of them, costs as much as the
rest of such a row: here a level is one long row, from its first site to its last and over the ring
of void between its rows, where nothing pulls and nothing moves.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32

from napari_hmrf.solver.backends.cpu import forces, small_cycle
from napari_hmrf.solver.backends.cpu.compiled import callee, strict

#: Planes of a level's model: Lame's parameters.
PLANES = np.int64(2)
# Position of the first site, and of the only row.
_FIRST = 2


@callee
def _length(d):
    """From the first site of a level to its last."""
    return (d.shape[1] - 5) * d.shape[2] + d.shape[2] - 4


@callee
def _smooth(d, load, lame, inverse, weight, shape, out, scale, ahead, back):
    """As `elastic.smooth`."""
    for k in range(_length(d)):
        j = _FIRST + k
        row, col = forces.rest(d, load, lame, weight, shape, _FIRST, j)
        row = scale * inverse[0, _FIRST, j] * row + ahead * d[0, _FIRST, j]
        col = scale * inverse[1, _FIRST, j] * col + ahead * d[1, _FIRST, j]
        row -= back * out[0, _FIRST, j]
        col -= back * out[1, _FIRST, j]
        out[0, _FIRST, j] = d[0, _FIRST, j] + row
        out[1, _FIRST, j] = d[1, _FIRST, j] + col


@callee
def _residual(d, load, lame, inverse, weight, shape, out):
    """Out = load - (A + W) d, 0 at sites that do not move."""
    for k in range(_length(d)):
        j = _FIRST + k
        row, col = forces.rest(d, load, lame, weight, shape, _FIRST, j)
        out[0, _FIRST, j] = row if inverse[0, _FIRST, j] > float32(0) else row - row
        out[1, _FIRST, j] = col if inverse[1, _FIRST, j] > float32(0) else col - col


_cycle = small_cycle.cycle_of(PLANES, _smooth, _residual)


@strict
def cycle(values, table, shape, down, up, coarsest):
    """Run a V-cycle over levels, as `small_cycle.cycle_of` says."""
    _cycle(values, table, shape, down, up, coarsest)
