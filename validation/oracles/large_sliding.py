"""Large motion of parts that slide along each other, by Newton's method with loops of its own.

Each part has a displacement of its own at all sites, and its elements are those of `large_motion`.
The energy of the contact is computed from its definition in `napari_hmrf.solver.contact`, of which
the constants and the fitted surface of an interface are taken from the package. All derivatives of
the level, of its presence, and of the map of a part are central differences. The contact has an
approximate second derivative only, along the normal: a step must decrease the total energy.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.ndimage as ndi
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from napari_hmrf import NeoHookeanPrior, Problem
from napari_hmrf.loads import Loads
from napari_hmrf.solver.contact import _DEPTH, _REACH, _WIDEST
from napari_hmrf.solver.interface_level import _ABSENT, _ALIKE, _PRESENT, _WIDTH
from napari_hmrf.solver.interface_normals import interface_surface
from napari_hmrf.solver.problem import variant_of
from napari_hmrf.solver.smooth_fields import _BEYOND, _FARTHER
from validation.oracles.elasticity import at_corners
from validation.oracles.large_motion import (
    _BARRIER,
    _BEGIN,
    _derivatives,
    _Tissue,
    displaced_corners,
    slopes_at,
    smallest_jacobians,
)
from validation.oracles.parts import _at_points, _extended
from validation.oracles.posterior import data_matrix

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Sites = npt.NDArray[np.intp]

# Stiffness of copies, relative to the softest tissue: almost nothing.
_COPIES = 1e-9
# Step of central differences, in pixels.
_TINY = 1e-5
# Largest step of the search for a point, in pixels, its largest number of steps, and the distance
# at which it ends.
_STRIDE, _SEARCHES, _FOUND = 0.5, 100, 1e-11
# Largest step of the last increment and of the others at which an iteration ends, in pixels, and
# its largest number of steps.
_LAST, _OTHERS, _MOST_STEPS = 1e-6, 1e-2, 200
# Number of sites beyond the edge of a part that are extrapolated, in square pixels.
_LAYERS = _BEYOND + 1
# Smallest fraction of a step, and rounding error of an energy, relative to the sum of its parts.
_SHORTEST, _ROUNDING = 1e-6, 1e-13
# Fractions of the diagonal that are added until a step decreases the energy.
_SHIFTS = 0.0, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0


class NotSettledError(RuntimeError):
    """Newton's method has not settled."""


class _Surface(NamedTuple):
    """Points of an interface and their normals; lengths are in pixels."""

    points: Array
    normals: Array
    reach: float
    depth: float

    def _weights(self, at: Array) -> tuple[Array, Array]:
        """Return the weights and heights of positions at each point of the surface."""
        away = at[:, None] - self.points
        heights, far = (away * self.normals).sum(axis=-1), np.linalg.norm(away, axis=-1)
        along = np.linalg.norm(away - heights[..., None] * self.normals, axis=-1)
        q = np.minimum(along / self.reach, 1)
        nearest = self.normals[far.argmin(axis=1)]
        weights = (1 - q) ** 4 * (4 * q + 1) * np.clip(_ALIKE * nearest @ self.normals.T, 0, 1)
        return np.where(far < np.hypot(self.reach, self.depth), weights, 0.0), heights

    def typical(self) -> float:
        """Return the sum of the weights at a typical point."""
        return float(np.median(self._weights(self.points)[0].sum(axis=1)))

    def levels(self, at: Array, typical: float) -> tuple[Array, Array]:
        """Return the level of each position, and the presence of the interface."""
        weights, heights = self._weights(at)
        total = weights.sum(axis=1)
        t = np.clip((total / typical - _ABSENT) / (_PRESENT - _ABSENT), 0, 1)
        squares = ((at[:, None] - self.points) ** 2).sum(axis=-1)
        nearer = squares - squares.min(axis=1, keepdims=True)
        weights = weights * np.exp(-nearer / (2 * (_WIDTH * self.reach) ** 2))
        level = (weights * heights).sum(axis=1) / np.where(t > 0, weights.sum(axis=1), np.inf)
        return level, t**3 * (10 - 15 * t + 6 * t**2)


class _Field:
    """Smooth field of a part, from the displacements of its sites; lengths are in pixels.

    Parameters
    ----------
    sites : ndarray of bool, shape (H, W) or (D, H, W)
    size : ndarray, shape (axes,)
        Size of a pixel along each axis.
    """

    def __init__(self, sites: Flags, size: Array) -> None:
        self.size, axes = size, len(size)
        self.around = np.array(list(itertools.product((-1, 0, 1), repeat=axes)))
        self.is_site = np.pad(sites, _LAYERS)
        self.known = ndi.binary_dilation(self.is_site, np.ones((3,) * axes), _LAYERS)
        self.own = np.argwhere(sites)
        flat = np.ravel_multi_index(tuple(self.own.T), sites.shape)
        self.extended = sp.lil_array((self.is_site.size, sites.size))
        for node in np.argwhere(self.known):
            away = (self.own + _LAYERS - node) * size
            far = np.linalg.norm(away, axis=1)
            weight = np.maximum(1 - (far / (far.min() + _FARTHER[axes] * size.max())) ** 2, 0)
            near = np.flatnonzero(weight if far.min() > 0 else far == 0)
            # The weights of the squares in the fit are those of the residuals, squared.
            terms = np.column_stack([np.ones(len(near)), away[near]]) * weight[near, None]
            row = int(np.ravel_multi_index(tuple(node), self.is_site.shape))
            self.extended[row, flat[near]] = np.linalg.pinv(terms)[0] * weight[near]
        self.extended = self.extended.tocsr()

    def nodes(self, at: Array) -> tuple[Sites, Array, Flags, Flags]:
        """Return nodes, their shares, whether all are known, and whether all are sites."""
        there = at / self.size + _LAYERS
        shape = np.array(self.is_site.shape)
        middle = np.rint(np.clip(there, 1, shape - 2)).astype(int)
        nodes = middle[:, None] + self.around
        t = np.abs(there[:, None] - nodes)
        splines = np.where(t < 0.5, 0.75 - t**2, np.maximum(1.5 - t, 0) ** 2 / 2)
        flat = np.ravel_multi_index(tuple(np.moveaxis(nodes, -1, 0)), self.is_site.shape)
        inside = np.all((there >= 0.5) & (there < shape - 1.5), axis=1)
        known = inside & self.known.ravel()[flat].all(axis=1)
        return flat, splines.prod(axis=-1), known, known & self.is_site.ravel()[flat].all(axis=1)

    def moved(self, at: Array, nodes: Array) -> Array:
        """Return the deformed positions, given the displacements of all nodes."""
        flat, shares, *_ = self.nodes(at)
        return at + np.einsum("nc,nca->na", shares, nodes[flat])

    def gradients(self, at: Array, nodes: Array) -> Array:
        """Return the deformation gradient at each position."""
        sides = np.eye(at.shape[1]) * _TINY
        rates = [self.moved(at + e, nodes) - self.moved(at - e, nodes) for e in sides]
        return np.stack(rates, axis=-1) / (2 * _TINY)

    def touched(self, goal: Array, d: Array, nodes: Array) -> tuple[Array, Flags]:
        """Return the points that move to `goal`, and whether they are in the known field."""
        rest = self.own * self.size
        deformed = rest + d[tuple(self.own.T)]
        at = rest[np.linalg.norm(goal[:, None] - deformed, axis=-1).argmin(axis=1)]
        todo, found = np.arange(len(at)), np.zeros(len(at), np.bool_)
        for _ in range(_SEARCHES):
            gradient = self.gradients(at[todo], nodes)
            gradient[np.abs(np.linalg.det(gradient)) < 1e-3] = np.eye(at.shape[1])
            off = goal[todo] - self.moved(at[todo], nodes)
            way = np.linalg.solve(gradient, off[..., None])[..., 0]
            length = np.linalg.norm(way, axis=1)
            there = at[todo] + way / np.maximum(length / _STRIDE, 1)[:, None]
            stays = self.nodes(there)[2]
            at[todo[stays]] = there[stays]
            found[todo[stays & (length < _FOUND)]] = True
            todo = todo[stays & (length >= _FOUND)]
            if not len(todo):
                break
        return at, found


class _Pairs(NamedTuple):
    """Sites of a part in contact with another part.

    `levels` are those of the sites, and `typical` is the typical weight of the surface.
    """

    home: int
    other: int
    sites: Sites
    strength: Array
    surface: _Surface
    typical: float
    levels: Array


class _Touch(NamedTuple):
    """Contact at a displacement, in pixels: its energy, its gradient and second derivatives."""

    energy: float
    forces: Array
    matrix: sp.csr_array


class _Bodies:
    """Fields of all parts, and their contact.

    Parameters
    ----------
    problem : Problem
    prior : NeoHookeanPrior
    """

    def __init__(self, problem: Problem, prior: NeoHookeanPrior) -> None:
        self.problem, self.prior = problem, prior
        m = problem.stiffness.astype(np.float64)
        self.grid, self.axes = m.shape, m.ndim
        assert problem.sliding is not None
        owner = np.full(m.shape, -1)
        owner[m > 0] = np.unique(problem.sliding.labels[m > 0], return_inverse=True)[1]
        self.owner, self.count = owner, int(owner.max()) + 1
        self.size = np.array(problem.spacing) / problem.unit
        real = at_corners(owner >= 0, self.axes).all(axis=0)
        self.exist = [
            real & at_corners(owner == part, self.axes).any(axis=0) for part in range(self.count)
        ]
        self.young = [self._young(part) for part in range(self.count)]
        self.sites = [_corner_sites(exist, m.shape) for exist in self.exist]
        self.fields = [_Field(sites, self.size) for sites in self.sites]
        self.pairs = self._pairs()

    def _young(self, part: int) -> Array:
        m = self.problem.stiffness.astype(np.float64)
        own = self.owner == part
        return np.where(own, m, np.where(self.owner >= 0, _COPIES * m[m > 0].min(), 0.0))

    def part(self, part: int, share: float) -> _Tissue:
        """Return the elements of a part with a share of its growth."""
        own = self.owner == part
        prior, loads = self.prior, self.problem.loads
        if np.ndim(prior.poisson):
            ratio = _extended(np.asarray(prior.poisson, np.float64), own)
            prior = NeoHookeanPrior(ratio.astype(np.float32), plane=prior.plane)
        if loads is not None and loads.growth is not None:
            loads = Loads(growth=_extended(loads.growth, own))
        stiffness = self.young[part].astype(np.float32)
        problem = variant_of(self.problem, stiffness=stiffness, loads=loads)
        return _Tissue.of(problem, prior, share, self.exist[part])

    def _pairs(self) -> list[_Pairs]:
        m, spacing = self.problem.stiffness.astype(np.float64), self.problem.spacing
        assert self.problem.sliding is not None
        scale = self.problem.sliding.strength * self.problem.unit ** (self.axes - 2)
        pairs, side = [], float(self.size.max())
        for one, two in itertools.combinations(range(self.count), 2):
            ways = (one, two), (two, one)
            groups = [np.argwhere(self.sites[other] & (self.owner == home)) for home, other in ways]
            at = np.concatenate(groups)
            if not len(at):
                continue
            normals, far = interface_surface(self.owner == one, self.owner == two, at, spacing)
            points = at * self.size - far[:, None] / self.problem.unit * normals
            surface = _Surface(points, normals, _REACH * side, _DEPTH[self.axes] * side)
            typical = surface.typical()
            for (home, other), sites in zip(ways, groups, strict=True):
                soft = np.zeros(len(sites))
                for number, site in enumerate(sites):
                    near = tuple(slice(max(i - 1, 0), i + 2) for i in site)
                    around, of = m[near], self.owner[near]
                    soft[number] = min(float(around[of == each].max()) for each in (one, two))
                levels = surface.levels(sites * self.size, typical)[0]
                pairs.append(_Pairs(home, other, sites, scale * soft, surface, typical, levels))
        return [each for each in pairs if len(each.sites)]

    def contact(self, d: Array) -> _Touch:
        """Return the contact; its energy is infinite if parts lose each other."""
        size, axes = self.owner.size, self.axes
        total, forces = 0.0, np.zeros(self.count * size * axes)
        matrix = sp.csr_array((len(forces), len(forces)))
        nodes = [
            field.extended @ each.reshape(size, axes)
            for field, each in zip(self.fields, d, strict=True)
        ]
        for pair in self.pairs:
            field, count = self.fields[pair.other], len(pair.sites)
            goal = pair.sites * self.size + d[pair.home][tuple(pair.sites.T)]
            at, found = field.touched(goal, d[pair.other], nodes[pair.other])
            gap, presence = self._gaps(pair, at)
            gradient = field.gradients(at, nodes[pair.other])
            flat, shares, _, inner = field.nodes(at)
            here = presence > 0
            lost = ~found | (np.linalg.det(gradient) < 1e-3)
            lost |= np.abs(gap) > _WIDEST * self.size.max()
            if np.any(np.where(here, lost, inner)):
                return _Touch(np.inf, forces, matrix)
            slopes, normals = np.zeros((2, count, axes))
            for axis, tiny in enumerate(np.eye(axes) * _TINY):
                (above, more), (below, less) = (self._gaps(pair, at + s * tiny) for s in (1, -1))
                slopes[:, axis] = (more * above**2 - less * below**2) / (4 * _TINY)
                normals[:, axis] = (above - below) / (2 * _TINY)
            gradient[~here] = np.eye(axes)
            across = np.linalg.inv(gradient).swapaxes(1, 2)
            force = (across @ slopes[..., None])[..., 0]
            normal = np.sqrt(presence)[:, None] * (across @ normals[..., None])[..., 0]
            ends = np.where(here & (presence < 1), (gap / self.size.max()) ** 2, 0.0)
            own = normal[:, :, None] * normal[:, None] + ends[:, None, None] * np.eye(axes)
            relative = self._relative(pair, flat, np.where(here[:, None], shares, 0.0), here)
            total += float(pair.strength @ (presence * gap**2 / 2))
            forces += relative.T @ (pair.strength[:, None] * force).ravel()
            steps = np.arange(count + 1)
            blocks = (pair.strength[:, None, None] * own, steps[:-1], steps)
            matrix = matrix + relative.T @ sp.bsr_array(blocks).tocsr() @ relative
        return _Touch(total, forces, sp.csr_array(matrix))

    def _gaps(self, pair: _Pairs, at: Array) -> tuple[Array, Array]:
        """Return the change of the level, and the presence, for each site of a group."""
        levels, presence = pair.surface.levels(at, pair.typical)
        return levels - pair.levels, presence

    def _relative(self, pair: _Pairs, flat: Sites, shares: Array, here: Flags) -> sp.csr_array:
        """Return the motion of each site relative to the point that it touches."""
        count, size = len(flat), self.owner.size
        rows = np.repeat(np.arange(count), flat.shape[1])
        field = self.fields[pair.other]
        shape = count, len(np.ravel(field.is_site))
        second = sp.csr_array((shares.ravel(), (rows, flat.ravel())), shape=shape) @ field.extended
        own = np.ravel_multi_index(tuple(pair.sites.T), self.grid)
        first = sp.csr_array((here.astype(float), (np.arange(count), own)), shape=(count, size))
        blocks: list[sp.csr_array] = [sp.csr_array((count, size)) for _ in range(self.count)]
        blocks[pair.home], blocks[pair.other] = first, -second
        return sp.csr_array(sp.kron(sp.hstack(blocks), sp.eye_array(self.axes)))


def _corner_sites(elements: Flags, shape: tuple[int, ...]) -> Flags:
    """Return the mask of the corners of elements."""
    sites = np.zeros(shape, np.bool_)
    for element in np.argwhere(elements):
        sites[tuple(slice(i, i + 2) for i in element)] = True
    return sites


def _stored(tissue: _Tissue, corners: Array) -> float:
    """Return the energy of elements whose corners are displaced, as in `large_motion`."""
    axes = len(tissue.spacing)
    gauss = tuple(itertools.product((0.5 - 12**-0.5, 0.5 + 12**-0.5), repeat=axes))

    def at(points: tuple[tuple[float, ...], ...]) -> tuple[Array, Array]:
        """Return |F|^2 and J at points."""
        slopes = slopes_at(points, tissue.spacing)
        gradient = np.eye(axes) + np.einsum("nck,pca->npka", corners, slopes)
        elastic = gradient @ tissue.undo[:, None]
        return (elastic**2).sum(axis=(2, 3)), np.linalg.det(elastic)

    squares, jacobian = at(gauss)
    shear, first = tissue.shear, tissue.first * tissue.thin**2
    if axes == 3:
        volume = jacobian.mean(axis=1)
        values = shear * (squares / 2 - np.log(jacobian)).mean(axis=1)
        values += first / 4 * volume**2 - first / 2 * np.log(volume)
        return float(tissue.amount @ values)
    stretch, area = (each[:, 0] for each in at(((0.5, 0.5),)))
    values = tissue.twist * squares.mean(axis=1) / 2 + (shear - tissue.twist) * stretch / 2
    whole, bulk = shear + tissue.first / 2, first * area**2 / 2
    if tissue.bulges:
        values += whole * (np.log(shear + bulk) / 2 - np.log(area))
    else:
        values += bulk / 2 - whole * np.log(area)
    least = np.minimum(at(tuple(itertools.product((0.0, 1.0), repeat=2)))[1], _BEGIN)
    values -= _BARRIER * shear * ((least - _BEGIN) ** 2 * np.log(least / _BEGIN)).mean(axis=1)
    return float(tissue.amount @ values)


def large_sliding_field(
    problem: Problem, prior: NeoHookeanPrior, parts: int = 6, start: Array | None = None
) -> Array:
    """Return the field of sliding parts in equilibrium, loaded in `parts` increments.

    Parameters
    ----------
    problem : Problem
        Tissue without rigid parts, with square pixels or cubic voxels of any size. All observed
        components are prescribed exactly.
    prior : NeoHookeanPrior
    parts : int
        Number of increments of the displacement, the observations, the growth and the forces.
    start : ndarray, shape (parts, H, W, 2) or (parts, D, H, W, 3), optional
        Fields of all parts from which the first increment begins; by default zero.

    Raises
    ------
    NotSettledError
        If the method does not settle.
    """
    bodies = _Bodies(problem, prior)
    axes, size, count = bodies.axes, problem.observed.size, bodies.count
    d = np.zeros((count, *problem.observed.shape)) if start is None else start.copy()
    number = np.arange(size).reshape(problem.observed.shape)
    nodes = [displaced_corners(number)[exist].astype(np.intp) for exist in bodies.exist]
    known = np.concatenate(
        [(problem.known & (bodies.owner == part)[..., None]).ravel() for part in range(count)]
    )
    used = np.concatenate([np.unique(each) + part * size for part, each in enumerate(nodes)])
    free = np.setdiff1d(used, np.flatnonzero(known))
    own = np.concatenate([(bodies.owner == part).repeat(axes) for part in range(count)]).astype(
        float
    )
    goal = np.tile(problem.observed.astype(np.float64).ravel(), count)
    data, pull = data_matrix(variant_of(problem, landmarks=None))
    data = sp.diags_array(own) @ sp.block_diag([data] * count) @ sp.diags_array(own)
    load = np.tile(pull, count) * own
    if problem.loads is not None and problem.loads.force is not None:
        load += np.tile(problem.loads.force.astype(np.float64).ravel(), count) * own
    if problem.landmarks is not None:
        marks = problem.landmarks
        weights = marks.scale.energy(problem.stiffness, problem.spacing) / marks.sd.ravel() ** 2
        at_points = _at_points(marks.points, bodies.owner, count)
        data = data + at_points.T @ sp.diags_array(weights) @ at_points
        load = load + at_points.T @ (weights * marks.displacement(problem.spacing).ravel())

    def energy(at: Array, share: float, touch: _Touch) -> tuple[float, float]:
        """Return the total energy, and the sum of the sizes of its parts."""
        if not np.isfinite(touch.energy) or _folds(bodies, at):
            return np.inf, 0.0
        parts_of = [problem.unit**2 * touch.energy, -share * float(load @ at.ravel())]
        parts_of.append(float(at.ravel() @ (data @ at.ravel())) / 2)
        parts_of += [
            _stored(bodies.part(each, share), at[each].ravel()[nodes[each]])
            for each in range(count)
        ]
        return sum(parts_of), sum(map(abs, parts_of))

    for part in range(1, parts + 1):
        share = part / parts
        tissues = [bodies.part(each, share) for each in range(count)]
        touch = bodies.contact(d / problem.unit)
        for turn in range(_MOST_STEPS):
            rest = share * load - data @ d.ravel() - problem.unit * touch.forces
            blocks = []
            for each, tissue in enumerate(tissues):
                pulls, tangents = _derivatives(tissue, d[each].ravel()[nodes[each]], False)
                rest[each * size : (each + 1) * size] -= np.bincount(
                    nodes[each].ravel(), pulls.ravel(), size
                )
                places = nodes[each].reshape(len(nodes[each]), -1)
                rows, columns = np.broadcast_arrays(places[:, :, None], places[:, None, :])
                at = rows.ravel(), columns.ravel()
                blocks.append(sp.csc_array((tangents.ravel(), at), shape=(size, size)))
            matrix = sp.csr_array(sp.block_diag(blocks, format="csr") + data + touch.matrix)
            fixed = np.where(known, share * goal - d.ravel(), 0.0)
            moves = np.abs(fixed).max() > 0
            now, rounding = energy(d, share, touch)
            for shift in _SHIFTS:
                inner = matrix[free][:, free]
                inner = inner + shift * sp.diags_array(abs(inner.diagonal()))
                step = fixed.copy()
                step[free] = spsolve(inner.tocsc(), (rest - matrix @ fixed)[free])
                if not moves and step @ rest < 0:
                    continue
                # Shorter steps in turn damp components along which full steps go too far.
                way, length = step.reshape(d.shape), 0.5 ** (turn % 3)
                most = np.inf if moves else now + _ROUNDING * rounding
                while length > _SHORTEST:
                    after = bodies.contact((d + length * way) / problem.unit)
                    if energy(d + length * way, share, after)[0] < most:
                        break
                    length /= 2
                if length > _SHORTEST:
                    break
            else:
                raise NotSettledError(f"part {part} of {parts} has no step of less energy")
            d, touch = d + length * way, after
            if length == 1 and np.abs(step).max() < problem.unit * (
                _LAST if part == parts else _OTHERS
            ):
                break
        else:
            raise NotSettledError(f"part {part} of {parts} has not settled")
    return np.take_along_axis(d, np.maximum(bodies.owner, 0)[None, ..., None], axis=0)[0]


def _folds(bodies: _Bodies, d: Array) -> bool:
    """Return whether an element of any part is folded."""
    for part, exist in enumerate(bodies.exist):
        corners = displaced_corners(d[part] / np.array(bodies.problem.spacing))[exist]
        if smallest_jacobians(corners, 2).min(initial=np.inf) <= 0:
            return True
    return False
