"""Compiled loops for the linear model of the paper's cliques in a volume; see also `seiler`.

Arrays are views of all rows, as in `volume_cliques`. The model is A d = d - q(d): the distance of a
site from the minimum of its local energy. The diagonal of A is 1. `inverse`, `weight` and `springs`
are documented in `seiler`. Kernels write only within the spans, so the output must already be 0
outside the spans.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from numba import float32

from napari_hmrf.solver.backends.cpu.compiled import callee, parallel, portion, shared
from napari_hmrf.solver.backends.cpu.volume_cliques import (
    BLOCK,
    curvature_of,
    energy_of,
    look,
    scratch,
    slope_of,
)

_TINY = float32(1e-30)


@shared
def _smooth_line(curvature, slope, d, load, inverse, weight, springs, pace, out):
    scale, ahead, back = pace
    for j in range(len(d)):
        rest = slope[j] / max(curvature[j], _TINY) + (load[j] - springs * weight[j] * d[j])
        step = scale * inverse[j] * rest + ahead * d[j]
        out[j] = d[j] + (step - back * out[j])


@callee
def _smooth_row(d, load, tissue, inverse, weights, span, pace, out, i):
    (stiffness, lines, offsets), (weight, springs) = tissue, weights
    f = scratch(d)
    for x in range(max(span[0], 0) + 2, span[1] + 2, BLOCK):
        end = min(x + BLOCK, span[1] + 2)
        look(d, stiffness, lines, offsets, i, x, end - x, f)
        for k in range(3):
            _smooth_line(
                curvature_of(f, k),
                slope_of(f, k),
                d[k, i, x:end],
                load[k, i, x:end],
                inverse[k, i, x:end],
                weight[k, i, x:end],
                springs,
                pace,
                out[k, i, x:end],
            )


@parallel
def smooth(
    thread, d, other, load, stiffness, lines, offsets, inverse, weight, springs, spans, paces
):
    """Run Chebyshev steps with the coefficients (scale, ahead, back) in `paces`, one in each turn.

    A step is ``other = d + scale * D^-1 (load - (A + W) d) + ahead * d - back * other``. On entry,
    `other` contains the displacement before the previous step. The two arrays swap roles after each
    step.
    """
    step = thread[2]
    source, target = (d, other) if step % 2 == 0 else (other, d)
    pace = paces[step, 0], paces[step, 1], paces[step, 2]
    tissue, weights = (stiffness, lines, offsets), (weight, springs)
    for i in portion(thread, d.shape[1] - 4):
        _smooth_row(source, load, tissue, inverse, weights, spans[i], pace, target, i + 2)


@shared
def _rest_line(curvature, slope, d, load, given, inverse, weight, springs, share, out):
    for j in range(len(d)):
        rest = slope[j] / max(curvature[j], _TINY)
        rest = share * (rest + (given * load[j] - springs * weight[j] * d[j]))
        out[j] = rest if inverse[j] > float32(0) else rest - rest


@callee
def _rest_row(d, load, given, tissue, inverse, weights, span, share, out, i):
    (stiffness, lines, offsets), (weight, springs) = tissue, weights
    f = scratch(d)
    for x in range(max(span[0], 0) + 2, span[1] + 2, BLOCK):
        end = min(x + BLOCK, span[1] + 2)
        look(d, stiffness, lines, offsets, i, x, end - x, f)
        for k in range(3):
            _rest_line(
                curvature_of(f, k),
                slope_of(f, k),
                d[k, i, x:end],
                load[k, i, x:end],
                given,
                inverse[k, i, x:end],
                weight[k, i, x:end],
                springs,
                share,
                out[k, i, x:end],
            )


@parallel
def residual(
    thread, d, load, given, stiffness, lines, offsets, inverse, weight, springs, spans, share, out
):
    """Write ``share * (given * load - (A + W) d)`` to `out`, or 0 at fixed components."""
    tissue, weights = (stiffness, lines, offsets), (weight, springs)
    for i in portion(thread, d.shape[1] - 4):
        _rest_row(d, load, given, tissue, inverse, weights, spans[i], share, out, i + 2)


@callee
def _pull_row(d, tissue, span, out, i):
    stiffness, lines, offsets = tissue
    f, total = scratch(d), 0.0
    for x in range(max(span[0], 0) + 2, span[1] + 2, BLOCK):
        end = min(x + BLOCK, span[1] + 2)
        look(d, stiffness, lines, offsets, i, x, end - x, f)
        for k in range(3):
            curvature, slope, line = curvature_of(f, k), slope_of(f, k), out[k, i, x:end]
            for j in range(len(line)):
                line[j] = slope[j] / max(curvature[j], _TINY)
        total += energy_of(f, end - x)
    return total


@parallel
def pull(thread, d, stiffness, lines, offsets, spans, out, row_totals):
    """Write -A d to `out` within the spans, and the clique energy per row to `row_totals`."""
    tissue = stiffness, lines, offsets
    for i in portion(thread, d.shape[1] - 4):
        row_totals[i] = _pull_row(d, tissue, spans[i], out, i + 2)


@callee
def _curvature_row(tissue, span, out, i):
    stiffness, lines, offsets = tissue
    f = scratch(out)
    for x in range(max(span[0], 0) + 2, span[1] + 2, BLOCK):
        end = min(x + BLOCK, span[1] + 2)
        look(out, stiffness, lines, offsets, i, x, end - x, f)  # curvature ignores displacement
        for k in range(3):
            out[k, i, x:end] = curvature_of(f, k)[: end - x]


@parallel
def curvature(thread, stiffness, lines, offsets, spans, out):
    """Compute the curvature of the cliques centred at each site within the spans."""
    tissue = stiffness, lines, offsets
    for i in portion(thread, out.shape[1] - 4):
        _curvature_row(tissue, spans[i], out, i + 2)
