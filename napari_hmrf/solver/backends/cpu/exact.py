"""Displacements in double precision on the host, as compiled loops: what refinement is made of.

Planes are float64, (2, H + 4, W + 4), the component first, in a ring of zeros two sites wide. A
row's share of a total is returned for each row.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np
from numba import prange

from napari_hmrf.solver.backends.cpu.compiled import reduction, strict_parallel


@strict_parallel
def prescribe(y, observed, share, first, one, second, two, d, held):
    """Displace by share * y where tissue is observed, and hold it there.

    The rest by one * first + two * second, both (H, W, 2), one or both of which may count 0 times:
    then its values need not be numbers.
    """
    for i in prange(y.shape[0]):
        for j in range(y.shape[1]):
            for k in range(2):
                here = observed[i, j, k]
                held[k, i + 2, j + 2] = here
                begun = one * first[i, j, k] if one != 0 else 0.0
                begun += two * second[i, j, k] if two != 0 else 0.0
                d[k, i + 2, j + 2] = share * y[i, j, k] if here else begun


@strict_parallel
def blend(values, weight, held, d):
    """Add weight * values, (H, W, 2), to `d` where it is not held."""
    for i in prange(values.shape[0]):
        for j in range(values.shape[1]):
            for k in range(2):
                if not held[k, i + 2, j + 2]:
                    d[k, i + 2, j + 2] += weight * values[i, j, k]


@reduction
def _settle_row(values, tissue, unit):
    nothing = np.float32(0)
    for j in range(len(values)):
        nothing += values[j] * np.float32(0)  # 0, but for what is not a number
    for j in range(len(tissue)):
        factor = unit * np.float32(tissue[j])
        values[2 * j] *= factor
        values[2 * j + 1] *= factor
    return nothing == 0


@strict_parallel
def settle(values, tissue, unit, row_finite):
    """Scale values by `unit` on tissue, 0 elsewhere; mark the rows that are all finite."""
    flat = values.reshape(values.shape[0], -1)
    for i in prange(values.shape[0]):
        row_finite[i] = _settle_row(flat[i], tissue[i], unit)


@strict_parallel
def add(d, correction, scale):
    """Add scale * correction to `d`."""
    for i in prange(d.shape[1]):
        for k in range(2):
            for j in range(d.shape[2]):
                d[k, i, j] += scale * correction[k, i, j]


@strict_parallel
def gather(d, out):
    """Copy planes to `out`, (H, W, 2) in single precision."""
    for i in prange(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j, 0] = np.float32(d[0, i + 2, j + 2])
            out[i, j, 1] = np.float32(d[1, i + 2, j + 2])
