"""The kernels as compiled loops.

Every array is padded by a ring of void two sites wide, so that no loop asks whether it is at the
border: a clique that reaches out of the image touches void and does not exist. Components are
separate planes, (C, H + 4, W + 4). What moves a site is built from differences of displacement,
never from an assembled stencil: float32 cancellation would cost whole pixels in large images.

The loops over a row vectorise because they branch nowhere, count from zero (an index that might be
negative would be wrapped around, Python's way) and live inside the parallel loop (where the
compiler knows that the arrays do not overlap). Check that when you change them: the generated code
must be full of ``<16 x float>`` or ``<8 x float>``.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return"
from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import float32, prange

#: Width of the ring of void around every array.
PAD = 2

# Below this a displacement is rounded to 0: arithmetic on denormal numbers is many times slower.
_FLUSH = float32(1e-18)
_TINY = float32(1e-30)

_inline = numba.njit(inline="always", error_model="numpy")
_parallel = numba.njit(cache=True, nogil=True, error_model="numpy", parallel=True)
_reduction = numba.njit(cache=True, nogil=True, fastmath={"reassoc", "nsz"})


@_inline
def _middle(d, stiffness, si, sj, ti, tj, ui, uj, w0, w1):
    """One clique s - t - u as seen from its middle: curvature, slope (per component), energy."""
    inverse_s = stiffness[1, si, sj]
    inverse_u = stiffness[1, ui, uj]
    m = stiffness[0, ti, tj]
    exists = float32(1) if inverse_s * m * inverse_u > float32(0) else float32(0)
    ratio_s = m * inverse_s
    ratio_u = m * inverse_u
    steep_s = float32(1) + ratio_s
    steep_u = float32(1) + ratio_u
    d0 = d[0, ti, tj]
    d1 = d[1, ti, tj]
    s0 = d[0, si, sj] - d0
    s1 = d[1, si, sj] - d1
    u0 = d[0, ui, uj] - d0
    u1 = d[1, ui, uj] - d1
    first0 = ratio_u * s0 + u0
    first1 = ratio_u * s1 + u1
    second0 = ratio_s * u0 + s0
    second1 = ratio_s * u1 + s1
    curvature = steep_u * steep_u + steep_s * steep_s
    w0 = w0 * exists
    w1 = w1 * exists
    return (
        w0 * curvature,
        w1 * curvature,
        w0 * (steep_u * first0 + steep_s * second0),
        w1 * (steep_u * first1 + steep_s * second1),
        w0 * (first0 * first0 + second0 * second0) + w1 * (first1 * first1 + second1 * second1),
    )


@_inline
def _end(d, stiffness, si, sj, ti, tj, ui, uj, w0, w1):
    """One clique s - t - u as seen from its end s: curvature and slope, per component."""
    inverse_s = stiffness[1, si, sj]
    inverse_u = stiffness[1, ui, uj]
    m = stiffness[0, ti, tj]
    exists = float32(1) if inverse_s * m * inverse_u > float32(0) else float32(0)
    ratio_s = m * inverse_s
    ratio_u = m * inverse_u
    t0 = d[0, ti, tj]
    t1 = d[1, ti, tj]
    s0 = d[0, si, sj] - t0
    s1 = d[1, si, sj] - t1
    u0 = d[0, ui, uj] - t0
    u1 = d[1, ui, uj] - t1
    curvature = ratio_u * ratio_u + float32(1)
    w0 = w0 * exists
    w1 = w1 * exists
    return (
        w0 * curvature,
        w1 * curvature,
        -w0 * (ratio_u * (ratio_u * s0 + u0) + (ratio_s * u0 + s0)),
        -w1 * (ratio_u * (ratio_u * s1 + u1) + (ratio_s * u1 + s1)),
    )


@_inline
def _centred(d, stiffness, weights, i, j):
    """Curvature, slope and energy of the four cliques that (i + 2, j + 2) is the middle of."""
    a0, a1, b0, b1, e = _middle(
        d, stiffness, i + 1, j + 2, i + 2, j + 2, i + 3, j + 2, weights[0, 0], weights[0, 1]
    )
    p0, p1, q0, q1, r = _middle(
        d, stiffness, i + 2, j + 1, i + 2, j + 2, i + 2, j + 3, weights[1, 0], weights[1, 1]
    )
    a0, a1, b0, b1, e = a0 + p0, a1 + p1, b0 + q0, b1 + q1, e + r
    p0, p1, q0, q1, r = _middle(
        d, stiffness, i + 1, j + 1, i + 2, j + 2, i + 3, j + 3, weights[2, 0], weights[2, 1]
    )
    a0, a1, b0, b1, e = a0 + p0, a1 + p1, b0 + q0, b1 + q1, e + r
    p0, p1, q0, q1, r = _middle(
        d, stiffness, i + 1, j + 3, i + 2, j + 2, i + 3, j + 1, weights[3, 0], weights[3, 1]
    )
    return a0 + p0, a1 + p1, b0 + q0, b1 + q1, e + r


@_inline
def _ends(d, stiffness, i, j, ti, tj, ui, uj, vi, vj, xi, xj, w0, w1):
    """The two cliques of one line that (i, j) is an end of: i - t - u and i - v - x."""
    a0, a1, b0, b1 = _end(d, stiffness, i, j, ti, tj, ui, uj, w0, w1)
    p0, p1, q0, q1 = _end(d, stiffness, i, j, vi, vj, xi, xj, w0, w1)
    return a0 + p0, a1 + p1, b0 + q0, b1 + q1


@_inline
def _blanket(d, stiffness, weights, i, j):
    """As `_centred`, with the eight cliques that (i + 2, j + 2) is an end of as well."""
    a0, a1, b0, b1, e = _centred(d, stiffness, weights, i, j)
    w0, w1 = weights[0, 0], weights[0, 1]
    p0, p1, q0, q1 = _ends(
        d, stiffness, i + 2, j + 2, i + 1, j + 2, i, j + 2, i + 3, j + 2, i + 4, j + 2, w0, w1
    )
    a0, a1, b0, b1 = a0 + p0, a1 + p1, b0 + q0, b1 + q1
    w0, w1 = weights[1, 0], weights[1, 1]
    p0, p1, q0, q1 = _ends(
        d, stiffness, i + 2, j + 2, i + 2, j + 1, i + 2, j, i + 2, j + 3, i + 2, j + 4, w0, w1
    )
    a0, a1, b0, b1 = a0 + p0, a1 + p1, b0 + q0, b1 + q1
    w0, w1 = weights[2, 0], weights[2, 1]
    p0, p1, q0, q1 = _ends(
        d, stiffness, i + 2, j + 2, i + 1, j + 1, i, j, i + 3, j + 3, i + 4, j + 4, w0, w1
    )
    a0, a1, b0, b1 = a0 + p0, a1 + p1, b0 + q0, b1 + q1
    w0, w1 = weights[3, 0], weights[3, 1]
    p0, p1, q0, q1 = _ends(
        d, stiffness, i + 2, j + 2, i + 1, j + 3, i, j + 4, i + 3, j + 1, i + 4, j, w0, w1
    )
    return a0 + p0, a1 + p1, b0 + q0, b1 + q1, e


@_inline
def _observed(d0, d1, observation, i, j):
    """The observation energy of a site (eqs. 17 and 18)."""
    return observation[2, i, j] * abs(observation[0, i, j] - d0) + observation[3, i, j] * abs(
        observation[1, i, j] - d1
    )


@_inline
def _best_move(step, curvature, way, penalty, off):
    """The best of {0, step, -step} for one component: the move, and the energy it changes (<= 0).

    `way` is q - d and `off` is y - d.
    """
    now = penalty * abs(off)
    up = curvature * step * (step - float32(2) * way) + (penalty * abs(off - step) - now)
    down = curvature * step * (step + float32(2) * way) + (penalty * abs(off + step) - now)
    change = min(min(up, down), float32(0))
    move = step if up <= down else -step
    return (move if change < float32(0) else float32(0)), change


@_inline
def _minimiser(d, curvature, way, penalty, y):
    """The displacement of least local energy for one component: y + soft(q - y, p / 2A)."""
    distance = (d + way) - y
    reach = penalty / (float32(2) * max(curvature, _TINY))
    return y + (distance - min(max(distance, -reach), reach))


@_inline
def _settled(value):
    """The value, or 0 where it is too small to matter."""
    return value if abs(value) > _FLUSH else float32(0)


@_inline
def _best_candidate(d0, d1, a0, a1, way0, way1, observation, steps, i, j):
    """A site's displacement after the best move of the candidate set."""
    off0 = observation[0, i, j] - d0
    off1 = observation[1, i, j] - d1
    least = float32(0)
    best0 = float32(0)
    best1 = float32(0)
    for k in range(len(steps)):
        move0, change0 = _best_move(steps[k], a0, way0, observation[2, i, j], off0)
        move1, change1 = _best_move(steps[k], a1, way1, observation[3, i, j], off1)
        better = change0 + change1 < least
        least = change0 + change1 if better else least
        best0 = move0 if better else best0
        best1 = move1 if better else best1
    return d0 + best0, d1 + best1


@_reduction
def _row_total(values: Any, row: int) -> float:
    total = float32(0)
    for j in range(values.shape[1]):
        total += values[row, j]
    return total


@_parallel
def icm_centred(
    source, target, stiffness, observation, weights, steps, relaxation, share, row_totals
):
    """Move all sites once, each judging the cliques it is the middle of.

    `row_totals` gets U_total of `source`, row by row; `share` is scratch.
    """
    for i in prange(source.shape[1] - 4):
        for j in range(source.shape[2] - 4):
            d0, d1 = source[0, i + 2, j + 2], source[1, i + 2, j + 2]
            a0, a1, b0, b1, energy = _centred(source, stiffness, weights, i, j)
            share[i, j] = energy + _observed(d0, d1, observation, i + 2, j + 2)
            way0 = relaxation * (b0 / max(a0, _TINY))
            way1 = relaxation * (b1 / max(a1, _TINY))
            a0 = a0 / relaxation
            a1 = a1 / relaxation
            if steps is None:
                new0 = _minimiser(
                    d0, a0, way0, observation[2, i + 2, j + 2], observation[0, i + 2, j + 2]
                )
                new1 = _minimiser(
                    d1, a1, way1, observation[3, i + 2, j + 2], observation[1, i + 2, j + 2]
                )
            else:
                new0, new1 = _best_candidate(
                    d0, d1, a0, a1, way0, way1, observation, steps, i + 2, j + 2
                )
            target[0, i + 2, j + 2] = _settled(new0)
            target[1, i + 2, j + 2] = _settled(new1)
        row_totals[i] = _row_total(share, i)


@_parallel
def icm_blanket(
    source, target, stiffness, observation, weights, steps, relaxation, share, row_totals
):
    """Move all sites once, each judging every clique that contains it."""
    for i in prange(source.shape[1] - 4):
        for j in range(source.shape[2] - 4):
            d0, d1 = source[0, i + 2, j + 2], source[1, i + 2, j + 2]
            a0, a1, b0, b1, energy = _blanket(source, stiffness, weights, i, j)
            share[i, j] = energy + _observed(d0, d1, observation, i + 2, j + 2)
            way0 = relaxation * (b0 / max(a0, _TINY))
            way1 = relaxation * (b1 / max(a1, _TINY))
            a0 = a0 / relaxation
            a1 = a1 / relaxation
            if steps is None:
                new0 = _minimiser(
                    d0, a0, way0, observation[2, i + 2, j + 2], observation[0, i + 2, j + 2]
                )
                new1 = _minimiser(
                    d1, a1, way1, observation[3, i + 2, j + 2], observation[1, i + 2, j + 2]
                )
            else:
                new0, new1 = _best_candidate(
                    d0, d1, a0, a1, way0, way1, observation, steps, i + 2, j + 2
                )
            target[0, i + 2, j + 2] = _settled(new0)
            target[1, i + 2, j + 2] = _settled(new1)
        row_totals[i] = _row_total(share, i)


@_parallel
def energy(source, stiffness, observation, weights, share, row_totals):
    """U_total of `source`, row by row; `share` is scratch."""
    for i in prange(source.shape[1] - 4):
        for j in range(source.shape[2] - 4):
            _, _, _, _, prior = _centred(source, stiffness, weights, i, j)
            share[i, j] = prior + _observed(
                source[0, i + 2, j + 2], source[1, i + 2, j + 2], observation, i + 2, j + 2
            )
        row_totals[i] = _row_total(share, i)


@_parallel
def prolong(coarse, coarse_stiffness, target, stiffness):
    """Displacement one level down: linear, void without weight, the border repeated."""
    height, width = target.shape[1] - 2 * PAD, target.shape[2] - 2 * PAD
    coarse_height, coarse_width = coarse.shape[1] - 2 * PAD, coarse.shape[2] - 2 * PAD
    for i in prange(height):
        near_i = min(i // 2, coarse_height - 1)
        far_i = min(max(near_i + (1 if i % 2 else -1), 0), coarse_height - 1)
        for j in range(width):
            if stiffness[0, i + PAD, j + PAD] <= float32(0):
                continue
            near_j = min(j // 2, coarse_width - 1)
            far_j = min(max(near_j + (1 if j % 2 else -1), 0), coarse_width - 1)
            total = float32(0)
            sum0 = float32(0)
            sum1 = float32(0)
            for k in range(4):
                a = (near_i if k < 2 else far_i) + PAD
                b = (near_j if k % 2 == 0 else far_j) + PAD
                weight = (float32(0.75) if k < 2 else float32(0.25)) * (
                    float32(0.75) if k % 2 == 0 else float32(0.25)
                )
                if coarse_stiffness[0, a, b] > float32(0):
                    total += weight
                    sum0 += weight * coarse[0, a, b]
                    sum1 += weight * coarse[1, a, b]
            if total > float32(0):
                target[0, i + PAD, j + PAD] = sum0 / total
                target[1, i + PAD, j + PAD] = sum1 / total


def padded(components: int, shape: tuple[int, ...]) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Zeros for `components` planes of a grid, with the ring of void around them."""
    return np.zeros((components, *(size + 2 * PAD for size in shape)), dtype=np.float32)
