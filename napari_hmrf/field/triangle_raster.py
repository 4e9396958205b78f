"""The compiled loops behind `warp`: draw moved triangles of sites into an inverse map.

Imports numba; `warp` imports this module when it is first needed. All loops are in this file,
because numba's cache notices when this file changes, not when one that it imports does.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
from __future__ import annotations

import math

import numba
import numpy as np

# What only loops call, and what is taken into them: calls for each cell take a quarter of the time.
_LOOPS = {"error_model": "numpy", "no_cfunc_wrapper": True}
_callee = numba.njit(no_cpython_wrapper=True, **_LOOPS)
_inlined = numba.njit(no_cpython_wrapper=True, forceinline=True, **_LOOPS)
# What Python calls.
_kept = {"cache": True, "nogil": True, **_LOOPS}

# How far outside a triangle, in barycentric coordinates, a pixel still counts as on its edge.
_EDGE = 1e-9
# Twice the area, in pixels, below which a triangle has collapsed and covers nothing.
_COLLAPSED = 1e-12
# Pixels between two places from which tissue came, up to which they are one: neighbours.
_NEAR = 1.0
# The state of a pixel that two parts of the tissue have moved onto.
TWICE = 3


@_inlined
def _draw(moved, source, state, value, first, past, a_row, a_col, b_row, b_col, c_row, c_col):
    """Draw the moved triangle of sites a, b, c if its orientation is the one asked for."""
    # `value` is 2 for triangles that kept their orientation and 1 for those that were turned over;
    # a pixel that already holds as much is left alone, but for a mark if what it holds came from
    # elsewhere. Only rows of pixels from `first` to before `past` are drawn on. Returns whether
    # this one was turned over.
    ay = moved[a_row, a_col, 0]
    ax = moved[a_row, a_col, 1]
    by = moved[b_row, b_col, 0] - ay
    bx = moved[b_row, b_col, 1] - ax
    cy = moved[c_row, c_col, 0] - ay
    cx = moved[c_row, c_col, 1] - ax
    area = by * cx - bx * cy
    rest = (b_row - a_row) * (c_col - a_col) - (b_col - a_col) * (c_row - a_row)
    kept = area * rest > 0
    if abs(area) < _COLLAPSED:
        return False
    if kept != (value == 2):
        return not kept
    first_row = math.ceil(max(1.0 * first, ay + min(0.0, by, cy) - _EDGE))
    last_row = math.floor(min(past - 1.0, ay + max(0.0, by, cy) + _EDGE))
    first_col = math.ceil(max(0.0, ax + min(0.0, bx, cx) - _EDGE))
    last_col = math.floor(min(state.shape[1] - 1.0, ax + max(0.0, bx, cx) + _EDGE))
    for row in range(first_row, last_row + 1):
        y = row - ay
        for col in range(first_col, last_col + 1):
            x = col - ax
            to_b = (y * cx - x * cy) / area
            to_c = (by * x - bx * y) / area
            if to_b < -_EDGE or to_c < -_EDGE or to_b + to_c > 1 + _EDGE:
                continue
            from_row = a_row + to_b * (b_row - a_row) + to_c * (c_row - a_row)
            from_col = a_col + to_b * (b_col - a_col) + to_c * (c_col - a_col)
            _mark(source, state, value, row, col, from_row, from_col)
    return not kept


@_inlined
def _mark(source, state, value, row, col, from_row, from_col):
    """Say where the tissue on a pixel came from, unless another triangle has come first."""
    if state[row, col] < value:
        state[row, col] = value
        source[row, col, 0] = from_row
        source[row, col, 1] = from_col
    elif value == 2:
        rows = abs(from_row - source[row, col, 0])
        cols = abs(from_col - source[row, col, 1])
        if max(rows, cols) > _NEAR:
            state[row, col] = TWICE


@_inlined
def _draw_cell(moved, source, state, first, past, row, col):
    """Draw both triangles of a whole cell at once, if neither is turned over nor collapsed."""
    # As `_draw` would for the one after the other. Returns whether it could.
    ay = moved[row, col, 0]
    ax = moved[row, col, 1]
    by = moved[row, col + 1, 0] - ay
    bx = moved[row, col + 1, 1] - ax
    cy = moved[row + 1, col + 1, 0] - ay
    cx = moved[row + 1, col + 1, 1] - ax
    dy = moved[row + 1, col, 0] - ay
    dx = moved[row + 1, col, 1] - ax
    upper = cy * bx - cx * by
    lower = dy * cx - dx * cy
    if min(upper, lower) < _COLLAPSED:
        return False
    first_row = math.ceil(max(1.0 * first, ay + min(0.0, by, cy, dy) - _EDGE))
    last_row = math.floor(min(past - 1.0, ay + max(0.0, by, cy, dy) + _EDGE))
    first_col = math.ceil(max(0.0, ax + min(0.0, bx, cx, dx) - _EDGE))
    last_col = math.floor(min(state.shape[1] - 1.0, ax + max(0.0, bx, cx, dx) + _EDGE))
    for to_row in range(first_row, last_row + 1):
        y = to_row - ay
        for to_col in range(first_col, last_col + 1):
            x = to_col - ax
            across = x * cy - y * cx
            to_b = across / upper
            to_c = (y * bx - x * by) / upper
            if to_b >= -_EDGE and to_c >= -_EDGE and to_b + to_c <= 1 + _EDGE:
                _mark(source, state, 2, to_row, to_col, row + to_c, col + to_b + to_c)
                continue
            to_d = -across / lower
            to_c = (x * dy - y * dx) / lower
            if to_d >= -_EDGE and to_c >= -_EDGE and to_d + to_c <= 1 + _EDGE:
                _mark(source, state, 2, to_row, to_col, row + to_c + to_d, col + to_c)
    return True


@_callee
def _stroke(moved, source, state, first, past, a_row, a_col, b_row, b_col):
    """Draw the moved line between two sites onto pixels still empty."""
    height, width = state.shape
    ay = moved[a_row, a_col, 0]
    ax = moved[a_row, a_col, 1]
    by = moved[b_row, b_col, 0] - ay
    bx = moved[b_row, b_col, 1] - ax
    # Half a pixel at a time; a line longer than the image mostly lies outside.
    steps = math.ceil(2.0 * min(max(abs(by), abs(bx)), 1.0 * (height + width)))
    for step in range(steps + 1):
        part = step / max(steps, 1)
        y = ay + part * by + 0.5
        x = ax + part * bx + 0.5
        if first <= y < past and 0 <= x < width:
            row = math.floor(y)
            col = math.floor(x)
            if state[row, col] == 0:
                state[row, col] = 2
                source[row, col, 0] = a_row + part * (b_row - a_row)
                source[row, col, 1] = a_col + part * (b_col - a_col)


@_callee
def _triangles(moved, tissue, source, state, reach, first, past):
    """Draw all triangles onto the rows of pixels from `first` to before `past`."""
    height, width = tissue.shape
    turned = True
    for value in (2, 1):
        if not turned:
            break
        turned = False
        for row in range(height - 1):
            if min(reach[row, 0], reach[row + 1, 0]) > past:
                continue
            if max(reach[row, 1], reach[row + 1, 1]) < first - 1:
                continue
            for col in range(width - 1):
                a = tissue[row, col]
                b = tissue[row, col + 1]
                c = tissue[row + 1, col]
                d = tissue[row + 1, col + 1]
                below = row + 1
                right = col + 1
                whole = a and b and c and d and value == 2
                if whole and _draw_cell(moved, source, state, first, past, row, col):
                    continue
                if a and d:
                    if b:
                        turned |= _draw(
                            moved, source, state, value, first, past,
                            row, col, row, right, below, right,
                        )  # fmt: skip
                    if c:
                        turned |= _draw(
                            moved, source, state, value, first, past,
                            row, col, below, right, below, col,
                        )  # fmt: skip
                elif b and c:
                    if a:
                        turned |= _draw(
                            moved, source, state, value, first, past,
                            row, right, below, col, row, col,
                        )  # fmt: skip
                    elif d:
                        turned |= _draw(
                            moved, source, state, value, first, past,
                            row, right, below, right, below, col,
                        )  # fmt: skip


@_callee
def _outline(moved, tissue, source, state, reach, first, past):
    """Draw sites and the lines between outermost ones onto what is empty of these rows."""
    height, width = tissue.shape
    for row in range(height):
        if reach[row, 0] > past or reach[row, 1] < first - 1:
            continue
        for col in range(width):
            y = moved[row, col, 0] + 0.5
            x = moved[row, col, 1] + 0.5
            if not (tissue[row, col] and first <= y < past and 0 <= x < width):
                continue
            if state[math.floor(y), math.floor(x)] == 0:
                _mark(source, state, 2, math.floor(y), math.floor(x), row, col)
    for row in range(height):
        below = min(row + 1, height - 1)
        if min(reach[row, 0], reach[below, 0]) > past:
            continue
        if max(reach[row, 1], reach[below, 1]) < first - 1:
            continue
        for col in range(width):
            if not tissue[row, col]:
                continue
            below = row + 1
            right = col + 1
            if right < width and tissue[row, right]:
                before = row > 0 and (tissue[row - 1, col] or tissue[row - 1, right])
                behind = below < height and (tissue[below, col] or tissue[below, right])
                if not (before and behind):
                    _stroke(moved, source, state, first, past, row, col, row, right)
            if below < height and tissue[below, col]:
                before = col > 0 and (tissue[row, col - 1] or tissue[below, col - 1])
                behind = right < width and (tissue[row, right] or tissue[below, right])
                if not (before and behind):
                    _stroke(moved, source, state, first, past, row, col, below, col)


@_callee
def _note_reach(moved, tissue, row, reach):
    """Note the first and the last row of pixels, as real numbers, that sites of a row moved to."""
    low = math.inf
    high = -math.inf
    for col in range(tissue.shape[1]):
        if tissue[row, col]:
            low = min(low, moved[row, col, 0])
            high = max(high, moved[row, col, 0])
    reach[row, 0] = low
    reach[row, 1] = high


@numba.njit(**_kept)
def rasterise(moved, tissue):
    """Invert the motion of the sites, linear on each triangle of three neighbouring sites.

    Each cell of 2 x 2 sites is two triangles; a cell that lacks one corner is one. A pixel that no
    triangle covers goes to the site or the line between two outermost sites that has moved onto
    it, if any: tissue one pixel thin survives, and all tissue reaches half a pixel beyond its
    outermost sites, as pixels do.

    Parameters
    ----------
    moved : ndarray, shape (H, W, 2), float64
        Where each site has moved, in pixels (row, col).
    tissue : ndarray, shape (H, W), bool
        Which sites there are.

    Returns
    -------
    source : ndarray, shape (H, W, 2), float64
        Where the tissue now on each pixel came from, in pixels.
    state : ndarray, shape (H, W), uint8
        0 nothing came, 1 by a triangle turned over, 2 by one that was not, or by a line, 3 by
        two that were not, from places more than a pixel apart.
    """
    height, width = tissue.shape
    source = np.zeros((height, width, 2))
    state = np.zeros((height, width), np.uint8)
    reach = np.empty((height, 2))
    for row in range(height):
        _note_reach(moved, tissue, row, reach)
    first = np.int64(0)  # a plain 0 would make functions of its own
    _triangles(moved, tissue, source, state, reach, first, height)
    _outline(moved, tissue, source, state, reach, first, height)
    return source, state


@numba.njit(parallel=True, **_kept)
def rasterise_displaced(
    displacement, spacing, fraction, tissue, bands, moved, reach, source, state
):
    """`rasterise` of a part of a displacement, by all cores, into memory that is there.

    Each core fills rows of pixels of its own, and draws on them in the order of `rasterise`: the
    result is the same to the bit.

    Parameters
    ----------
    displacement : ndarray, shape (H, W, 2), float32
        In the unit of `spacing`.
    spacing : (float, float)
    fraction : float
        How much of the displacement, 0 to 1.
    tissue : ndarray, shape (H, W), bool
    bands : int
        Into so many bands of rows the image is cut, one or a few for each core.
    moved : ndarray, shape (H, W, 2), float64
        Overwritten by where each site has moved.
    reach : ndarray, shape (H, 2), float64
        Overwritten.
    source, state : ndarray
        Overwritten by the result; `source` is left as it was where `state` is 0.

    Returns
    -------
    bool
        Whether the displacement is finite wherever there is tissue; if not, there is no result.
    """
    height, width = tissue.shape
    fine = np.ones(height, np.bool_)
    for number in numba.prange(height):
        row = np.int64(number)  # so is the counter of a parallel loop, to some of them
        for col in range(width):
            # Void has no displacement, whatever is written there.
            by_row = fraction * displacement[row, col, 0] if tissue[row, col] else 0.0
            by_col = fraction * displacement[row, col, 1] if tissue[row, col] else 0.0
            moved[row, col, 0] = by_row / spacing[0] + row
            moved[row, col, 1] = by_col / spacing[1] + col
            if not (math.isfinite(by_row) and math.isfinite(by_col)):
                fine[row] = False
            state[row, col] = 0
        _note_reach(moved, tissue, row, reach)
    if not fine.all():
        return False
    for number in numba.prange(bands):
        band = np.int64(number)
        first = band * height // bands
        past = (band + 1) * height // bands
        _triangles(moved, tissue, source, state, reach, first, past)
        _outline(moved, tissue, source, state, reach, first, past)
    return True
