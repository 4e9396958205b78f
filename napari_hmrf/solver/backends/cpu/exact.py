"""Compiled loops on displacements in double precision on the host.

Planes are float64 arrays of shape (2, H + 4, W + 4), with the component as the first axis and a
border of zeros, two sites wide.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

import numpy as np

from napari_hmrf.solver.backends.cpu.compiled import (
    disjoint_strict_parallel,
    portion,
    reduction,
    strict_parallel,
)


@strict_parallel
def prescribe(thread, y, observed, share, first, one, second, two, d, held):
    """Set `d` to ``share * y`` and `held` to True at observed components.

    All other components of `d` are set to ``one * first + two * second``. The arrays `first` and
    `second` have shape (H, W, 2) and may contain NaN if their factor is 0.
    """
    for i in portion(thread, y.shape[0]):
        for j in range(y.shape[1]):
            for k in range(2):
                here = observed[i, j, k]
                held[k, i + 2, j + 2] = here
                begun = one * first[i, j, k] if one != 0 else 0.0
                begun += two * second[i, j, k] if two != 0 else 0.0
                d[k, i + 2, j + 2] = share * y[i, j, k] if here else begun


@strict_parallel
def blend(thread, values, weight, held, d):
    """Add ``weight * values``, shape (H, W, 2), to `d` except at held components."""
    for i in portion(thread, values.shape[0]):
        for j in range(values.shape[1]):
            for k in range(2):
                if not held[k, i + 2, j + 2]:
                    d[k, i + 2, j + 2] += weight * values[i, j, k]


@reduction
def _settle_row(values, tissue, unit):
    nothing = np.float32(0)
    for j in range(len(values)):
        nothing += values[j] * np.float32(0)  # NaN if a value is not finite, else 0
    for j in range(len(tissue)):
        factor = unit * np.float32(tissue[j])
        values[2 * j] *= factor
        values[2 * j + 1] *= factor
    return nothing == 0


@strict_parallel
def settle(thread, values, tissue, unit, row_finite):
    """Multiply values by `unit` in tissue and by 0 elsewhere; flag the rows that are finite."""
    flat = values.reshape(values.shape[0], -1)
    for i in portion(thread, values.shape[0]):
        row_finite[i] = _settle_row(flat[i], tissue[i], unit)


@disjoint_strict_parallel
def add(thread, d, correction, scale):
    """Add ``scale * correction`` to `d` in place."""
    for i in portion(thread, d.shape[1]):
        for k in range(2):
            for j in range(d.shape[2]):
                d[k, i, j] += scale * correction[k, i, j]


@disjoint_strict_parallel
def gather(thread, d, out):
    """Copy planes to `out` of shape (H, W, 2), in single precision."""
    for i in portion(thread, out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j, 0] = np.float32(d[0, i + 2, j + 2])
            out[i, j, 1] = np.float32(d[1, i + 2, j + 2])
