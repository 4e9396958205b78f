"""Kernels of the paper's schedule as compiled loops.

Every array has a border of void, two sites wide, so loops need no test for the border of the image:
a clique that extends beyond the image contains void and does not exist. Components are separate
planes, (C, H + 4, W + 4). Updates are computed from differences between displacements, never
from an assembled stencil, because cancellation in its float32 sums would cause errors of whole
pixels in large images.

The loops over a row vectorize for three reasons: they have no branches, they count from zero (numba
wraps indices that may be negative), and the compiler may assume that arrays do not overlap
(`disjoint_parallel`). After a change, check that the generated code still contains many
``<16 x float>`` or ``<8 x float>``.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return"
from __future__ import annotations

from typing import Any

from numba import float32

from napari_hmrf.solver.backends.cpu.compiled import (
    disjoint_parallel,
    inline,
    portion,
    reduction,
    shared,
)

# Displacements below this value, in pixels, are set to 0: denormal numbers are many times slower.
_FLUSH = float32(1e-18)
_TINY = float32(1e-30)


@inline
def ratios(stiffness, si, sj, ti, tj, ui, uj):
    """Return m_t/m_s, m_t/m_u, and 1 if the clique exists or 0 if it does not."""
    inverse_s = stiffness[1, si, sj]
    inverse_u = stiffness[1, ui, uj]
    m = stiffness[0, ti, tj]
    exists = float32(1) if inverse_s * m * inverse_u > float32(0) else float32(0)
    return m * inverse_s, m * inverse_u, exists


@inline
def middle_curvature(ratio_s, ratio_u):
    """Return the curvature of a clique's potential with respect to its middle site."""
    steep_s = float32(1) + ratio_s
    steep_u = float32(1) + ratio_u
    return steep_s * steep_s + steep_u * steep_u


@inline
def _middle(d, component, ratio_s, ratio_u, si, sj, ti, tj, ui, uj):
    """Return the slope at the middle site t, and the energy, of one component of a clique."""
    to_s = d[component, si, sj] - d[component, ti, tj]
    to_u = d[component, ui, uj] - d[component, ti, tj]
    first = ratio_u * to_s + to_u
    second = ratio_s * to_u + to_s
    slope = (float32(1) + ratio_u) * first + (float32(1) + ratio_s) * second
    return slope, first * first + second * second


@inline
def _end(d, component, ratio_s, ratio_u, si, sj, ti, tj, ui, uj):
    """Return the slope of one component of a clique at its end site s."""
    to_s = d[component, si, sj] - d[component, ti, tj]
    to_u = d[component, ui, uj] - d[component, ti, tj]
    return -(ratio_u * (ratio_u * to_s + to_u) + (ratio_s * to_u + to_s))


@shared
def square(d, stiffness, i, j):
    """Return curvature, slope and energy of the cliques centred at (i + 2, j + 2).

    This function is for square pixels, for which the vertical line contributes only to the row
    component and the horizontal line only to the column component. Curvature and slope are returned
    per component.
    """
    si, sj, ui, uj = i + 1, j + 2, i + 3, j + 2
    s, u, exists = ratios(stiffness, si, sj, i + 2, j + 2, ui, uj)
    b, e = _middle(d, 0, s, u, si, sj, i + 2, j + 2, ui, uj)
    a0, b0, energy = exists * middle_curvature(s, u), exists * b, exists * e
    si, sj, ui, uj = i + 2, j + 1, i + 2, j + 3
    s, u, exists = ratios(stiffness, si, sj, i + 2, j + 2, ui, uj)
    b, e = _middle(d, 1, s, u, si, sj, i + 2, j + 2, ui, uj)
    a1, b1, energy = exists * middle_curvature(s, u), exists * b, energy + exists * e
    si, sj, ui, uj = i + 1, j + 1, i + 3, j + 3
    s, u, exists = ratios(stiffness, si, sj, i + 2, j + 2, ui, uj)
    a = exists * middle_curvature(s, u)
    a0, a1 = a0 + a, a1 + a
    b, e = _middle(d, 0, s, u, si, sj, i + 2, j + 2, ui, uj)
    b0, energy = b0 + exists * b, energy + exists * e
    b, e = _middle(d, 1, s, u, si, sj, i + 2, j + 2, ui, uj)
    b1, energy = b1 + exists * b, energy + exists * e
    si, sj, ui, uj = i + 1, j + 3, i + 3, j + 1
    s, u, exists = ratios(stiffness, si, sj, i + 2, j + 2, ui, uj)
    a = exists * middle_curvature(s, u)
    a0, a1 = a0 + a, a1 + a
    b, e = _middle(d, 0, s, u, si, sj, i + 2, j + 2, ui, uj)
    b0, energy = b0 + exists * b, energy + exists * e
    b, e = _middle(d, 1, s, u, si, sj, i + 2, j + 2, ui, uj)
    b1, energy = b1 + exists * b, energy + exists * e
    return a0, a1, b0, b1, energy


@shared
def _middle_line(d, stiffness, weight_0, weight_1, si, sj, ti, tj, ui, uj):
    """Return a clique's curvature and slope per component at its middle site, and its energy."""
    s, u, exists = ratios(stiffness, si, sj, ti, tj, ui, uj)
    w0, w1 = exists * weight_0, exists * weight_1
    a = middle_curvature(s, u)
    b0, e0 = _middle(d, 0, s, u, si, sj, ti, tj, ui, uj)
    b1, e1 = _middle(d, 1, s, u, si, sj, ti, tj, ui, uj)
    return w0 * a, w1 * a, w0 * b0, w1 * b1, w0 * e0 + w1 * e1


@shared
def weighted(d, stiffness, weights, i, j):
    """Return the same quantities as `square`, for pixels of any shape."""
    w = weights
    a0, a1, b0, b1, e = _middle_line(
        d, stiffness, w[0, 0], w[0, 1], i + 1, j + 2, i + 2, j + 2, i + 3, j + 2
    )
    p0, p1, q0, q1, r = _middle_line(
        d, stiffness, w[1, 0], w[1, 1], i + 2, j + 1, i + 2, j + 2, i + 2, j + 3
    )
    a0, a1, b0, b1, e = a0 + p0, a1 + p1, b0 + q0, b1 + q1, e + r
    p0, p1, q0, q1, r = _middle_line(
        d, stiffness, w[2, 0], w[2, 1], i + 1, j + 1, i + 2, j + 2, i + 3, j + 3
    )
    a0, a1, b0, b1, e = a0 + p0, a1 + p1, b0 + q0, b1 + q1, e + r
    p0, p1, q0, q1, r = _middle_line(
        d, stiffness, w[3, 0], w[3, 1], i + 1, j + 3, i + 2, j + 2, i + 3, j + 1
    )
    return a0 + p0, a1 + p1, b0 + q0, b1 + q1, e + r


@inline
def _end_line(d, stiffness, weight_0, weight_1, i, j, ti, tj, ui, uj):
    """Return a clique's curvature and slope per component at its end site (i, j)."""
    s, u, exists = ratios(stiffness, i, j, ti, tj, ui, uj)
    w0, w1 = exists * weight_0, exists * weight_1
    a = u * u + float32(1)
    b0 = _end(d, 0, s, u, i, j, ti, tj, ui, uj)
    b1 = _end(d, 1, s, u, i, j, ti, tj, ui, uj)
    return w0 * a, w1 * a, w0 * b0, w1 * b1


@shared
def _both_ends(d, stiffness, weight_0, weight_1, i, j, ti, tj, ui, uj, vi, vj, xi, xj):
    """Return the summed curvature and slope at (i, j) of cliques (i, j)-t-u and (i, j)-v-x."""
    a0, a1, b0, b1 = _end_line(d, stiffness, weight_0, weight_1, i, j, ti, tj, ui, uj)
    p0, p1, q0, q1 = _end_line(d, stiffness, weight_0, weight_1, i, j, vi, vj, xi, xj)
    return a0 + p0, a1 + p1, b0 + q0, b1 + q1


@shared
def around(d, stiffness, weights, i, j):
    """Return the result of `weighted`, plus the eight cliques that end at (i + 2, j + 2)."""
    w, ti, tj = weights, i + 2, j + 2
    a0, a1, b0, b1, e = weighted(d, stiffness, w, i, j)
    p0, p1, q0, q1 = _both_ends(
        d, stiffness, w[0, 0], w[0, 1], ti, tj, i + 1, tj, i, tj, i + 3, tj, i + 4, tj
    )
    a0, a1, b0, b1 = a0 + p0, a1 + p1, b0 + q0, b1 + q1
    p0, p1, q0, q1 = _both_ends(
        d, stiffness, w[1, 0], w[1, 1], ti, tj, ti, j + 1, ti, j, ti, j + 3, ti, j + 4
    )
    a0, a1, b0, b1 = a0 + p0, a1 + p1, b0 + q0, b1 + q1
    p0, p1, q0, q1 = _both_ends(
        d, stiffness, w[2, 0], w[2, 1], ti, tj, i + 1, j + 1, i, j, i + 3, j + 3, i + 4, j + 4
    )
    a0, a1, b0, b1 = a0 + p0, a1 + p1, b0 + q0, b1 + q1
    p0, p1, q0, q1 = _both_ends(
        d, stiffness, w[3, 0], w[3, 1], ti, tj, i + 1, j + 3, i, j + 4, i + 3, j + 1, i + 4, j
    )
    return a0 + p0, a1 + p1, b0 + q0, b1 + q1, e


@inline
def _observed(d, observation, i, j):
    """Return the observation energy of a site (eqs. 17 and 18)."""
    return observation[2, i, j] * abs(observation[0, i, j] - d[0, i, j]) + observation[
        3, i, j
    ] * abs(observation[1, i, j] - d[1, i, j])


@inline
def downhill(slope, penalty, off):
    """Return the only direction, 1 or -1, in which a component's energy may decrease."""
    # `off` is y - d. The energy is convex, so it increases in the opposite direction.
    pull = penalty if off > float32(0) else (-penalty if off < float32(0) else float32(0))
    return float32(-1) if float32(2) * slope + pull < float32(0) else float32(1)


@inline
def change(step, curvature, twice_slope, penalty, off, now):
    """Return the change in a component's energy for a downhill step, or 0 if it would increase."""
    # `now` is p |y - d|. The signs of the slope and of `off` refer to the direction of the step.
    prior = step * (curvature * step - twice_slope)
    return min(prior + (penalty * abs(off - step) - now), float32(0))


@shared
def _best_candidate(d, a0, a1, b0, b1, observation, steps, i, j):
    """Return the displacement of a site after the best move in the candidate set."""
    p0, p1 = observation[2, i, j], observation[3, i, j]
    off0 = observation[0, i, j] - d[0, i, j]
    off1 = observation[1, i, j] - d[1, i, j]
    now0 = p0 * abs(off0)
    now1 = p1 * abs(off1)
    sign0 = downhill(b0, p0, off0)
    sign1 = downhill(b1, p1, off1)
    twice0 = float32(2) * sign0 * b0
    twice1 = float32(2) * sign1 * b1
    least = float32(0)
    best0 = float32(0)
    best1 = float32(0)
    for k in range(len(steps)):
        change0 = change(steps[k], a0, twice0, p0, sign0 * off0, now0)
        change1 = change(steps[k], a1, twice1, p1, sign1 * off1, now1)
        better = change0 + change1 < least
        least = min(change0 + change1, least)
        best0 = (steps[k] if change0 < float32(0) else float32(0)) if better else best0
        best1 = (steps[k] if change1 < float32(0) else float32(0)) if better else best1
    return d[0, i, j] + sign0 * best0, d[1, i, j] + sign1 * best1


@inline
def minimiser(d, curvature, slope, penalty, y, relaxation):
    """Return the displacement that minimizes a component's energy: y + soft(q - y, p / 2A)."""
    share = relaxation / max(curvature, _TINY)
    distance = (d + share * slope) - y
    reach = float32(0.5) * share * penalty
    return y + (distance - min(max(distance, -reach), reach))


@inline
def _moved(d, a0, a1, b0, b1, observation, steps, relaxation, i, j):
    """Return the new displacement of a site, from its curvature, slope and observation."""
    if steps is None:
        new0 = minimiser(d[0, i, j], a0, b0, observation[2, i, j], observation[0, i, j], relaxation)
        new1 = minimiser(d[1, i, j], a1, b1, observation[3, i, j], observation[1, i, j], relaxation)
    else:
        new0, new1 = _best_candidate(
            d, a0 / relaxation, a1 / relaxation, b0, b1, observation, steps, i, j
        )
    return (
        float32(0) if abs(new0) <= _FLUSH else new0,
        float32(0) if abs(new1) <= _FLUSH else new1,
    )


@reduction
def _row_total(values: Any, row: int, start: int, stop: int) -> float:
    total = float32(0)
    for j in range(start, stop):
        total += values[row, j]
    return total


@disjoint_parallel
def sweeps(
    thread,
    even,
    odd,
    stiffness,
    observation,
    spans,
    weights,
    blanket,
    steps,
    relaxation,
    share,
    row_totals,
):
    """Update all sites simultaneously, in one turn for each row of `row_totals`.

    The first sweep reads `even` and writes `odd`, the second does the reverse, and so on. `spans`
    contains the start and stop column of the tissue in each row. `weights` is None for square
    pixels. If `blanket` is None, the energy of a site includes only the cliques centred at it;
    otherwise, it includes all cliques that contain the site, which requires `weights`. `steps` is
    None for the closed form. Numba compiles a special version for each combination of these
    options. On return, `row_totals` contains U_total before each sweep, per row; `share` is scratch
    memory.
    """
    sweep = thread[2]
    source, target = (even, odd) if sweep % 2 == 0 else (odd, even)
    for i in portion(thread, source.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            j = start + k
            if blanket is not None:
                a0, a1, b0, b1, prior = around(source, stiffness, weights, i, j)
            elif weights is None:
                a0, a1, b0, b1, prior = square(source, stiffness, i, j)
            else:
                a0, a1, b0, b1, prior = weighted(source, stiffness, weights, i, j)
            share[i, j] = prior + _observed(source, observation, i + 2, j + 2)
            new0, new1 = _moved(
                source, a0, a1, b0, b1, observation, steps, relaxation, i + 2, j + 2
            )
            target[0, i + 2, j + 2] = new0
            target[1, i + 2, j + 2] = new1
        row_totals[sweep, i] = _row_total(share, i, start, spans[i, 1])


@disjoint_parallel
def energy(thread, source, stiffness, spans, weights, share, row_totals):
    """Compute the energy of the cliques in each row; square pixels also require `weights`."""
    for i in portion(thread, source.shape[1] - 4):
        start = max(spans[i, 0], 0)
        for k in range(spans[i, 1] - start):
            _, _, _, _, share[i, start + k] = weighted(source, stiffness, weights, i, start + k)
        row_totals[i] = _row_total(share, i, start, spans[i, 1])
