"""Compiled loops that rasterize the moved tetrahedra of a volume into an inverse map.

This module imports numba. `warp` imports this module when the first volume is warped, and only then
are its loops compiled. All loops are in one file, because a change to this file invalidates numba's
cache, but a change to an imported module does not.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
from __future__ import annotations

import math
from typing import Any

import numpy as np

from napari_hmrf.compute.compile_cache.decorators import callee
from napari_hmrf.compute.compile_cache.threaded import bounds_of_part, portion, threaded

_callee = callee()

# Tolerance, in barycentric coordinates, for a voxel to be inside a tetrahedron.
_SIDE = 1e-9
# Six times the volume, in voxels, below which a tetrahedron is collapsed and covers no voxel.
_COLLAPSED = 1e-12
# Largest distance, in voxels, between two origins of a voxel that belong to the same tissue.
_NEAR = 1.0
# State of a voxel onto which two different parts of the tissue have moved.
TWICE = 3
# Kuhn's division of a cell into six tetrahedra, each along three edges from the first to the last
# corner of the cell: second corner and third corner, (plane, row, column), and orientation. With
# this division, the tetrahedra of neighbouring cells have common faces.
_SECOND = ((1, 0, 0), (1, 0, 0), (0, 1, 0), (0, 1, 0), (0, 0, 1), (0, 0, 1))
_THIRD = ((1, 1, 0), (1, 0, 1), (1, 1, 0), (0, 1, 1), (1, 0, 1), (0, 1, 1))
_ROUND = (1.0, -1.0, -1.0, 1.0, 1.0, -1.0)
# Unit step along each axis, and pairs of axes that span squares.
_UNITS = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
_PAIRS = ((0, 1), (0, 2), (1, 2))
# Residual, in voxels, below which an origin is exact; largest number of Newton steps; and
# determinant of the gradient below which a step is undefined.
_EXACT, _STEPS, _FLAT = 1e-7, 8, 1e-3
# Largest difference between the displacements of a cell's corners, in voxels summed over the axes,
# up to which the cell is not checked for inversion. Below 1, the edge matrix of a tetrahedron is
# never singular.
_ALIKE = 0.9


@_callee
def _mark(source, state, value, plane, row, col, from_plane, from_row, from_col):
    """Store the origin of the tissue on a voxel, or mark the voxel if it has a distant origin."""
    if state[plane, row, col] < value:
        state[plane, row, col] = value
        source[plane, row, col, 0] = from_plane
        source[plane, row, col, 1] = from_row
        source[plane, row, col, 2] = from_col
    elif value == 2:
        planes = abs(from_plane - source[plane, row, col, 0])
        rows = abs(from_row - source[plane, row, col, 1])
        cols = abs(from_col - source[plane, row, col, 2])
        if max(planes, rows, cols) > _NEAR:
            state[plane, row, col] = TWICE


@_callee
def _draw(moved, source, state, value, first, past, plane, row, col, way):
    """Draw a moved tetrahedron if it has the requested orientation; return True if inverted."""
    # With `value` 2, draw non-inverted tetrahedra; with `value` 1, draw inverted tetrahedra. A
    # voxel with a state of at least `value` is unchanged, except that its state becomes `TWICE` if
    # the new origin is distant. Only planes from `first` to `past` - 1 are drawn. For a tetrahedron
    # that does not intersect these planes, the result is False.
    b0, b1, b2 = _SECOND[way]
    c0, c1, c2 = _THIRD[way]
    az = moved[plane, row, col, 0]
    bz = moved[plane + b0, row + b1, col + b2, 0] - az
    cz = moved[plane + c0, row + c1, col + c2, 0] - az
    dz = moved[plane + 1, row + 1, col + 1, 0] - az
    first_plane = math.ceil(max(1.0 * first, az + min(0.0, bz, cz, dz) - _SIDE))
    last_plane = math.floor(min(past - 1.0, az + max(0.0, bz, cz, dz) + _SIDE))
    if first_plane > last_plane:
        return False
    ay = moved[plane, row, col, 1]
    ax = moved[plane, row, col, 2]
    by = moved[plane + b0, row + b1, col + b2, 1] - ay
    bx = moved[plane + b0, row + b1, col + b2, 2] - ax
    cy = moved[plane + c0, row + c1, col + c2, 1] - ay
    cx = moved[plane + c0, row + c1, col + c2, 2] - ax
    dy = moved[plane + 1, row + 1, col + 1, 1] - ay
    dx = moved[plane + 1, row + 1, col + 1, 2] - ax
    # Normals of the faces. The product of a normal and a position is a barycentric coordinate times
    # six times the volume.
    bnz, bny, bnx = cy * dx - cx * dy, cx * dz - cz * dx, cz * dy - cy * dz
    cnz, cny, cnx = dy * bx - dx * by, dx * bz - dz * bx, dz * by - dy * bz
    dnz, dny, dnx = by * cx - bx * cy, bx * cz - bz * cx, bz * cy - by * cz
    volume = bz * bnz + by * bny + bx * bnx
    kept = volume * _ROUND[way] > 0
    if abs(volume) < _COLLAPSED:
        return False
    if kept != (value == 2):
        return not kept
    bnz, bny, bnx = bnz / volume, bny / volume, bnx / volume
    cnz, cny, cnx = cnz / volume, cny / volume, cnx / volume
    dnz, dny, dnx = dnz / volume, dny / volume, dnx / volume
    first_row = math.ceil(max(0.0, ay + min(0.0, by, cy, dy) - _SIDE))
    last_row = math.floor(min(state.shape[1] - 1.0, ay + max(0.0, by, cy, dy) + _SIDE))
    first_col = math.ceil(max(0.0, ax + min(0.0, bx, cx, dx) - _SIDE))
    last_col = math.floor(min(state.shape[2] - 1.0, ax + max(0.0, bx, cx, dx) + _SIDE))
    for to_plane in range(first_plane, last_plane + 1):
        z = to_plane - az
        for to_row in range(first_row, last_row + 1):
            y = to_row - ay
            for to_col in range(first_col, last_col + 1):
                x = to_col - ax
                to_b = z * bnz + y * bny + x * bnx
                to_c = z * cnz + y * cny + x * cnx
                to_d = z * dnz + y * dny + x * dnx
                if min(to_b, to_c, to_d) < -_SIDE or to_b + to_c + to_d > 1 + _SIDE:
                    continue
                _mark(
                    source, state, value, to_plane, to_row, to_col,
                    plane + to_b * b0 + to_c * c0 + to_d,
                    row + to_b * b1 + to_c * c1 + to_d,
                    col + to_b * b2 + to_c * c2 + to_d,
                )  # fmt: skip
    return not kept


@_callee
def _is_inner(tissue, plane, row, col):
    """Return whether all 26 neighbours of a site are tissue."""
    depth, height, width = tissue.shape
    if min(plane, row, col) < 1 or plane > depth - 2 or row > height - 2 or col > width - 2:
        return False
    for i in range(plane - 1, plane + 2):
        for j in range(row - 1, row + 2):
            if not (tissue[i, j, col - 1] and tissue[i, j, col] and tissue[i, j, col + 1]):
                return False
    return True


@_callee
def _is_face(tissue, plane, row, col):
    """Return whether the four corners of a cell face perpendicular to the columns are tissue."""
    return (
        tissue[plane, row, col]
        and tissue[plane, row + 1, col]
        and tissue[plane + 1, row, col]
        and tissue[plane + 1, row + 1, col]
    )


@_callee
def _steps_of(moved, plane, row, col):
    """Return the smallest and the largest displacement, per axis, of the corners of a cell face."""
    least, most = (math.inf, math.inf, math.inf), (-math.inf, -math.inf, -math.inf)
    for corner in range(4):
        i, j = plane + corner // 2, row + corner % 2
        z, y, x = moved[i, j, col, 0] - i, moved[i, j, col, 1] - j, moved[i, j, col, 2] - col
        least = min(least[0], z), min(least[1], y), min(least[2], x)
        most = max(most[0], z), max(most[1], y), max(most[2], x)
    return least, most


@_callee
def _claims(moved, source, state, plane, row, col, way, to_plane, to_row, to_col):
    """Draw a non-inverted tetrahedron onto a voxel; return whether it covers the voxel."""
    b0, b1, b2 = _SECOND[way]
    c0, c1, c2 = _THIRD[way]
    az, ay, ax = moved[plane, row, col, 0], moved[plane, row, col, 1], moved[plane, row, col, 2]
    bz = moved[plane + b0, row + b1, col + b2, 0] - az
    by = moved[plane + b0, row + b1, col + b2, 1] - ay
    bx = moved[plane + b0, row + b1, col + b2, 2] - ax
    cz = moved[plane + c0, row + c1, col + c2, 0] - az
    cy = moved[plane + c0, row + c1, col + c2, 1] - ay
    cx = moved[plane + c0, row + c1, col + c2, 2] - ax
    dz = moved[plane + 1, row + 1, col + 1, 0] - az
    dy = moved[plane + 1, row + 1, col + 1, 1] - ay
    dx = moved[plane + 1, row + 1, col + 1, 2] - ax
    z, y, x = to_plane - az, to_row - ay, to_col - ax
    bnz, bny, bnx = cy * dx - cx * dy, cx * dz - cz * dx, cz * dy - cy * dz
    part = 1.0 / (bz * bnz + by * bny + bx * bnx)
    to_b = part * (z * bnz + y * bny + x * bnx)
    to_c = part * (z * (dy * bx - dx * by) + y * (dx * bz - dz * bx) + x * (dz * by - dy * bz))
    to_d = part * (z * (by * cx - bx * cy) + y * (bx * cz - bz * cx) + x * (bz * cy - by * cz))
    if min(to_b, to_c, to_d) < -_SIDE or to_b + to_c + to_d > 1 + _SIDE:
        return False
    _mark(
        source, state, 2, to_plane, to_row, to_col,
        plane + to_b * b0 + to_c * c0 + to_d,
        row + to_b * b1 + to_c * c1 + to_d,
        col + to_b * b2 + to_c * c2 + to_d,
    )  # fmt: skip
    return True


@_callee
def _draw_alike(moved, source, state, first, past, plane, row, col, least, most):
    """Draw all tetrahedra of a cell with nearly equal displacements at its corners."""
    # The origin of a voxel is its position minus a displacement between `least` and `most`. Usually
    # a single tetrahedron can contain this origin, and the others are not tested. On a face shared
    # by two tetrahedra, the first tetrahedron is used, as in `_draw`.
    _, height, width = state.shape
    first_plane = math.ceil(max(1.0 * first, plane + least[0] - _SIDE))
    last_plane = math.floor(min(past - 1.0, plane + 1 + most[0] + _SIDE))
    first_row = math.ceil(max(0.0, row + least[1] - _SIDE))
    last_row = math.floor(min(height - 1.0, row + 1 + most[1] + _SIDE))
    first_col = math.ceil(max(0.0, col + least[2] - _SIDE))
    last_col = math.floor(min(width - 1.0, col + 1 + most[2] + _SIDE))
    shifted = least == most
    for z in range(first_plane, last_plane + 1):
        for y in range(first_row, last_row + 1):
            for x in range(first_col, last_col + 1):
                if shifted:
                    _mark(source, state, 2, z, y, x, z - least[0], y - least[1], x - least[2])
                    continue
                # `zy` is True if the offset of the origin in the cell may be larger along z than
                # along y; the other names are analogous.
                deep, down, along = z - plane, y - row, x - col
                zy = deep - least[0] > down - most[1] - 2 * _SIDE
                yz = down - least[1] > deep - most[0] - 2 * _SIDE
                zx = deep - least[0] > along - most[2] - 2 * _SIDE
                xz = along - least[2] > deep - most[0] - 2 * _SIDE
                yx = down - least[1] > along - most[2] - 2 * _SIDE
                xy = along - least[2] > down - most[1] - 2 * _SIDE
                if zy and yx and _claims(moved, source, state, plane, row, col, 0, z, y, x):
                    continue
                if zx and xy and _claims(moved, source, state, plane, row, col, 1, z, y, x):
                    continue
                if yz and zx and _claims(moved, source, state, plane, row, col, 2, z, y, x):
                    continue
                if yx and xz and _claims(moved, source, state, plane, row, col, 3, z, y, x):
                    continue
                if xz and zy and _claims(moved, source, state, plane, row, col, 4, z, y, x):
                    continue
                if xy and yz:
                    _claims(moved, source, state, plane, row, col, 5, z, y, x)


@_callee
def _reaches(moved, first, past, plane, row, col):
    """Return whether a moved cell may intersect the planes from `first` to `past` - 1."""
    low, high = math.inf, -math.inf
    for corner in range(8):
        place = moved[plane + corner // 4, row + corner // 2 % 2, col + corner % 2, 0]
        low, high = min(low, place), max(high, place)
    return low < past and high > first - 1


@_callee
def _draw_cell(moved, tissue, source, state, value, first, past, plane, row, col):
    """Draw the tetrahedra of a cell one by one; return whether any of them is inverted."""
    turned = False
    if not (tissue[plane, row, col] and tissue[plane + 1, row + 1, col + 1]):
        return False
    if not _reaches(moved, first, past, plane, row, col):
        return False
    for way in range(6):
        b0, b1, b2 = _SECOND[way]
        c0, c1, c2 = _THIRD[way]
        if tissue[plane + b0, row + b1, col + b2] and tissue[plane + c0, row + c1, col + c2]:
            turned |= _draw(moved, source, state, value, first, past, plane, row, col, way)
    return turned


@_callee
def _draw_row(moved, tissue, source, state, value, first, past, plane, row):
    """Draw a row of cells; return whether any tetrahedron is inverted."""
    turned = whole = False
    nothing = 0.0, 0.0, 0.0
    least, most = nothing, nothing
    for col in range(-1, tissue.shape[2] - 1):
        # Neighbouring cells share a face; its displacements are computed only once.
        begins, low, high = whole, least, most
        whole = _is_face(tissue, plane, row, col + 1)
        if whole:
            least, most = _steps_of(moved, plane, row, col + 1)
        if begins and whole:
            low = min(low[0], least[0]), min(low[1], least[1]), min(low[2], least[2])
            high = max(high[0], most[0]), max(high[1], most[1]), max(high[2], most[2])
            if high[0] - low[0] + high[1] - low[1] + high[2] - low[2] < _ALIKE:
                if value == 2:
                    _draw_alike(moved, source, state, first, past, plane, row, col, low, high)
                continue
        if col >= 0:
            turned |= _draw_cell(moved, tissue, source, state, value, first, past, plane, row, col)
    return turned


@_callee
def _tetrahedra(moved, tissue, source, state, reach, first, past):
    """Draw all tetrahedra onto the planes of voxels from `first` to `past` - 1."""
    depth, height, _ = tissue.shape
    turned = True
    for value in (2, 1):
        if not turned:
            break
        turned = False
        for plane in range(depth - 1):
            if min(reach[plane, 0], reach[plane + 1, 0]) > past:
                continue
            if max(reach[plane, 1], reach[plane + 1, 1]) < first - 1:
                continue
            for row in range(height - 1):
                turned |= _draw_row(moved, tissue, source, state, value, first, past, plane, row)


@_callee
def _patch(moved, source, state, longest, first, past, plane, row, col, one, other):
    """Draw a moved square, spanned by two unit steps from a site, onto empty voxels."""
    # If one step is (0, 0, 0), the square is a line; if both steps are 0, the square is a point.
    _, height, width = state.shape
    i, j, k = plane + one[0], row + one[1], col + one[2]
    az, ay, ax = moved[plane, row, col, 0], moved[plane, row, col, 1], moved[plane, row, col, 2]
    bz, by, bx = moved[i, j, k, 0], moved[i, j, k, 1], moved[i, j, k, 2]
    i, j, k = i + other[0], j + other[1], k + other[2]
    dz, dy, dx = moved[i, j, k, 0], moved[i, j, k, 1], moved[i, j, k, 2]
    i, j, k = i - one[0], j - one[1], k - one[2]
    cz, cy, cx = moved[i, j, k, 0], moved[i, j, k, 1], moved[i, j, k, 2]
    along = max(abs(bz - az), abs(by - ay), abs(bx - ax), abs(dz - cz), abs(dy - cy), abs(dx - cx))
    across = max(abs(cz - az), abs(cy - ay), abs(cx - ax), abs(dz - bz), abs(dy - by), abs(dx - bx))
    # Points are at most half a voxel apart. Edges longer than the volume are mostly outside it, so
    # the number of their points is limited.
    steps = math.ceil(2.0 * min(along, longest) - _SIDE)
    rows = math.ceil(2.0 * min(across, longest) - _SIDE)
    for number in range(steps + 1):
        s = number / max(steps, 1)
        for line in range(rows + 1):
            t = line / max(rows, 1)
            z = (1 - t) * ((1 - s) * az + s * bz) + t * ((1 - s) * cz + s * dz) + 0.5
            y = (1 - t) * ((1 - s) * ay + s * by) + t * ((1 - s) * cy + s * dy) + 0.5
            x = (1 - t) * ((1 - s) * ax + s * bx) + t * ((1 - s) * cx + s * dx) + 0.5
            if not (first <= z < past and 0 <= y < height and 0 <= x < width):
                continue
            if state[math.floor(z), math.floor(y), math.floor(x)] == 0:
                _mark(
                    source, state, 2,
                    math.floor(z), math.floor(y), math.floor(x),
                    plane + s * one[0] + t * other[0],
                    row + s * one[1] + t * other[1],
                    col + s * one[2] + t * other[2],
                )  # fmt: skip


@_callee
def _outline(moved, tissue, outer, source, state, reach, longest, first, past):
    """Draw outermost sites, and lines and squares between them, onto empty voxels."""
    depth, height, width = tissue.shape
    nowhere = 0, 0, 0
    for size in range(3):  # sites first, then lines, then squares
        for plane in range(depth):
            after = min(plane + 1, depth - 1)
            if min(reach[plane, 0], reach[after, 0]) > past:
                continue
            if max(reach[plane, 1], reach[after, 1]) < first - 1:
                continue
            for row in range(height):
                for col in range(width):
                    if not outer[plane, row, col]:
                        continue
                    for way in range(3 if size else 1):
                        one = other = nowhere
                        if size > 0:
                            one = _UNITS[_PAIRS[way][0] if size == 2 else way]
                        if size == 2:
                            other = _UNITS[_PAIRS[way][1]]
                        if _is_square(tissue, plane, row, col, one, other):
                            _patch(
                                moved, source, state, longest, first, past,
                                plane, row, col, one, other,
                            )  # fmt: skip


@_callee
def _is_square(tissue, plane, row, col, one, other):
    """Return whether the other three corners of a square that starts at a site are tissue."""
    return (
        _holds(tissue, plane + one[0], row + one[1], col + one[2])
        and _holds(tissue, plane + other[0], row + other[1], col + other[2])
        and _holds(
            tissue, plane + one[0] + other[0], row + one[1] + other[1], col + one[2] + other[2]
        )
    )


@_callee
def _holds(tissue, plane, row, col):
    """Return whether a site is tissue; False beyond the end of an axis."""
    depth, height, width = tissue.shape
    return plane < depth and row < height and col < width and tissue[plane, row, col]


@_callee
def _stay(tissue, source, state, first, past):
    """Set the origin of each empty voxel outside tissue to the voxel itself."""
    for plane in range(first, past):
        for row in range(tissue.shape[1]):
            for col in range(tissue.shape[2]):
                if state[plane, row, col] == 0 and not tissue[plane, row, col]:
                    source[plane, row, col, 0] = plane
                    source[plane, row, col, 1] = row
                    source[plane, row, col, 2] = col


@_callee
def _is_cell(tissue, plane, row, col):
    """Return whether all eight sites of a cell are tissue."""
    return _is_face(tissue, plane, row, col) and _is_face(tissue, plane, row, col + 1)


@_callee
def _low(place, size):
    """Return the index, along an axis, of the cell that contains a position; -1 if outside."""
    if place < -_SIDE or place > size - 1 + _SIDE:
        return -1
    return max(0, min(size - 2, math.floor(place)))


@_callee
def _refined(moved, tissue, to_plane, to_row, to_col, start):
    """Return the origin for motion that is trilinear in each cell, or `start` if not found."""
    depth, height, width = tissue.shape
    z, y, x = start
    for _ in range(_STEPS):
        plane, row, col = _low(z, depth), _low(y, height), _low(x, width)
        if min(plane, row, col) < 0 or not _is_cell(tissue, plane, row, col):
            return start
        deep, down, along = z - plane, y - row, x - col
        rz, ry, rx = -1.0 * to_plane, -1.0 * to_row, -1.0 * to_col
        # Columns of the gradient: derivatives with respect to the plane, row and column.
        az = ay = ax = bz = by = bx = cz = cy = cx = 0.0
        for corner in range(8):
            i, j, k = corner // 4, corner // 2 % 2, corner % 2
            in_plane = deep if i else 1 - deep
            in_row = down if j else 1 - down
            in_col = along if k else 1 - along
            pz = moved[plane + i, row + j, col + k, 0]
            py = moved[plane + i, row + j, col + k, 1]
            px = moved[plane + i, row + j, col + k, 2]
            share = in_plane * in_row * in_col
            rz, ry, rx = rz + share * pz, ry + share * py, rx + share * px
            share = (2 * i - 1) * in_row * in_col
            az, ay, ax = az + share * pz, ay + share * py, ax + share * px
            share = (2 * j - 1) * in_plane * in_col
            bz, by, bx = bz + share * pz, by + share * py, bx + share * px
            share = (2 * k - 1) * in_plane * in_row
            cz, cy, cx = cz + share * pz, cy + share * py, cx + share * px
        if max(abs(rz), abs(ry), abs(rx)) < _EXACT:
            return z, y, x
        nz, ny, nx = by * cx - bx * cy, bx * cz - bz * cx, bz * cy - by * cz
        volume = az * nz + ay * ny + ax * nx
        if abs(volume) < _FLAT:
            return start
        z -= (rz * nz + ry * ny + rx * nx) / volume
        y -= (
            rz * (cy * ax - cx * ay) + ry * (cx * az - cz * ax) + rx * (cz * ay - cy * az)
        ) / volume
        x -= (
            rz * (ay * bx - ax * by) + ry * (ax * bz - az * bx) + rx * (az * by - ay * bz)
        ) / volume
        if max(abs(z - start[0]), abs(y - start[1]), abs(x - start[2])) > _NEAR:
            return start
    return start


@threaded()
def refine(thread, moved, tissue, begin, end, slabs, source, state):
    """Refine the result of `rasterise` for motion that is trilinear in each cell of eight sites.

    The finite elements and `moved_points` use the same interpolation. In cells with fewer than
    eight sites, and in tissue that has folded over itself, the motion remains linear on
    tetrahedra. Call `outline` after this function.

    Parameters
    ----------
    moved, tissue, begin, end, slabs, source, state
        As for `rasterise`, which must have filled `source` and `state`.
    """
    if min(tissue.shape) < 2:
        return
    for slab in portion(thread, slabs):
        start, stop = bounds_of_part(slab, slabs, end - begin)
        first, past = begin + start, begin + stop
        for plane in range(first, past):
            for row in range(state.shape[1]):
                for col in range(state.shape[2]):
                    if state[plane, row, col] < 2:
                        continue
                    start = (
                        source[plane, row, col, 0],
                        source[plane, row, col, 1],
                        source[plane, row, col, 2],
                    )
                    found = _refined(moved, tissue, plane, row, col, start)
                    source[plane, row, col, 0] = found[0]
                    source[plane, row, col, 1] = found[1]
                    source[plane, row, col, 2] = found[2]


@threaded()
def _surface(thread, moved, tissue, outer, reach):
    """Compute some planes of the output of `surface`."""
    for plane in portion(thread, len(tissue)):
        low, high = math.inf, -math.inf
        for row in range(tissue.shape[1]):
            for col in range(tissue.shape[2]):
                outer[plane, row, col] = False
                if tissue[plane, row, col]:
                    outer[plane, row, col] = not _is_inner(tissue, plane, row, col)
                    low = min(low, moved[plane, row, col, 0])
                    high = max(high, moved[plane, row, col, 0])
        reach[plane, 0] = low
        reach[plane, 1] = high


def surface(moved: Any, tissue: Any) -> tuple[Any, Any]:
    """Find the surface of the tissue, and the range of its moved planes, for `rasterise`.

    Parameters
    ----------
    moved : ndarray, shape (D, H, W, 3), float64
        Moved position of each site, in voxels along the axes.
    tissue : ndarray, shape (D, H, W), bool
        Mask of the tissue.

    Returns
    -------
    outer : ndarray, shape (D, H, W), bool
        Mask of the tissue sites with at least one neighbour that is not tissue.
    reach : ndarray, shape (D, 2), float64
        Smallest and largest moved position, along the first axis, of the sites of each plane.
    """
    outer, reach = np.empty(tissue.shape, bool), np.empty((len(tissue), 2))
    _surface(moved, tissue, outer, reach)
    return outer, reach


@threaded()
def rasterise(thread, moved, tissue, reach, begin, end, slabs, source, state):
    """Invert the motion of the sites, linear on each tetrahedron of four neighbouring sites.

    Each cell of 2 x 2 x 2 sites consists of six tetrahedra. In cells at the border of the tissue,
    only tetrahedra with tissue at all four corners are drawn. `refine` and `outline` complete the
    result.

    Each core fills separate planes and draws all tetrahedra in the same order. The result is
    therefore identical for any number of cores, and for any division of the planes among several
    calls.

    Parameters
    ----------
    moved : ndarray, shape (D, H, W, 3), float64
        Moved position of each site, in voxels along the axes.
    tissue : ndarray, shape (D, H, W), bool
        Mask of the tissue.
    reach : ndarray, shape (D, 2), float64
        Output of `surface`.
    begin, end : int
        Range of the planes of voxels to draw; `end` is exclusive.
    slabs : int
        Number of slabs into which these planes are divided: one or a few for each core.
    source : ndarray, shape (P, H, W, 3), float64
        Output, initially 0: origin of the tissue on each voxel, in voxels.
    state : ndarray, shape (P, H, W), uint8
        Output, initially 0: 0 if no tissue has moved onto the voxel; 1 for an inverted
        tetrahedron; 2 for a non-inverted tetrahedron; 3 for two non-inverted tetrahedra with
        origins more than a voxel apart.
    """
    for slab in portion(thread, slabs):
        start, stop = bounds_of_part(slab, slabs, end - begin)
        first, past = begin + start, begin + stop
        _tetrahedra(moved, tissue, source, state, reach, first, past)


@threaded()
def outline(thread, moved, tissue, outer, reach, longest, begin, end, slabs, source, state):
    """Fill the voxels that no tetrahedron covers, with the outline of the tissue or as void.

    The outline consists of the outermost sites, and the lines and squares between them. With
    the outline, tissue that is one voxel thin remains visible, and all tissue extends half a voxel
    beyond its outermost sites, as voxels do.

    Parameters
    ----------
    outer : ndarray, shape (D, H, W), bool
        Output of `surface`.
    longest : float
        Sum of the sides of the volume, in voxels. It limits the number of points of lines and
        squares that are stretched to a greater length.
    moved, tissue, reach, begin, end, slabs, source, state
        As for `rasterise`, which must be called first. `state` is 2 where the outline is drawn. If
        all planes are given (P = D), the `source` of each empty voxel outside tissue is the voxel.
    """
    for slab in portion(thread, slabs):
        start, stop = bounds_of_part(slab, slabs, end - begin)
        first, past = begin + start, begin + stop
        _outline(moved, tissue, outer, source, state, reach, longest, first, past)
        if len(state) == len(tissue):
            _stay(tissue, source, state, first, past)
