"""Forces of elements in a volume, computed in blocks of sites, for loops in both precisions.

All arrays have a border of void, two sites wide. An element has the index of its first site
(smallest plane, row and column). `solver.priors.hexahedra` documents the equations. A face is the
square of four sites in the same column. Each step is one loop along a line of sites, which the
compiler vectorizes:

1. `_faces` computes for each face the differences of the displacement along the plane axis, along
   the row axis and along both axes, and the sum over the next face minus the sum over the face.
2. `_elements` computes the modes of each element from its two faces, and the forces of these modes
   on both faces.
3. `_gather` adds the forces of the elements before and after a face at the face's four sites. The
   force at the first site is then complete. The forces at the other sites are passed to the next
   row and plane.

The distance between scratch lines is constant, so that the compiler can exclude overlaps.

Lines are processed in groups of eight sites, the width of the vectors of most processors, so that
no loop has a remainder without vectors. The last group of a block may extend up to eight sites
beyond the block. Its values there are computed from whatever follows in memory, which may be the
next row of tissue, and discarded.
"""

# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator"
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.backends.cpu.compiled import callee, disjoint, inline, shared

#: Number of sites per block; a scratch line has room for all faces of a block.
BLOCK = 256
# Number of values per scratch line.
_LINE = BLOCK + 40
# Number of sites per group.
_GROUP = 8
# Indices of the scratch lines. Twelve lines contain faces, four lines per component. Step 2
# replaces them with seven lines of element forces per component. They are followed by three lines
# of forces. The last constant is the number of lines.
_PULLS, _FORCES, _LINES = 0, 21, 24


def constants(shape: Any) -> npt.NDArray[np.float64]:
    """Return the constants of the kernels for the shape of a voxel.

    The constants are the factors of the derivatives along the three axes; a third of the stiffness
    of the six modes that vary along two axes; a ninth of the stiffness of the three modes that vary
    along all axes; and 1/3.
    """
    plane, row, col = squares = np.square(shape)
    along_two = (
        2 * plane + row,
        2 * plane + col,
        2 * row + plane,
        2 * row + col,
        2 * col + plane,
        2 * col + row,
    )
    thirds = [each / 3 for each in along_two]
    return np.array([*shape, *thirds, *((squares + squares.sum()) / 9), 1 / 3])


@inline
def _line(f, number):
    """Return the scratch line with the given index."""
    return f[number * _LINE : (number + 1) * _LINE]


@inline
def _groups(count):
    """Return the number of groups that contain `count` sites."""
    return (count + _GROUP - 1) // _GROUP


@disjoint
def _faces(lines, k, f, groups):
    """Compute step 1 for component k; `lines` are the four lines of sites at the faces' corners."""
    near, right, far, across = lines
    all_four, planes = _line(f, 4 * k), _line(f, 4 * k + 1)
    rows, both = _line(f, 4 * k + 2), _line(f, 4 * k + 3)
    for x in range(_GROUP * groups):
        left, beside = far[x] - near[x], across[x] - right[x]
        here = (near[x + 1] - near[x]) + (right[x + 1] - right[x])
        all_four[x] = here + ((far[x + 1] - far[x]) + (across[x + 1] - across[x]))
        planes[x] = left + beside
        rows[x] = (right[x] - near[x]) + (across[x] - far[x])
        both[x] = beside - left


@disjoint
def _elements(shear, other, share, c, f, groups):
    """Compute step 2 with mu = `shear` and lambda = `share` times `other`."""
    # u, v and w are the components. Each digit in a name is 1 if the mode varies along that axis
    # (plane, row or column). Names of face values have only two digits, because the sites of a face
    # are in one column.
    q0, q1, q2 = c[0], c[1], c[2]
    u_110, u_101, v_110, v_011, w_101, w_011 = c[3], c[4], c[5], c[6], c[7], c[8]
    u_111, v_111, w_111, third = c[9], c[10], c[11], c[12]
    one = f.dtype.type
    u00, u10 = _line(f, 0), _line(f, 1)
    u01, u11 = _line(f, 2), _line(f, 3)
    v00, v10 = _line(f, 4), _line(f, 5)
    v01, v11 = _line(f, 6), _line(f, 7)
    w00, w10 = _line(f, 8), _line(f, 9)
    w01, w11 = _line(f, 10), _line(f, 11)
    pull_u = _line(f, 0)
    near_u10, far_u10 = _line(f, 1), _line(f, 2)
    near_u01, far_u01 = _line(f, 3), _line(f, 4)
    near_u11, far_u11 = _line(f, 5), _line(f, 6)
    pull_v = _line(f, 7)
    near_v10, far_v10 = _line(f, 8), _line(f, 9)
    near_v01, far_v01 = _line(f, 10), _line(f, 11)
    near_v11, far_v11 = _line(f, 12), _line(f, 13)
    pull_w = _line(f, 14)
    near_w10, far_w10 = _line(f, 15), _line(f, 16)
    near_w01, far_w01 = _line(f, 17), _line(f, 18)
    near_w11, far_w11 = _line(f, 19), _line(f, 20)
    for x in range(_GROUP * groups):
        mu, first = one(shear[x]), share * one(other[x])
        u001 = u00[x]
        u100, u101 = u10[x + 1] + u10[x], u10[x + 1] - u10[x]
        u010, u011 = u01[x + 1] + u01[x], u01[x + 1] - u01[x]
        u110, u111 = u11[x + 1] + u11[x], u11[x + 1] - u11[x]
        v001 = v00[x]
        v100, v101 = v10[x + 1] + v10[x], v10[x + 1] - v10[x]
        v010, v011 = v01[x + 1] + v01[x], v01[x + 1] - v01[x]
        v110, v111 = v11[x + 1] + v11[x], v11[x + 1] - v11[x]
        w001 = w00[x]
        w100, w101 = w10[x + 1] + w10[x], w10[x + 1] - w10[x]
        w010, w011 = w01[x + 1] + w01[x], w01[x + 1] - w01[x]
        w110, w111 = w11[x + 1] + w11[x], w11[x + 1] - w11[x]
        e0, e1, e2 = q0 * u100, q1 * v010, q2 * w001
        volume = first * (e0 + e1 + e2)
        s0, s1, s2 = mu * e0, mu * e1, mu * e2
        s01 = mu * (q1 * u010 + q0 * v100)
        s02 = mu * (q2 * u001 + q0 * w100)
        s12 = mu * (q2 * v001 + q1 * w010)
        less = third * mu
        t01 = less * (q1 * u011 + q0 * v101)
        t02 = less * (q2 * u011 + q0 * w110)
        t12 = less * (q2 * v101 + q1 * w110)
        pull_u[x] = q2 * s02
        even, odd = q0 * (volume + s0 + s0), u_101 * mu * u101
        near_u10[x], far_u10[x] = even - odd, even + odd
        even, odd = q1 * s01, q1 * t01 + q2 * t02
        near_u01[x], far_u01[x] = even - odd, even + odd
        even, odd = u_110 * mu * u110, u_111 * mu * u111
        near_u11[x], far_u11[x] = even - odd, even + odd
        pull_v[x] = q2 * s12
        even, odd = q0 * s01, q0 * t01 + q2 * t12
        near_v10[x], far_v10[x] = even - odd, even + odd
        even, odd = q1 * (volume + s1 + s1), v_011 * mu * v011
        near_v01[x], far_v01[x] = even - odd, even + odd
        even, odd = v_110 * mu * v110, v_111 * mu * v111
        near_v11[x], far_v11[x] = even - odd, even + odd
        pull_w[x] = q2 * (volume + s2 + s2)
        even, odd = q0 * s02, w_101 * mu * w101
        near_w10[x], far_w10[x] = even - odd, even + odd
        even, odd = q1 * s12, w_011 * mu * w011
        near_w01[x], far_w01[x] = even - odd, even + odd
        even, odd = q0 * t02 + q1 * t12, w_111 * mu * w111
        near_w11[x], far_w11[x] = even - odd, even + odd


@disjoint
def _gather(f, k, row, corner, plane, count):
    """Compute step 3 for component k of `count` sites."""
    # Each face is the far face of the previous element and the near face of the next element.
    pulls, force = _PULLS + 7 * k, _line(f, _FORCES + k)
    pull = _line(f, pulls)
    near_10, far_10 = _line(f, pulls + 1), _line(f, pulls + 2)
    near_01, far_01 = _line(f, pulls + 3), _line(f, pulls + 4)
    near_11, far_11 = _line(f, pulls + 5), _line(f, pulls + 6)
    past = _GROUP * _groups(count)
    for x in range(past):
        both, across = pull[x] - pull[x + 1], near_11[x + 1] + far_11[x]
        even, uneven = both + across, both - across
        along_planes, along_rows = near_10[x + 1] + far_10[x], near_01[x + 1] + far_01[x]
        odd, apart = along_planes + along_rows, along_planes - along_rows
        force[x] = ((even - odd) + row[x]) + plane[x]
        plane[x] = (uneven + apart) + corner[x]
        row[x] = uneven - apart
        corner[x] = even + odd
    # Elements beyond the block are void, so they pass no forces on.
    for x in range(count, past):
        plane[x] = row[x] = corner[x] = 0


@callee
def block_forces(d, of_d, lame, of_lame, share, c, z, y, begin, count, f, rows, planes):
    """Compute the stiffness matrix times d at `count` sites of a line; see `force_of`.

    Parameters
    ----------
    d : ndarray, shape (3, N)
        Displacement.
    lame : ndarray, shape (1 or 2, M)
        Parameter mu of each element, followed by lambda unless lambda is `share` times mu
        everywhere.
    of_d, of_lame : ndarray, shape (D + 4, H + 4)
        Index of column 0 of each padded row in `d` and `lame` (`layout`).
    share : float
        Ratio lambda / mu, or 1 if `lame` contains lambda.
    c : ndarray
        Result of `constants`.
    z, y, begin, count : int
        Plane, row, first site and number of sites of the block, in the padded arrays.
    f : ndarray
        Scratch memory.
    rows : ndarray, shape (2, 3, W + 4 + 8)
        Forces of the previous row's elements on this row, in this plane and in the next plane.
    planes : ndarray, shape (3, H + 4, W + 4 + 8)
        Forces of the previous plane's elements on this plane.
    """
    if len(f) < _LINES * _LINE:
        return  # never reached, but it lets the compiler assume that all lines exist
    first = begin - 1
    for k in range(3):
        near, right = d[k, of_d[z, y] + first :], d[k, of_d[z, y + 1] + first :]
        far, across = d[k, of_d[z + 1, y] + first :], d[k, of_d[z + 1, y + 1] + first :]
        _faces((near, right, far, across), k, f, _groups(count + 2))
    at = of_lame[z, y] + first
    _elements(lame[0, at:], lame[len(lame) - 1, at:], share, c, f, _groups(count + 1))
    for k in range(3):
        row, corner, plane = rows[0, k, begin:], rows[1, k, begin:], planes[k, y, begin:]
        _gather(f, k, row, corner, plane, count)


@inline
def force_of(f, k):
    """Return the forces of component k, starting at the first site of the block."""
    return f[(_FORCES + k) * _LINE : (_FORCES + k + 1) * _LINE]


@shared
def scratch(d, height, width):
    """Return one thread's scratch memory: lines, and forces for the next row and plane.

    `height` and `width` are those of a padded plane.
    """
    lines = np.zeros(_LINES * _LINE, dtype=d.dtype)
    rows = np.zeros((2, 3, width + _GROUP), dtype=d.dtype)
    planes = np.zeros((3, height, width + _GROUP), dtype=d.dtype)
    return lines, rows, planes
