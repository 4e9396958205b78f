"""Endings of sweeps in images and volumes: the loops that use the forces A d of a line of sites.

A sweep computes the forces, in a way that depends on the number of axes and on the law of the
elements. All arguments of an ending are lines with one value per site, of one component.
"""

# mypy: disable-error-code="no-untyped-def, untyped-decorator"
from __future__ import annotations

from numba import float32

from napari_hmrf.solver.backends.cpu.compiled import disjoint


@disjoint
def smooth_line(force, d, load, inverse, weight, springs, out, pace):
    """Compute a Chebyshev step; see `elastic.smooth`."""
    scale, ahead, back = pace
    for x in range(len(d)):
        rest = load[x] - (force[x] + springs * weight[x] * d[x])
        step = scale * inverse[x] * rest + ahead * d[x]
        out[x] = d[x] + (step - back * out[x])


@disjoint
def residual_line(force, d, load, given, inverse, weight, springs, scale, out):
    """Compute ``scale * (given * load - (A + W) d)``, or 0 at fixed components."""
    for x in range(len(d)):
        rest = given * load[x] - (force[x] + springs * weight[x] * d[x])
        rest = out.dtype.type(scale * rest)
        out[x] = rest if inverse[x] > float32(0) else rest - rest
