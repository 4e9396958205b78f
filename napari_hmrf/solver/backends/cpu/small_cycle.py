"""The V-cycle over small levels, all in one go and by one thread, for any model.

Waking the other threads, and calling kernels one by one, costs more than such levels do.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from typing import Any

import numpy as np

from napari_hmrf.solver.backends.cpu import vectors
from napari_hmrf.solver.backends.cpu.compiled import callee

# A level's arrays of two planes, in this order, and last those of its model. They are no
# numbers of Python's: each of those would have numba make functions of its own.
INVERSE, LOAD, CORRECTION, OTHER, PINS, WEIGHT, REST, MODEL = np.arange(8)

_restrict = callee(vectors.restrict.py_func)
_interpolate = callee(vectors.interpolate.py_func)


@callee
def _planes(values, table, k, first, count):
    """So many planes of level k from the first of array `first`, (count, H + 4, W + 4)."""
    height, width, begin = table[k, 0] + 4, table[k, 1] + 4, table[k, 2]
    size = height * width
    begin += 2 * first * size
    return values[begin : begin + count * size].reshape((count, height, width))


@callee
def _plane(values, table, k, number):
    """Array `number` of level k, (2, H + 4, W + 4)."""
    return _planes(values, table, k, number, 2)


@callee
def _start(load, inverse, d, scale):
    """The first step from zero, d = scale D^-1 load, as one long row."""
    for k in range((d.shape[1] - 5) * d.shape[2] + d.shape[2] - 4):
        j = 2 + k
        d[0, 2, j] = scale * inverse[0, 2, j] * load[0, 2, j]
        d[1, 2, j] = scale * inverse[1, 2, j] * load[1, 2, j]


def cycle_of(planes: Any, smooth: Any, rest: Any) -> Any:
    """Compile the V-cycle of a model.

    Parameters
    ----------
    planes : int
        Number of planes of a level that belong to its model.
    smooth : callable
        A Chebyshev step: ``smooth(d, load, own, inverse, weight, about, out, scale, ahead, back)``,
        with what is known of the level, and of all of them.
    rest : callable
        What is left of the load: ``rest(d, load, own, inverse, weight, about, out)``.
    """

    @callee
    def relax(values, table, about, k, steps, begun, turned):
        """Steps of smoothing on level k; whether the correction is in the other array after."""
        inverse, load, weight, own = (
            _plane(values, table, k, INVERSE),
            _plane(values, table, k, LOAD),
            _plane(values, table, k, WEIGHT),
            _planes(values, table, k, MODEL, planes),
        )
        for number in range(begun, len(steps)):
            d = _plane(values, table, k, OTHER if turned else CORRECTION)
            out = _plane(values, table, k, CORRECTION if turned else OTHER)
            scale, ahead, back = steps[number, 0], steps[number, 1], steps[number, 2]
            smooth(d, load, own, inverse, weight, about, out, scale, ahead, back)
            turned = not turned
        return turned

    @callee
    def cycle(values, table, about, down, up, coarsest):
        """A V-cycle over levels, finest first, for the load of the first.

        `values` has the arrays of one level after the other, each level's in the order of the
        numbers above; a row of `table` has a level's height and width, and where its arrays begin.
        A row of steps has a step's scale, and how far ahead and back it goes. The correction of a
        level is in `CORRECTION` after an odd number of steps down and up, else in `OTHER`.
        """
        last = len(table) - 1
        for k in range(last + 1):
            steps = coarsest if k == last else down
            load, inverse = _plane(values, table, k, LOAD), _plane(values, table, k, INVERSE)
            _start(load, inverse, _plane(values, table, k, CORRECTION), steps[0, 0])
            turned = relax(values, table, about, k, steps, 1, False)
            if k < last:
                d = _plane(values, table, k, OTHER if turned else CORRECTION)
                own = _planes(values, table, k, MODEL, planes)
                weight, left = _plane(values, table, k, WEIGHT), _plane(values, table, k, REST)
                rest(d, load, own, inverse, weight, about, left)
                _restrict(left, _plane(values, table, k + 1, LOAD))
        for back in range(last):
            k = last - 1 - back
            below = (len(coarsest) if back == 0 else len(down) + len(up)) % 2 == 1
            coarse = _plane(values, table, k + 1, CORRECTION if below else OTHER)
            turned = len(down) % 2 == 0
            d = _plane(values, table, k, OTHER if turned else CORRECTION)
            _interpolate(coarse, d, _plane(values, table, k, INVERSE))
            relax(values, table, about, k, up, 0, turned)

    return cycle
