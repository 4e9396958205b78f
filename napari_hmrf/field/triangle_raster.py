"""Compiled loops that rasterize the moved triangles of an image into an inverse map.

This module imports numba. `warp` imports this module on first use. All loops are in one file,
because a change to this file invalidates numba's cache, but a change to an imported module does
not.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
from __future__ import annotations

import math

import numpy as np

from napari_hmrf.compute.compile_cache.decorators import cached, callee
from napari_hmrf.compute.compile_cache.threaded import bounds_of_part, portion, threaded

# Decorators for functions that only compiled code calls. `_inlined` avoids a function call for each
# cell; the calls would take a quarter of the run time.
_callee = callee()
_inlined = callee(forceinline=True)

# Tolerance, in barycentric coordinates, for a pixel to be inside a triangle.
_EDGE = 1e-9
# Twice the area, in pixels, below which a triangle is collapsed and covers no pixel.
_COLLAPSED = 1e-12
# Largest distance, in pixels, between two origins of a pixel that belong to the same tissue.
_NEAR = 1.0
# State of a pixel onto which two different parts of the tissue have moved.
TWICE = 3


@_inlined
def _draw(moved, source, state, value, first, past, a_row, a_col, b_row, b_col, c_row, c_col):
    """Draw a moved triangle if it has the requested orientation; return True if inverted."""
    # With `value` 2, draw non-inverted triangles; with `value` 1, draw inverted triangles. A pixel
    # with a state of at least `value` is unchanged, except that its state becomes `TWICE` if the
    # new origin is distant. Only rows from `first` to `past` - 1 are drawn.
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
    """Store the origin of the tissue on a pixel, or mark the pixel if it has a distant origin."""
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
    """Draw both triangles of a cell; return False if one of them is inverted or collapsed."""
    # The result equals that of `_draw` for each triangle in turn.
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
    """Draw the moved line between two sites onto empty pixels."""
    height, width = state.shape
    ay = moved[a_row, a_col, 0]
    ax = moved[a_row, a_col, 1]
    by = moved[b_row, b_col, 0] - ay
    bx = moved[b_row, b_col, 1] - ax
    # Points are at most half a pixel apart. A line longer than the image is mostly outside it, so
    # the number of its points is limited.
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
    """Draw all triangles onto the rows of pixels from `first` to `past` - 1."""
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
    """Draw sites, and lines between outermost sites, onto empty pixels of a range of rows."""
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
    """Store the smallest and the largest moved row position of the tissue sites of a row."""
    low = math.inf
    high = -math.inf
    for col in range(tissue.shape[1]):
        if tissue[row, col]:
            low = min(low, moved[row, col, 0])
            high = max(high, moved[row, col, 0])
    reach[row, 0] = low
    reach[row, 1] = high


@cached()
def rasterise(moved, tissue):
    """Invert the motion of the sites, linear on each triangle of three neighbouring sites.

    Each cell of 2 x 2 sites consists of two triangles; a cell with three tissue sites is a single
    triangle. Pixels that no triangle covers are filled with the sites, and the lines between
    outermost sites, that have moved onto them. With these lines, tissue that is one pixel thin
    remains visible, and all tissue extends half a pixel beyond its outermost sites, as pixels do.

    Parameters
    ----------
    moved : ndarray, shape (H, W, 2), float64
        Moved position of each site, in pixels (row, col).
    tissue : ndarray, shape (H, W), bool
        Mask of the tissue.

    Returns
    -------
    source : ndarray, shape (H, W, 2), float64
        Origin of the tissue on each pixel, in pixels.
    state : ndarray, shape (H, W), uint8
        0 if no tissue has moved onto the pixel; 1 for an inverted triangle; 2 for a line or a
        non-inverted triangle; 3 for two non-inverted triangles with origins more than a pixel
        apart.
    """
    height, width = tissue.shape
    source = np.zeros((height, width, 2))
    state = np.zeros((height, width), np.uint8)
    reach = np.empty((height, 2))
    for row in range(height):
        _note_reach(moved, tissue, row, reach)
    first = np.int64(0)  # with a Python int, numba would compile the functions a second time
    _triangles(moved, tissue, source, state, reach, first, height)
    _outline(moved, tissue, source, state, reach, first, height)
    return source, state


@threaded(turns=2)
def rasterise_displaced(
    thread, displacement, spacing, fraction, tissue, bands, moved, reach, source, state, fine
):
    """Apply `rasterise` to a fraction of a displacement, on all cores, with preallocated arrays.

    Each core fills separate rows of pixels and draws all triangles in the order of `rasterise`, so
    the result is identical.

    Parameters
    ----------
    displacement : ndarray, shape (H, W, 2), float32
        Material displacement, in the unit of `spacing`.
    spacing : (float, float)
        Size of a pixel along the row and column axes.
    fraction : float
        Fraction of the displacement, from 0 to 1.
    tissue : ndarray, shape (H, W), bool
        Mask of the tissue.
    bands : int
        Number of bands of rows into which the image is divided: one or a few for each core.
    moved : ndarray, shape (H, W, 2), float64
        Output: moved position of each site, in pixels.
    reach : ndarray, shape (H, 2), float64
        Output: range of the moved row positions of the tissue sites of each row.
    source, state : ndarray
        Output, as returned by `rasterise`; `source` is unchanged where `state` is 0.
    fine : ndarray, shape (H,), bool
        Output: False for rows in which the displacement of tissue is not finite. If there are any,
        the other outputs are invalid.
    """
    height, width = tissue.shape
    if thread[2] == 0:
        for row in portion(thread, height):
            fine[row] = True
            for col in range(width):
                # The displacement outside tissue is ignored.
                by_row = fraction * displacement[row, col, 0] if tissue[row, col] else 0.0
                by_col = fraction * displacement[row, col, 1] if tissue[row, col] else 0.0
                moved[row, col, 0] = by_row / spacing[0] + row
                moved[row, col, 1] = by_col / spacing[1] + col
                if not (math.isfinite(by_row) and math.isfinite(by_col)):
                    fine[row] = False
                state[row, col] = 0
            _note_reach(moved, tissue, row, reach)
    elif fine.all():
        for band in portion(thread, bands):
            first, past = bounds_of_part(band, bands, height)
            _triangles(moved, tissue, source, state, reach, first, past)
            _outline(moved, tissue, source, state, reach, first, past)
