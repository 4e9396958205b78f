"""Contact of sliding parts in large motion, which follows the deformed interface.

At rest, a site X at an interface coincides with its copy in the field of the other part. In large
motion, the parts slide by many pixels, and X moves to x = X + d_first(X), where the other part has
another point Y:

    Y + d_second(Y) = x

Two parts neither separate nor overlap if X and Y are as far from the interface at rest. The energy
of the contact is

    U_contact = sum over sites of  k h(Y),    h = 1/2 p(Y) (level(Y) - level(X))^2

where the level is the signed distance from the interface at rest and p is its presence, which
decreases from 1 to 0 beyond its end (`interface_level`). The field d_second of the other part is
smooth (`smooth_fields`); F is its deformation gradient at Y. For changes e of the fields,

    z = e_first(X) - e_second(Y)
    dY = F^-1 z
    dh = f . z,    f = F^-T grad h
    ddh = dY . (grad grad h - f . grad grad d_second) dY - 2 f . (grad e_second) dY

The forces k f act along the normal of the deformed surface, on both parts at the same place and in
opposite directions: there is no friction and no moment.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.solver.coupling import Coupling
from napari_hmrf.solver.data_term import packed_axes
from napari_hmrf.solver.interface_level import Interface, Levels
from napari_hmrf.solver.smooth_fields import SmoothFields, Splines

Float64Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]
Matrix: TypeAlias = scipy.sparse.csr_array

#: Distance, in the largest side of a pixel, up to which points of an interface determine its level.
_REACH = 3.0
#: Distance from an interface up to which levels are known, in the same unit.
_DEPTH = {2: 8.0, 3: 4.0}
#: Largest gap, in the largest side of a pixel. With larger gaps, parts would lose each other.
_WIDEST = 1.5
#: Largest step of the search for Y, in pixels, distance from Y at which it ends, and its largest
#: number of steps.
_STRIDE, _FOUND, _MOST_STEPS = 0.7, 1e-11, 60
#: Smallest determinant of a deformation gradient.
_FLAT = 1e-3


class _Potential(NamedTuple):
    """Energies of the sites, per strength, and their derivatives by Y.

    Attributes
    ----------
    values, slopes, seconds : ndarray, shape (n,), (n, axes), (n, axes, axes)
        h, grad h and grad grad h.
    presence, normals : ndarray, shape (n,), (n, axes)
        p and grad level: the main part of ``grad grad h`` is ``p normal normal^T``.
    ends : ndarray, shape (n,)
        Values that are added to the diagonal of this part at the end of an interface. There, p
        pushes a site along the interface until its gap is closed.
    """

    values: Float64Array
    slopes: Float64Array
    seconds: Float64Array
    presence: Float64Array
    normals: Float64Array
    ends: Float64Array

    @classmethod
    def of(cls, levels: Levels, at_rest: Float64Array, side: float) -> _Potential:
        """Return the energies for the levels of Y and of X."""
        gaps, presence, normals = levels.values - at_rest, levels.presence, levels.slopes
        slopes = (presence * gaps)[:, None] * normals
        slopes += (gaps**2 / 2)[:, None] * levels.presence_slopes
        mixed = gaps[:, None, None] * levels.presence_slopes[:, :, None] * normals[:, None]
        seconds = presence[:, None, None] * normals[:, :, None] * normals[:, None]
        seconds += (presence * gaps)[:, None, None] * levels.curvatures
        seconds += mixed + mixed.swapaxes(1, 2)
        seconds += (gaps**2 / 2)[:, None, None] * levels.presence_curvatures
        ends = np.where((presence > 0) & (presence < 1), (gaps / side) ** 2, 0.0)
        values = np.where(np.abs(gaps) > _WIDEST * side, math.inf, presence * gaps**2 / 2)
        values[presence == 0] = 0
        return cls(values, slopes, seconds, presence, normals, ends)


class _Touch(NamedTuple):
    """Points Y at a displacement of the sites, and the energies there.

    Attributes
    ----------
    moved : ndarray, shape (s, axes)
        Displacement of the sites.
    spline, gradients, of_nodes : Splines, ndarray, ndarray
        Splines at Y, F, and the displacements of the nodes of the splines.
    potential : _Potential
    touches : ndarray of bool, shape (n,)
        False for a site that touches nothing.
    energies : ndarray, shape (n,)
        h of each site; infinite if parts overlap or separate too far.
    """

    moved: Float64Array
    spline: Splines
    gradients: Float64Array
    of_nodes: Float64Array
    potential: _Potential
    touches: npt.NDArray[np.bool_]
    energies: Float64Array


class _State(NamedTuple):
    """Contact at a displacement of its sites; all derivatives are per strength.

    Attributes
    ----------
    moved : ndarray, shape (s, axes)
    forces : ndarray, shape (n, axes)
        f of each site.
    seconds : ndarray, shape (n, axes, axes)
        Second derivatives by z, without those of the gradient of e_second.
    normals, ends : ndarray, shape (n, axes) and (n,)
        Definite part of the second derivatives: ``normal normal^T``, plus a value on the diagonal.
    inverses : ndarray, shape (n, axes, axes)
        F^-1.
    first, second : csr_array, shape (n, s)
        Components of e_first(X) and e_second(Y) by those of the sites; 0 for a site that touches
        nothing.
    slopes : list of csr_array, shape (n, s)
        Gradient of e_second along each axis.
    """

    moved: Float64Array
    forces: Float64Array
    seconds: Float64Array
    normals: Float64Array
    ends: Float64Array
    inverses: Float64Array
    first: Matrix
    second: Matrix
    slopes: list[Matrix]

    @property
    def definite(self) -> Float64Array:
        """Definite part of the second derivatives, shape (n, axes, axes)."""
        diagonal = self.ends[:, None, None] * np.eye(self.normals.shape[1])
        return self.normals[:, :, None] * self.normals[:, None] + diagonal


class _Linear(NamedTuple):
    """Second derivatives of the energy.

    Attributes
    ----------
    state : _State
    relative : csr_array, shape (n, s)
        Components of z by those of the sites.
    own : ndarray, shape (n, axes, axes)
        Second derivatives by z.
    turns : ndarray, shape (n, axes, axes, axes), or None
        Negative second derivatives by a slope of e_second along each axis (the second index) and
        by z; the third index is the component of z, the last that of e_second.
    tensors : ndarray, shape (t, s)
        Packed tensors of the sites; see `Contact.tensors`.
    """

    state: _State
    relative: Matrix
    own: Float64Array
    turns: Float64Array | None
    tensors: Float64Array


class Contact:
    """Contact of the parts of an unfolded grid; all lengths are in pixels.

    Parameters
    ----------
    coupling : Coupling
        Pairs of sites and copies, with the normals at rest.
    m : ndarray, shape of the unfolded grid
        Stiffness.
    sides : tuple of float
        Size of a pixel along each axis, in the solver's unit of length.
    unit : float
        Precision of 1 in the units of the model.
    """

    def __init__(
        self,
        coupling: Coupling,
        m: npt.NDArray[np.float32],
        sides: tuple[float, ...],
        unit: float,
    ) -> None:
        grid = coupling.own.shape
        self._axes, self._grid = len(grid), grid
        self._fields = SmoothFields(coupling, m, np.array(sides))
        #: Indices, in the flattened unfolded grid, of all sites that may be in contact.
        self._sites = self._fields.sites
        self._first = self._fields.place[coupling.first]
        self._rest = self._fields.positions[self._first]
        self._strength = coupling.strength / unit
        first = self._fields.part[self._first]
        self._second = self._fields.part[self._fields.place[coupling.second]]
        inside = tuple(index + 2 for index in np.unravel_index(self._sites, grid))
        self._planes = np.ravel_multi_index(inside, tuple(size + 4 for size in grid))
        low, high = np.minimum(first, self._second), np.maximum(first, self._second)
        pairs, of_pair = np.unique(np.stack([low, high], axis=1), axis=0, return_inverse=True)
        self._interface = of_pair.ravel()
        points = self._rest - coupling.distances[:, None] * coupling.normals
        self._side = max(sides)
        reach = _REACH * self._side, _DEPTH[self._axes] * self._side
        members = (self._interface == number for number in range(len(pairs)))
        self._interfaces = [
            Interface(points[some], coupling.normals[some], *reach) for some in members
        ]
        self._levels = self._levels_at(self._rest).values
        self._last: _Touch | None = None
        self._state: _State | None = None
        self._linear: _Linear

    def _levels_at(self, at: Float64Array) -> Levels:
        """Return the levels of a point for each pair."""
        found = Levels.absent(*at.shape)
        for number, interface in enumerate(self._interfaces):
            some = self._interface == number
            for total, each in zip(found, interface.levels(at[some]), strict=True):
                total[some] = each
        return found

    def _touch(self, d: npt.NDArray[np.floating]) -> _Touch:
        """Return the points Y at a displacement, given as planes."""
        moved = d.reshape(self._axes, -1)[:, self._planes].T.astype(np.float64)
        if self._last is None or not np.array_equal(self._last.moved, moved):
            self._last = self._touch_at(moved)
        return self._last

    def _at(self, d: npt.NDArray[np.floating]) -> _State:
        """Return the contact at a displacement, given as planes."""
        touch = self._touch(d)
        if self._state is None or not np.array_equal(self._state.moved, touch.moved):
            self._state = self._state_of(touch)
        return self._state

    def _touched(
        self, nodes: Float64Array, moved: Float64Array
    ) -> tuple[Float64Array, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Return the points Y, and masks of those that were not found.

        The first mask is that of points beyond the fields that are known, for which the last point
        on the way to Y is returned. The second is that of points where the search did not end,
        because a field is folded, as it may be beyond a sharp corner of a part.

        Parameters
        ----------
        nodes, moved : ndarray, shape (nodes, axes) and (s, axes)
            Displacement of the nodes of the fields, and of the sites.
        """
        fields, part = self._fields, self._second
        goal, deformed = self._rest + moved[self._first], fields.positions + moved
        at = np.zeros_like(goal)
        for number in np.unique(part):
            some, sites = part == number, np.flatnonzero(fields.part == number)
            nearest = scipy.spatial.cKDTree(deformed[sites]).query(goal[some])[1]
            at[some] = fields.positions[sites[nearest]]
        is_lost, todo = np.zeros(len(at), np.bool_), np.arange(len(at))
        for _ in range(_MOST_STEPS):
            spline, gradient, of_nodes = self._deformation(at[todo], part[todo], nodes)
            off = goal[todo] - at[todo] - np.einsum("nc,nca->na", spline.shares, of_nodes)
            way = np.linalg.solve(_regular(gradient), off[..., None])[..., 0]
            size = np.linalg.norm(way, axis=1, keepdims=True)
            way *= np.minimum(1, _STRIDE / np.maximum(size, _STRIDE))
            there = at[todo] + way
            stays = fields.knows(there, part[todo])
            at[todo[stays]] = there[stays]
            is_lost[todo[~stays]] = True
            todo = todo[stays & (size[:, 0] > _FOUND)]
        is_folded = np.zeros(len(at), np.bool_)
        is_folded[todo] = True
        return at, is_lost, is_folded

    def _deformation(
        self, at: Float64Array, part: Indices, nodes: Float64Array
    ) -> tuple[Splines, Float64Array, Float64Array]:
        """Return splines, deformation gradients, and displacements of the nodes of the splines."""
        spline = self._fields.splines(at, part)
        of_nodes = nodes[spline.nodes]
        gradient = np.eye(self._axes) + np.einsum("ncb,nca->nab", spline.slopes, of_nodes)
        return spline, gradient, of_nodes

    def _touch_at(self, moved: Float64Array) -> _Touch:
        nodes = self._fields.nodes @ moved
        at, is_lost, is_folded = self._touched(nodes, moved)
        spline, gradients, of_nodes = self._deformation(at, self._second, nodes)
        h = _Potential.of(self._levels_at(at), self._levels, self._side)
        is_folded |= np.linalg.det(gradients) < _FLAT
        touches = (h.presence > 0) & ~is_folded
        # Parts that separate too far, and a point in the tissue of the other part, far from its
        # interface, where the parts overlap.
        is_wrong = np.where(touches, is_lost, spline.inner)
        energies = np.where(is_wrong, math.inf, np.where(touches, h.values, 0.0))
        return _Touch(moved, spline, gradients, of_nodes, h, touches, energies)

    def _state_of(self, touch: _Touch) -> _State:
        moved, spline, gradients, of_nodes, h, touches, _ = touch
        inverse = np.asarray(np.linalg.inv(_regular(gradients)), np.float64)
        across = inverse.swapaxes(1, 2)
        forces = np.einsum("nab,nb->na", across, h.slopes)
        bends = np.einsum("ncjk,nci,ni->njk", spline.curvatures, of_nodes, forces)
        normals = np.einsum("nab,nb->na", across, np.sqrt(h.presence)[:, None] * h.normals)
        count, corners = spline.nodes.shape
        rows, counts = np.repeat(np.arange(count), corners), touches.astype(np.float64)
        shape = count, self._fields.nodes.shape[0]

        def matrix(values: Float64Array) -> Matrix:
            entries = (values * counts[:, None]).ravel(), (rows, spline.nodes.ravel())
            return Matrix(Matrix(entries, shape=shape) @ self._fields.nodes)

        return _State(
            moved,
            forces,
            across @ (h.seconds - bends) @ inverse,
            normals,
            h.ends,
            inverse,
            Matrix((counts, (np.arange(count), self._first)), shape=(count, len(moved))),
            matrix(spline.shares),
            [matrix(spline.slopes[..., axis]) for axis in range(self._axes)],
        )

    def energy(self, d: npt.NDArray[np.floating]) -> float:
        """Return the energy at a displacement, given as planes; infinite if parts lose contact."""
        return float((self._strength * self._touch(d).energies).sum())

    def add_forces(self, d: npt.NDArray[np.floating], out: npt.NDArray[np.floating]) -> None:
        """Add the gradient of the energy at a displacement to planes, in place."""
        state = self._at(d)
        pulls = self._strength[:, None] * state.forces
        self._add((state.first.T @ pulls - state.second.T @ pulls).T, out)

    def _add(self, values: Float64Array, out: npt.NDArray[np.floating]) -> None:
        """Add values of the sites, shape (axes, s), to planes, in place."""
        out.reshape(self._axes, -1)[:, self._planes] += values.astype(out.dtype)

    def linearise(self, d: npt.NDArray[np.floating], positive: float = 0.0) -> None:
        """Compute the second derivatives of the energy, for `tensors`, `add_image` and `rows`.

        Parameters
        ----------
        d : ndarray, planes
        positive : float
            Fraction of the indefinite terms to leave out.
        """
        state, axes = self._at(d), self._axes
        strength = self._strength[:, None, None]
        definite = strength * state.definite
        own = positive * definite + (1 - positive) * strength * state.seconds
        turns = None
        if positive < 1:
            turns = (1 - positive) * strength[..., None] * state.inverses[..., None]
            turns = turns * state.forces[:, None, None, :]
        # |sum_c s_c e_c|^2 <= sum_c |s_c| sum_c |s_c| |e_c|^2
        shares = abs(state.second)
        amounts = state.first + shares.multiply(shares.sum(axis=1)[:, None])
        tensors = np.stack([amounts.T @ definite[:, i, j] for i, j in packed_axes(axes)])
        self._linear = _Linear(state, Matrix(state.first - state.second), own, turns, tensors)

    def rows(self) -> Matrix:
        """Return G of the definite part G^T G of the second derivatives, by all components."""
        state, relative, *_ = self._linear
        root, ends = np.sqrt(self._strength), np.flatnonzero(state.ends)
        along = (root * np.sqrt(state.ends))[ends, None]
        at_ends = Matrix(relative[ends])
        rows = [self._rows_along(relative, root[:, None] * state.normals)]
        rows += [self._rows_along(at_ends, along * axis) for axis in np.eye(self._axes)]
        return Matrix(scipy.sparse.vstack(rows))

    def _rows_along(self, relative: Matrix, ways: Float64Array) -> Matrix:
        """Return the component of z along the way of each pair, by all components."""
        found, axes = relative.tocoo(), self._axes
        pairs, sites = found.coords
        values = found.data[:, None] * ways[pairs]
        columns = self._sites[sites][:, None] * axes + np.arange(axes)
        shape = len(ways), math.prod(self._grid) * axes
        return Matrix((values.ravel(), (np.repeat(pairs, axes), columns.ravel())), shape=shape)

    def tensors(self) -> Float64Array:
        """Return packed tensors at each site that bound the energy of each field alone.

        The second derivatives of the energy are these tensors plus what `add_image` applies.
        """
        made = np.zeros((len(self._linear.tensors), math.prod(self._grid)))
        made[:, self._sites] = self._linear.tensors
        return made.reshape(-1, *self._grid)

    def add_image(
        self, d: npt.NDArray[np.floating], out: npt.NDArray[np.floating], scale: float
    ) -> None:
        """Add the image of `d` by the second derivatives, less `tensors`, to planes, in place."""
        state, relative, own, turns, tensors = self._linear
        local = d.reshape(self._axes, -1)[:, self._planes].T.astype(np.float64)
        z = relative @ local
        along = np.einsum("nij,nj->ni", own, z)
        total = np.zeros_like(local)
        if turns is not None:
            for axis, slopes in enumerate(state.slopes):
                along -= np.einsum("nij,nj->ni", turns[:, axis], slopes @ local)
                total -= slopes.T @ np.einsum("nij,ni->nj", turns[:, axis], z)
        total += relative.T @ along
        for values, (i, j) in zip(tensors, packed_axes(self._axes), strict=True):
            total[:, i] -= values * local[:, j]
            if i != j:
                total[:, j] -= values * local[:, i]
        self._add(scale * total.T, out)

    def lumped(self) -> Matrix:
        """Return `tensors` as a matrix, with a row for each component of the unfolded grid."""
        return self._on_grid(scipy.sparse.block_array(self._lumped_blocks()))

    def _lumped_blocks(self) -> list[list[Matrix | None]]:
        axes = self._axes
        blocks: list[list[Matrix | None]] = [[None] * axes for _ in range(axes)]
        for values, (i, j) in zip(self._linear.tensors, packed_axes(axes), strict=True):
            blocks[i][j] = blocks[j][i] = Matrix(scipy.sparse.diags_array(values))
        return blocks

    def matrix(self) -> Matrix:
        """Return the matrix of `add_image`, with a row for each component of the unfolded grid."""
        state, relative, own, turns, _ = self._linear
        across, blocks = Matrix(relative.T), self._lumped_blocks()
        for i, j in packed_axes(self._axes):
            block = across @ (own[:, i, j, None] * relative) - blocks[i][j]
            if turns is not None:
                for axis, slopes in enumerate(state.slopes):
                    block = block - across @ (turns[:, axis, i, j, None] * slopes)
                    block = block - slopes.T @ (turns[:, axis, j, i, None] * relative)
            blocks[i][j], blocks[j][i] = Matrix(block), Matrix(block.T)
        return self._on_grid(scipy.sparse.block_array(blocks))

    def _on_grid(self, matrix: Any) -> Matrix:
        """Return a matrix of the components of the sites with those of the unfolded grid."""
        found, size = scipy.sparse.coo_array(matrix), len(self._sites)
        rows, columns = (self._sites[at % size] * self._axes + at // size for at in found.coords)
        total = math.prod(self._grid) * self._axes
        return Matrix((found.data, (rows, columns)), shape=(total, total))


def _regular(gradients: Float64Array) -> Float64Array:
    """Return deformation gradients, of which nearly singular ones are replaced by the identity."""
    is_flat = np.abs(np.linalg.det(gradients)) < _FLAT
    return np.where(is_flat[:, None, None], np.eye(gradients.shape[1]), gradients)
