"""Whole visits of the V-cycle to a small level, by one thread: waking the others costs more.

The loops are those of `elastic` and `vectors`, compiled once more without threads.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numba

from napari_hmrf.backends.cpu import elastic, vectors

_alone = numba.njit(error_model="numpy", fastmath={"contract", "nsz"})
_visit = numba.njit(cache=True, nogil=True, error_model="numpy")

_start = _alone(vectors.start.py_func)
_restrict = _alone(vectors.restrict.py_func)
_interpolate = _alone(vectors.interpolate.py_func)
_smooth = _alone(elastic.smooth.py_func)
_residual = _alone(elastic.residual.py_func)


@_visit
def descend(steps, load, lame, inverse, weight, shape, spans, even, odd, rest, coarse_load):
    """Relax from zero in `even` and `odd`, and hand what is left to `coarse_load`, if not None.

    A row of `steps` has the scale of a step, and how far ahead and back it goes.
    """
    _start(load, inverse, even, steps[0, 0])
    for k in range(1, len(steps)):
        d, out = (even, odd) if k % 2 == 1 else (odd, even)
        scale, ahead, back = steps[k, 0], steps[k, 1], steps[k, 2]
        _smooth(d, load, lame, inverse, weight, shape, spans, out, scale, ahead, back)
    if coarse_load is not None:
        last = even if len(steps) % 2 == 1 else odd
        _residual(last, load, lame, inverse, weight, shape, spans, rest)
        _restrict(rest, coarse_load)


@_visit
def ascend(steps, coarse, load, lame, inverse, weight, shape, spans, even, odd):
    """Add the coarse correction to `even` and relax, in `even` and `odd`."""
    _interpolate(coarse, even, inverse)
    for k in range(len(steps)):
        d, out = (even, odd) if k % 2 == 0 else (odd, even)
        scale, ahead, back = steps[k, 0], steps[k, 1], steps[k, 2]
        _smooth(d, load, lame, inverse, weight, shape, spans, out, scale, ahead, back)
