"""V-cycle over all small levels in one single-threaded call, for any model.

On small levels, waking other threads and calling kernels separately takes longer than the kernels.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from typing import Any

import numpy as np

from napari_hmrf.solver.backends.cpu import vectors
from napari_hmrf.solver.backends.cpu.compiled import ALONE, callee

# Indices of a level's arrays, which have two planes each; the model planes are last. The indices
# are NumPy integers, because numba would compile a function again for each Python constant.
INVERSE, LOAD, CORRECTION, OTHER, PINS, WEIGHT, REST, MODEL = np.arange(8)

_restrict = callee(vectors.restrict.compiled.py_func)
interpolate = callee(vectors.interpolate.compiled.py_func)


@callee
def _planes(values, table, k, first, count):
    """Return `count` planes of level k, starting at array `first`: (count, H + 4, W + 4)."""
    height, width, begin = table[k, 0] + 4, table[k, 1] + 4, table[k, 2]
    size = height * width
    begin += 2 * first * size
    return values[begin : begin + count * size].reshape((count, height, width))


@callee
def plane(values, table, k, number):
    """Return array `number` of level k, shape (2, H + 4, W + 4)."""
    return _planes(values, table, k, number, 2)


@callee
def start(load, own, inverse, d, scale):
    """Compute the first step from zero, ``d = scale * D^-1 load``, on the level as one long row."""
    for k in range((d.shape[1] - 5) * d.shape[2] + d.shape[2] - 4):
        j = 2 + k
        d[0, 2, j] = scale * inverse[0, 2, j] * load[0, 2, j]
        d[1, 2, j] = scale * inverse[1, 2, j] * load[1, 2, j]


@callee
def add_coarse(coarse, d, spare, own, inverse, weight):
    """Add the interpolated coarse correction to `d`."""
    interpolate(ALONE, coarse, d, inverse)


def cycle_of(planes: Any, begin: Any, smooth: Any, rest: Any, add_coarse: Any) -> Any:
    """Compile the V-cycle of a model.

    Parameters
    ----------
    planes : int
        Number of model planes per level.
    begin : callable
        First step from zero, such as `start`: ``begin(load, own, inverse, d, scale)``.
    smooth : callable
        Chebyshev step: ``smooth(d, load, own, inverse, weight, about, out, scale, ahead, back)``.
        `own` contains the model planes of the level, and `about` the parameters common to all
        levels.
    rest : callable
        Residual: ``rest(d, load, own, inverse, weight, about, out)``.
    add_coarse : callable
        Interpolation, such as `add_coarse`: ``add_coarse(coarse, d, spare, own, inverse, weight)``.
        `spare` is overwritten.

    Returns
    -------
    callable
        V-cycle: ``cycle(values, table, about, down, up, coarsest)``.
    """

    @callee
    def relax(values, table, about, k, steps, begun, turned):
        """Smooth on level k; return True if the correction is then in `OTHER`."""
        inverse, load, weight, own = (
            plane(values, table, k, INVERSE),
            plane(values, table, k, LOAD),
            plane(values, table, k, WEIGHT),
            _planes(values, table, k, MODEL, planes),
        )
        for number in range(begun, len(steps)):
            d = plane(values, table, k, OTHER if turned else CORRECTION)
            out = plane(values, table, k, CORRECTION if turned else OTHER)
            scale, ahead, back = steps[number, 0], steps[number, 1], steps[number, 2]
            smooth(d, load, own, inverse, weight, about, out, scale, ahead, back)
            turned = not turned
        return turned

    @callee
    def cycle(values, table, about, down, up, coarsest):
        """Run a V-cycle over levels, finest first, for the load of the first level.

        `values` contains the arrays of all levels. The arrays of a level are in the order of the
        indices above. A row of `table` contains the height and width of a level, and the index at
        which its arrays start. `down`, `up` and `coarsest` contain (scale, ahead, back) for each
        smoothing step. The correction of a level is in `CORRECTION` after an odd total number of
        steps, otherwise in `OTHER`.
        """
        last = len(table) - 1
        for k in range(last + 1):
            steps = coarsest if k == last else down
            load, inverse = plane(values, table, k, LOAD), plane(values, table, k, INVERSE)
            own = _planes(values, table, k, MODEL, planes)
            begin(load, own, inverse, plane(values, table, k, CORRECTION), steps[0, 0])
            turned = relax(values, table, about, k, steps, 1, False)
            if k < last:
                d = plane(values, table, k, OTHER if turned else CORRECTION)
                weight, left = plane(values, table, k, WEIGHT), plane(values, table, k, REST)
                rest(d, load, own, inverse, weight, about, left)
                _restrict(ALONE, left, plane(values, table, k + 1, LOAD))
        for back in range(last):
            k = last - 1 - back
            below = (len(coarsest) if back == 0 else len(down) + len(up)) % 2 == 1
            coarse = plane(values, table, k + 1, CORRECTION if below else OTHER)
            turned = len(down) % 2 == 0
            d = plane(values, table, k, OTHER if turned else CORRECTION)
            spare = plane(values, table, k, CORRECTION if turned else OTHER)
            inverse, weight = plane(values, table, k, INVERSE), plane(values, table, k, WEIGHT)
            own = _planes(values, table, k, MODEL, planes)
            add_coarse(coarse, d, spare, own, inverse, weight)
            relax(values, table, about, k, up, 0, turned)

    return cycle
