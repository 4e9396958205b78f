"""The small levels of the V-cycle, all in one go and by one thread.

Waking the other threads, and calling kernels one by one, costs more than such levels do. So does
the end of each row, where a loop has too few sites left for a vector of them: here a level is one
long row, from its first site to its last and over the ring of void between its rows, where nothing
pulls and nothing moves.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import float32

from napari_hmrf.solver.backends.cpu import forces, vectors
from napari_hmrf.solver.backends.cpu.compiled import callee, strict

# A level's arrays, in this order. They are no numbers of Python's: each of those would have numba
# make functions of its own.
INVERSE, LOAD, CORRECTION, OTHER, LAME, PINS, WEIGHT, REST = np.arange(8)
ARRAYS = 8

# Where the first site lies, and the only row there is.
_FIRST = 2

_restrict = callee(vectors.restrict.py_func)
_interpolate = callee(vectors.interpolate.py_func)


@callee
def _length(d):
    """From the first site of a level to its last."""
    return (d.shape[1] - 5) * d.shape[2] + d.shape[2] - 4


@callee
def _start(load, inverse, d, scale):
    """The first step from zero: d = scale D^-1 load."""
    for k in range(_length(d)):
        j = _FIRST + k
        d[0, _FIRST, j] = scale * inverse[0, _FIRST, j] * load[0, _FIRST, j]
        d[1, _FIRST, j] = scale * inverse[1, _FIRST, j] * load[1, _FIRST, j]


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


@callee
def _plane(values, table, k, number):
    """Array `number` of level k, (2, H + 4, W + 4)."""
    height, width, first = table[k, 0] + 4, table[k, 1] + 4, table[k, 2]
    size = 2 * height * width
    return values[first + number * size : first + (number + 1) * size].reshape((2, height, width))


@callee
def _relax(values, table, shape, k, steps, begun, turned):
    """Steps of smoothing on level k; whether the correction is in the other array after them."""
    inverse, load, lame, weight = (
        _plane(values, table, k, INVERSE),
        _plane(values, table, k, LOAD),
        _plane(values, table, k, LAME),
        _plane(values, table, k, WEIGHT),
    )
    for number in range(begun, len(steps)):
        d = _plane(values, table, k, OTHER if turned else CORRECTION)
        out = _plane(values, table, k, CORRECTION if turned else OTHER)
        scale, ahead, back = steps[number, 0], steps[number, 1], steps[number, 2]
        _smooth(d, load, lame, inverse, weight, shape, out, scale, ahead, back)
        turned = not turned
    return turned


@strict
def cycle(values, table, shape, down, up, coarsest):
    """A V-cycle over levels, finest first, for the load of the first.

    `values` has the arrays of one level after the other, each level's in the order of the numbers
    above; a row of `table` has a level's height and width, and where its arrays begin. A row of
    steps has a step's scale, and how far ahead and back it goes. The correction of a level is in
    `CORRECTION` after an odd number of steps down and up, else in `OTHER`.
    """
    last = len(table) - 1
    for k in range(last + 1):
        steps = coarsest if k == last else down
        load, inverse = _plane(values, table, k, LOAD), _plane(values, table, k, INVERSE)
        _start(load, inverse, _plane(values, table, k, CORRECTION), steps[0, 0])
        turned = _relax(values, table, shape, k, steps, 1, False)
        if k < last:
            rest = _plane(values, table, k, REST)
            _residual(
                _plane(values, table, k, OTHER if turned else CORRECTION),
                load,
                _plane(values, table, k, LAME),
                inverse,
                _plane(values, table, k, WEIGHT),
                shape,
                rest,
            )
            _restrict(rest, _plane(values, table, k + 1, LOAD))
    for back in range(last):
        k = last - 1 - back
        below = (len(coarsest) if back == 0 else len(down) + len(up)) % 2 == 1
        coarse = _plane(values, table, k + 1, CORRECTION if below else OTHER)
        turned = len(down) % 2 == 0
        d = _plane(values, table, k, OTHER if turned else CORRECTION)
        _interpolate(coarse, d, _plane(values, table, k, INVERSE))
        _relax(values, table, shape, k, up, 0, turned)
