"""The compiled loop behind `warp`: draws moved triangles of sites into an inverse map.

Imports numba; `warp` imports this module when it is first needed.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
from __future__ import annotations

import math

import numba
import numpy as np

# How far outside a triangle, in barycentric coordinates, a pixel still counts as on its edge.
_EDGE = 1e-9
# Twice the area, in pixels, below which a triangle has collapsed and covers nothing.
_COLLAPSED = 1e-12
# Pixels between two places from which tissue came, up to which they are one: neighbours.
_NEAR = 1.0
# The state of a pixel that two parts of the tissue have moved onto.
TWICE = 3


@numba.njit(inline="always")
def _draw(moved, source, state, value, height, width, a_row, a_col, b_row, b_col, c_row, c_col):
    """Draw the moved triangle of sites a, b, c if its orientation is the one asked for.

    `value` is 2 for triangles that kept their orientation and 1 for those that were turned over; a
    pixel that already holds as much is left alone, but for a mark if what it holds came from
    elsewhere. Returns whether this one was turned over.
    """
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
    first_row = math.ceil(max(0.0, ay + min(0.0, by, cy) - _EDGE))
    last_row = math.floor(min(height - 1.0, ay + max(0.0, by, cy) + _EDGE))
    first_col = math.ceil(max(0.0, ax + min(0.0, bx, cx) - _EDGE))
    last_col = math.floor(min(width - 1.0, ax + max(0.0, bx, cx) + _EDGE))
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
            if state[row, col] >= value:
                rows = abs(from_row - source[row, col, 0])
                cols = abs(from_col - source[row, col, 1])
                if value == 2 and max(rows, cols) > _NEAR:
                    state[row, col] = TWICE
                continue
            state[row, col] = value
            source[row, col, 0] = from_row
            source[row, col, 1] = from_col
    return not kept


@numba.njit
def _stroke(moved, source, state, height, width, a_row, a_col, b_row, b_col):
    """Draw the moved line between two sites, or a single one, onto pixels still empty."""
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
        if 0 <= y < height and 0 <= x < width:
            row = math.floor(y)
            col = math.floor(x)
            if state[row, col] == 0:
                state[row, col] = 2
                source[row, col, 0] = a_row + part * (b_row - a_row)
                source[row, col, 1] = a_col + part * (b_col - a_col)


@numba.njit(cache=True, nogil=True, error_model="numpy")
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
    turned = True
    for value in (2, 1):
        if not turned:
            break
        turned = False
        for row in range(height - 1):
            for col in range(width - 1):
                a = tissue[row, col]
                b = tissue[row, col + 1]
                c = tissue[row + 1, col]
                d = tissue[row + 1, col + 1]
                below = row + 1
                right = col + 1
                if a and d:
                    if b:
                        turned |= _draw(
                            moved, source, state, value, height, width,
                            row, col, row, right, below, right,
                        )  # fmt: skip
                    if c:
                        turned |= _draw(
                            moved, source, state, value, height, width,
                            row, col, below, right, below, col,
                        )  # fmt: skip
                elif b and c:
                    if a:
                        turned |= _draw(
                            moved, source, state, value, height, width,
                            row, right, below, col, row, col,
                        )  # fmt: skip
                    elif d:
                        turned |= _draw(
                            moved, source, state, value, height, width,
                            row, right, below, right, below, col,
                        )  # fmt: skip
    for row in range(height):
        for col in range(width):
            if tissue[row, col]:
                _stroke(moved, source, state, height, width, row, col, row, col)
    for row in range(height):
        for col in range(width):
            if not tissue[row, col]:
                continue
            below = row + 1
            right = col + 1
            if right < width and tissue[row, right]:
                before = row > 0 and (tissue[row - 1, col] or tissue[row - 1, right])
                behind = below < height and (tissue[below, col] or tissue[below, right])
                if not (before and behind):
                    _stroke(moved, source, state, height, width, row, col, row, right)
            if below < height and tissue[below, col]:
                before = col > 0 and (tissue[row, col - 1] or tissue[below, col - 1])
                behind = right < width and (tissue[row, right] or tissue[below, right])
                if not (before and behind):
                    _stroke(moved, source, state, height, width, row, col, below, col)
    return source, state
