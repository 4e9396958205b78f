"""Fields of parts near their interfaces, with continuous deformation gradients.

The field of a part at a point is a quadratic B-spline of the displacements of the 3^axes nearest
sites. It reproduces affine displacements. Sites beyond its edge are extrapolated from the nearest
sites of the part, at distances r from r_0, by an affine fit with the weights

    (1 - (r / (r_0 + r_1))^2)^2

with r_1 = 4 pixels in images and 2 voxels in volumes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.solver.coupling import Coupling

Float64Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

#: Distance from an interface up to which the field is known, on both sides, and distance beyond the
#: edge of a part, in the largest side of a pixel.
_REACH, _BEYOND = {2: 12, 3: 6}, 2
#: Sites that determine an extrapolated site: those up to this much farther away than the nearest,
#: in the largest side of a pixel, and their largest number.
_FARTHER, _MOST = {2: 4.0, 3: 2.0}, {2: 80, 3: 160}
#: Weight that keeps a slope 0 along which no site is known.
_REGULAR = 1e-9


class Splines(NamedTuple):
    """Points in the fields of parts.

    Attributes
    ----------
    nodes : ndarray of int, shape (n, c)
        Nodes near each point, as rows of `SmoothFields.nodes`.
    shares : ndarray, shape (n, c)
        Share of each node in the displacement of the point.
    slopes : ndarray, shape (n, c, axes)
        Gradients of the shares.
    curvatures : ndarray, shape (n, c, axes, axes)
        Second derivatives of the shares.
    inner : ndarray of bool, shape (n,)
        True for points inside the part, whose field is that of its own sites only.
    """

    nodes: Indices
    shares: Float64Array
    slopes: Float64Array
    curvatures: Float64Array
    inner: npt.NDArray[np.bool_]


class SmoothFields:
    """Smooth fields of all parts of an unfolded grid, near their interfaces.

    Parameters
    ----------
    coupling : Coupling
    m : ndarray, shape of the unfolded grid
        Stiffness.
    sides : ndarray, shape (axes,)
        Size of a pixel along each axis.

    Attributes
    ----------
    sites : ndarray of int, shape (s,)
        Indices, in the flattened unfolded grid, of the sites that determine the fields.
    place : ndarray of int, shape (sites of the unfolded grid,)
        Index of each site in `sites`, or -1.
    positions : ndarray, shape (s, axes)
        Positions of these sites in the image.
    part : ndarray of int, shape (s,)
        Part of each site.
    nodes : csr_array, shape (nodes, s)
        Displacement of each node by those of the sites.
    """

    def __init__(self, coupling: Coupling, m: npt.NDArray[np.float32], sides: Float64Array) -> None:
        grid, axes = coupling.own.shape, coupling.own.ndim
        self._sides = sides
        self._offsets = np.array(list(np.ndindex(*(3,) * axes))) - 1
        ratio = sides.max() / sides
        beyond = (np.ceil(_BEYOND * ratio) + 1).astype(np.intp)
        margin = [(int(count), int(count)) for count in beyond]
        outer = tuple(2 * beyond + 1)
        strip = tuple(2 * np.ceil(_REACH[axes] * ratio).astype(np.intp) + 1)
        touching = np.zeros(grid, np.bool_)
        touching.ravel()[coupling.first] = touching.ravel()[coupling.second] = True
        every = np.arange(coupling.own.size).reshape(grid)
        sites: list[Indices] = []
        positions: list[Float64Array] = []
        parts: list[Indices] = []
        blocks: list[scipy.sparse.csr_array] = []
        numbers: list[Indices] = []
        lows: list[Indices] = []
        inner: list[npt.NDArray[np.bool_]] = []
        count = 0
        for number, box in enumerate(coupling.boxes):
            has = np.pad(sites_of_elements(m[box.unfolded]), margin)
            near = np.pad(touching[box.unfolded], margin)
            near = scipy.ndimage.maximum_filter(near, strip, mode="constant")
            near &= scipy.ndimage.maximum_filter(has, outer, mode="constant")
            low = np.array([side.start for side in box.image]) - beyond
            is_site = (has & near)[near]
            at = np.argwhere(near)
            own = at[is_site]
            index = np.full(near.shape, -1)
            index[near] = count + np.arange(len(at))
            sites.append(every[box.unfolded][tuple((own - beyond).T)])
            positions.append((own + low) * sides)
            parts.append(np.full(len(own), number))
            blocks.append(_extrapolated(at * sides, is_site, float(sides.max())))
            numbers.append(index.ravel())
            lows.append(low)
            owned = np.zeros(len(at), np.bool_)
            owned[is_site] = coupling.own[box.unfolded][tuple((own - beyond).T)]
            inner.append(owned)
            count += len(at)
        self.sites, self.positions = np.concatenate(sites), np.concatenate(positions)
        self.part, self._low = np.concatenate(parts), np.array(lows)
        self._shapes = np.array(
            [[side.stop - side.start for side in box.image] for box in coupling.boxes]
        )
        self._shapes += 2 * beyond
        self._is_own = np.concatenate(inner)
        self._numbers = np.concatenate(numbers)
        self._starts = np.cumsum([0, *map(len, numbers[:-1])])
        self.place = np.full(coupling.own.size, -1)
        self.place[self.sites] = np.arange(len(self.sites))
        self.nodes = scipy.sparse.csr_array(scipy.sparse.block_diag(blocks, format="csr"))

    def _around(
        self, at: Float64Array, part: Indices
    ) -> tuple[Indices, Float64Array, npt.NDArray[np.bool_]]:
        """Return the nodes around positions, the distances from the middle one, and what is known.

        A node is -1 where the field is not known.
        """
        there = at / self._sides - self._low[part]
        middle = np.rint(there).astype(np.intp)
        shape = self._shapes[part]
        known = np.all((middle >= 1) & (middle < shape - 1), axis=1)
        around = np.where(known[:, None], middle, 1)[:, None] + self._offsets
        flat = np.zeros(around.shape[:2], np.intp)
        for axis in range(at.shape[1]):
            flat = flat * shape[:, axis, None] + around[..., axis]
        nodes = self._numbers[self._starts[part][:, None] + flat]
        known &= (nodes >= 0).all(axis=1)
        return nodes, np.where(known[:, None], there - middle, 0.0), known

    def knows(self, at: Float64Array, part: Indices) -> npt.NDArray[np.bool_]:
        """Return whether the fields of given parts are known at positions in the image."""
        return self._around(at, part)[2]

    def splines(self, at: Float64Array, part: Indices) -> Splines:
        """Return the splines at positions in the image, in the fields of given parts."""
        count, axes = at.shape
        nodes, t, _ = self._around(at, part)
        # Deep inside a part, some nodes are beyond the strip that is known.
        is_own = (nodes >= 0) & self._is_own[nodes]
        inner = np.asarray(is_own.any(axis=1) & (is_own | (nodes < 0)).all(axis=1))
        nodes = np.maximum(nodes, 0)
        # Values, slopes and curvatures of the shares along each axis: (n, 3, axes).
        single = [
            np.stack([(0.5 - t) ** 2 / 2, 0.75 - t**2, (0.5 + t) ** 2 / 2], axis=1),
            np.stack([t - 0.5, -2 * t, t + 0.5], axis=1) / self._sides,
            np.broadcast_to(np.array([1.0, -2.0, 1.0])[:, None], (count, 3, axes)) / self._sides**2,
        ]
        pick = self._offsets + 1

        def product(orders: tuple[int, ...]) -> Float64Array:
            made = np.ones((count, len(pick)))
            for axis, order in enumerate(orders):
                made *= single[order][:, pick[:, axis], axis]
            return made

        unit = np.eye(axes, dtype=int)
        slopes = np.stack([product(tuple(unit[i])) for i in range(axes)], axis=-1)
        curvatures = np.stack(
            [
                np.stack([product(tuple(unit[i] + unit[j])) for j in range(axes)], axis=-1)
                for i in range(axes)
            ],
            axis=-1,
        )
        return Splines(nodes, product((0,) * axes), slopes, curvatures, inner)


def _extrapolated(at: Float64Array, is_site: npt.NDArray[np.bool_], side: float) -> Any:
    """Return the displacement of the nodes of a part by those of its sites.

    Parameters
    ----------
    at : ndarray, shape (nodes, axes)
        Positions of the nodes.
    is_site : ndarray of bool, shape (nodes,)
        True for a site of the part, False for a site that is extrapolated.
    side : float
        Largest side of a pixel.
    """
    own, others = np.flatnonzero(is_site), np.flatnonzero(~is_site)
    axes = at.shape[1]
    if not len(own):
        return scipy.sparse.csr_array((len(at), 0))
    near = min(_MOST[axes], len(own))
    far, of = scipy.spatial.cKDTree(at[own]).query(at[others], k=np.arange(1, near + 1))
    reach = far[:, :1] + _FARTHER[axes] * side
    weights = np.maximum(1 - (far / reach) ** 2, 0) ** 2
    away = at[own][of] - at[others][:, None]
    terms = np.concatenate([np.ones((*far.shape, 1)), away], axis=-1)
    weighted = (terms * weights[..., None]).swapaxes(1, 2)
    matrix = weighted @ terms
    slopes = np.arange(1, axes + 1)
    matrix[:, slopes, slopes] += _REGULAR * matrix[:, :1, 0]
    first = np.zeros((len(others), axes + 1, 1))
    first[:, 0] = 1
    shares = (np.linalg.solve(matrix, first).swapaxes(1, 2) @ weighted)[:, 0]
    rows = np.concatenate([own, np.repeat(others, near)])
    columns = np.concatenate([np.arange(len(own)), of.ravel()])
    values = np.concatenate([np.ones(len(own)), shares.ravel()])
    made = scipy.sparse.csr_array((values, (rows, columns)), shape=(len(at), len(own)))
    made.eliminate_zeros()
    return made
