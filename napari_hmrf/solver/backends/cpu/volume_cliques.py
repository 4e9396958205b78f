"""Compiled loops for the paper's cliques in a volume, in both precisions.

All arrays have a border of void, two sites wide on every side. A volume is represented as a view of
all its rows (`layout.rows`), shape (C, R, W + 4), in which a row and the same row of the next plane
are H + 4 rows apart. The direction of a line of cliques is given as an offset in rows and in sites:
`offsets`, shape (13, 2). `lines` contains the weight of each line for each component. Border rows
have empty spans.

Sites are computed in blocks. Each step is one loop along a block. The loop vectorizes as in
`hexahedra`, because the distance between scratch lines is constant.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import float32

from napari_hmrf.solver.backends.cpu.compiled import (
    callee,
    inline,
    parallel,
    portion,
    reduction,
    shared,
)
from napari_hmrf.solver.backends.cpu.kernels import change, downhill, middle_curvature, minimiser
from napari_hmrf.solver.priors import line_steps

#: Number of sites per block. Scratch lines are longer than a block, which makes the loops faster.
BLOCK = 128
_LINE = BLOCK + 16
# Indices of the scratch lines. The first three lines contain ratios. Curvature and slope have one
# line per component. These lines are followed by the energy, the change in energy for a step and
# for the best step, and the best step. The last constant is the number of lines.
_CURVATURE, _SLOPE, _ENERGY, _CHANGE, _LEAST, _BEST, _LINES = 3, 6, 9, 10, 11, 12, 13
# Displacements below this value, in pixels, are set to 0, as in `kernels`.
_FLUSH = float32(1e-18)


@lru_cache(maxsize=16)
def offsets(grid: tuple[int, ...]) -> npt.NDArray[np.int64]:
    """Return the offset (rows, sites) to the next site on each line, for a (D, H, W) grid."""
    plane, row, col = np.array(line_steps(3), dtype=np.int64).T
    return np.stack([plane * (grid[1] + 4) + row, col], axis=1)


@inline
def scratch(d):
    """Return scratch memory for one row of blocks."""
    return np.empty(_LINES * _LINE, dtype=d.dtype)


@inline
def _line(f, number):
    """Return the scratch line with the given index."""
    return f[number * _LINE : (number + 1) * _LINE]


@inline
def curvature_of(f, k):
    """Return the curvature of component k at the sites of the block."""
    return f[(_CURVATURE + k) * _LINE : (_CURVATURE + k + 1) * _LINE]


@inline
def slope_of(f, k):
    """Return the slope of component k at the sites of the block."""
    return f[(_SLOPE + k) * _LINE : (_SLOPE + k + 1) * _LINE]


@shared
def _ratios(stiffness, row, x, down, right, count, f):
    """Compute m_t/m_s, m_t/m_u, and 1 or 0 for an existing or missing clique, for one line."""
    s, u, exists = _line(f, 0), _line(f, 1), _line(f, 2)
    before = stiffness[1, row - down, x - right : x - right + count]
    here = stiffness[0, row, x : x + count]
    after = stiffness[1, row + down, x + right : x + right + count]
    one, none = f.dtype.type(1), f.dtype.type(0)
    for j in range(count):
        s[j] = here[j] * before[j]
        u[j] = here[j] * after[j]
        exists[j] = one if before[j] * here[j] * after[j] > none else none


@shared
def _add(d, k, weight, row, x, down, right, count, f):
    """Add the curvature, slope and energy of component k for the cliques of one line."""
    s, u, exists, energy = _line(f, 0), _line(f, 1), _line(f, 2), _line(f, _ENERGY)
    curvature, slope = curvature_of(f, k), slope_of(f, k)
    before = d[k, row - down, x - right : x - right + count]
    here = d[k, row, x : x + count]
    after = d[k, row + down, x + right : x + right + count]
    one = f.dtype.type(1)
    for j in range(count):
        to_s, to_u = before[j] - here[j], after[j] - here[j]
        first, second = u[j] * to_s + to_u, s[j] * to_u + to_s
        counts = weight * exists[j]
        curvature[j] += counts * middle_curvature(s[j], u[j])
        slope[j] += counts * ((one + u[j]) * first + (one + s[j]) * second)
        energy[j] += counts * (first * first + second * second)


@callee
def look(d, stiffness, lines, offsets, row, x, count, f):
    """Compute curvature, slope and energy of the cliques centred at the sites of a block.

    Parameters
    ----------
    d : ndarray, shape (3, R, W + 4)
        Displacement.
    stiffness : ndarray, shape (2, R, W + 4)
        Stiffness and its reciprocal, (m, 1/m); 0 in void.
    lines : ndarray, shape (13, 3)
        Weight of each line for each component.
    offsets : ndarray, shape (13, 2)
        Result of `offsets`.
    row, x, count : int
        Row, first site and number of sites of the block, in the padded arrays.
    f : ndarray
        Scratch memory that contains the result; see `curvature_of` and `slope_of`.
    """
    if len(f) < _LINES * _LINE:
        return  # never reached, but it lets the compiler assume that all lines exist
    f[_CURVATURE * _LINE : (_ENERGY + 1) * _LINE] = 0
    for line in range(len(lines)):
        down, right = offsets[line, 0], offsets[line, 1]
        _ratios(stiffness, row, x, down, right, count, f)
        if lines[line, 0] > 0:
            _add(d, 0, lines[line, 0], row, x, down, right, count, f)
        if lines[line, 1] > 0:
            _add(d, 1, lines[line, 1], row, x, down, right, count, f)
        if lines[line, 2] > 0:
            _add(d, 2, lines[line, 2], row, x, down, right, count, f)


@reduction
def energy_of(f: Any, count: int) -> float:
    """Return the total energy of the sites of the block."""
    total, energy = f.dtype.type(0), f[_ENERGY * _LINE : (_ENERGY + 1) * _LINE]
    for j in range(count):
        total += energy[j]
    return total


@shared
def _observe(d, y, p, count, f):
    """Add the observation energy of one component."""
    energy = _line(f, _ENERGY)
    for j in range(count):
        energy[j] += p[j] * abs(y[j] - d[j])


@shared
def _try(d, y, p, k, step, relaxation, count, f):
    """Add the change in energy for a downhill step of component k, or 0 if it would increase."""
    curvature, slope, lost = curvature_of(f, k), slope_of(f, k), _line(f, _CHANGE)
    for j in range(count):
        off = y[j] - d[j]
        sign = downhill(slope[j], p[j], off)
        twice = float32(2) * sign * slope[j]
        now = p[j] * abs(off)
        lost[j] += change(step, curvature[j] / relaxation, twice, p[j], sign * off, now)


@shared
def _compare(step, count, f):
    """Record the step at sites where it reduces the energy more than all previous steps."""
    lost, least, best = _line(f, _CHANGE), _line(f, _LEAST), _line(f, _BEST)
    for j in range(count):
        best[j] = step if lost[j] < least[j] else best[j]
        least[j] = min(lost[j], least[j])
        lost[j] = float32(0)


@shared
def _move(d, y, p, k, relaxation, count, f, out):
    """Move component k by the best step where this decreases the component's energy."""
    curvature, slope, best = curvature_of(f, k), slope_of(f, k), _line(f, _BEST)
    for j in range(count):
        off = y[j] - d[j]
        sign = downhill(slope[j], p[j], off)
        twice = float32(2) * sign * slope[j]
        now = p[j] * abs(off)
        lost = change(best[j], curvature[j] / relaxation, twice, p[j], sign * off, now)
        new = d[j] + sign * (best[j] if lost < float32(0) else float32(0))
        out[j] = float32(0) if abs(new) <= _FLUSH else new


@shared
def _minimise(d, y, p, k, relaxation, count, f, out):
    """Move component k to the minimum of its local energy."""
    curvature, slope = curvature_of(f, k), slope_of(f, k)
    for j in range(count):
        new = minimiser(d[j], curvature[j], slope[j], p[j], y[j], relaxation)
        out[j] = float32(0) if abs(new) <= _FLUSH else new


@callee
def _sweep_row(source, target, stiffness, observation, span, lines, offsets, steps, relaxation, i):
    """Move the sites of a row and return their energy before the move."""
    f, total = scratch(source), 0.0
    if len(f) < _LINES * _LINE:
        return total  # never reached; see `look`
    for x in range(max(span[0], 0) + 2, span[1] + 2, BLOCK):
        end = min(x + BLOCK, span[1] + 2)
        count = end - x
        look(source, stiffness, lines, offsets, i, x, count, f)
        for k in range(3):
            y, p = observation[k, i, x:end], observation[3 + k, i, x:end]
            _observe(source[k, i, x:end], y, p, count, f)
        total += energy_of(f, count)
        f[_CHANGE * _LINE :] = 0
        for step in steps:
            for k in range(3):
                y, p = observation[k, i, x:end], observation[3 + k, i, x:end]
                _try(source[k, i, x:end], y, p, k, step, relaxation, count, f)
            _compare(step, count, f)
        for k in range(3):
            y, p = observation[k, i, x:end], observation[3 + k, i, x:end]
            d, out = source[k, i, x:end], target[k, i, x:end]
            if len(steps) > 0:
                _move(d, y, p, k, relaxation, count, f, out)
            else:
                _minimise(d, y, p, k, relaxation, count, f, out)
    return total


@parallel
def sweeps(
    thread, even, odd, stiffness, observation, spans, lines, offsets, steps, relaxation, row_totals
):
    """Update all sites simultaneously, in one turn for each row of `row_totals`.

    The energy of a site includes only the cliques centred at it. The first sweep reads `even` and
    writes `odd`, the second does the reverse, and so on. `spans` contains the start and stop column
    of the tissue in each row, and `observation` is (y, p) with three components each. If `steps` is
    empty, a site moves to the minimum of its local energy. On return, `row_totals` contains U_total
    before each sweep, per row.
    """
    sweep = thread[2]
    source, target = (even, odd) if sweep % 2 == 0 else (odd, even)
    for i in portion(thread, source.shape[1] - 4):
        row_totals[sweep, i] = _sweep_row(
            source, target, stiffness, observation, spans[i], lines, offsets, steps, relaxation,
            i + 2,
        )  # fmt: skip
