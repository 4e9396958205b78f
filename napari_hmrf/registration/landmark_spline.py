"""Smoothing spline of landmarks inside tissue."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import as_numbers, checked_spacing, first_index
from napari_hmrf.solver.uncertain_landmarks import Landmarks, corners_of

Float64Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.intp]

#: Number of elements of the coarse grid within tissue. More elements resolve finer motion.
_ELEMENTS = 1200
#: Lengths tau of the third derivatives, as fractions of the extent of tissue.
_LENGTHS = (0.0, 0.06, 0.125)
#: Smoothing parameters, relative to the median eigenvalue of the kernel.
_SMOOTHING = np.logspace(-7, 3, 61)
#: Stiffness of the spring of each site, times the fourth power of the extent of tissue. Separate
#: pieces of tissue may differ by an affine motion, because the springs are weak. The first is that
#: of a single piece, whose affine motion is free anyway.
_SPRINGS = (3e-3, 3e-2, 0.3, 3.0)
#: Number of nodes whose covariance is computed at once.
_AT_ONCE = 512
#: Smallest extent of the landmarks along any direction, relative to the largest one.
_THINNEST = 1e-3


@dataclass(frozen=True, eq=False)
class Spline:
    """Smoothing spline of landmarks, with its uncertainty.

    Attributes
    ----------
    displacement : ndarray of float32, shape (H, W, 2) or (D, H, W, 3)
        Displacement in the unit of the spacing, with components in the order of the axes; 0 in
        void. A separate piece of tissue without landmarks has the affine motion of all landmarks.
    noise : ndarray, shape (N, 2) or (N, 3)
        Estimated standard deviation of each landmark, in the unit of the spacing. Only their ratios
        are given.
    """

    displacement: npt.NDArray[np.float32]
    noise: Float64Array
    _field_of: Callable[[Float64Array], npt.NDArray[np.float32]]
    _fit: _Fit

    @cached_property
    def sd(self) -> npt.NDArray[np.float32]:
        """Standard deviation of each component of `displacement`; 0 in void.

        It is that of the posterior, given the scale, the smoothness and the noise of the motion,
        which are estimated. It does not contain the noise of a landmark.
        """
        return self._field_of(self._fit.sd())


def spline(
    landmarks: Landmarks, tissue: npt.ArrayLike, *, spacing: float | Sequence[float]
) -> npt.NDArray[np.float32]:
    """Return the displacement field of a smoothing spline of landmarks inside tissue.

    Use this function if only landmarks are known. It does not depend on the stiffness of tissue.
    `solve` is better if boundary conditions or different stiffness determine the motion.

    Parameters
    ----------
    landmarks, tissue, spacing
        As in `fit_spline`, which also returns the uncertainty of the field.

    Returns
    -------
    ndarray of float32, shape (H, W, 2) or (D, H, W, 3)
        As `Spline.displacement`.

    Raises
    ------
    ProblemError
        As `fit_spline`.

    Examples
    --------
    >>> import numpy as np
    >>> from napari_hmrf.landmarks import Landmarks, spline
    >>> points = np.array([(4, 5), (4, 25), (25, 5), (24, 26), (14, 15)])
    >>> targets = 1.1 * points
    >>> field = spline(Landmarks(points, targets, sd=0.5), np.ones((30, 30)), spacing=1)
    >>> np.round(field[20, 10], 3).tolist()
    [2.0, 1.0]
    """
    return fit_spline(landmarks, tissue, spacing=spacing).displacement


def fit_spline(
    landmarks: Landmarks, tissue: npt.ArrayLike, *, spacing: float | Sequence[float]
) -> Spline:
    """Fit a smoothing spline to landmarks inside tissue.

    Each component u of the displacement is the sum of a free affine motion and a smooth part, and
    minimises::

        sum_i (u(x_i) - y_i)^2 / sd_i^2 + lambda (integral |D^2 u|^2 + tau^2 integral |D^3 u|^2)

    where y_i are the observed displacements, D^2 u and D^3 u contain all second and third
    derivatives, and the integrals extend over the tissue. The derivatives are differences on a
    coarse grid of cubes. A void slit between two parts of tissue separates them, even if it is
    narrower than a cube; weak springs keep their motions similar. The length tau is 0, 0.06 or
    0.125 times the longest side of the tissue.

    The smooth part is a Gaussian process whose covariance is the inverse of the energy above
    (Wahba, 1978). The restricted likelihood, which does not depend on the affine motion, selects
    lambda, tau, the springs and the scale, so that only ratios of the standard deviations have an
    effect.

    Parameters
    ----------
    landmarks : Landmarks
        At least four landmarks in an image, or five in a volume, that do not lie on a line or in a
        plane. `scale` has no effect.
    tissue : array_like, shape (H, W) or (D, H, W)
        Mask, or stiffness; above 0 in tissue.
    spacing : float or sequence of float
        Pixel size along each axis.

    Returns
    -------
    Spline

    Raises
    ------
    ProblemError
        If there are too few landmarks, a landmark is outside the tissue, or an input is invalid.
    """
    mask = _checked_mask(tissue)
    pixel = checked_spacing(spacing, mask.ndim)
    sites = _checked_sites(landmarks, mask)
    grid = _CoarseGrid.of_tissue(mask, pixel)
    points = landmarks.points * pixel
    nodes, weights = grid.interpolation(grid.copies[tuple(sites.T)] - 1, points)
    fit = _best_fit(grid, _matrix(nodes, weights, grid.count), points, landmarks, pixel)

    def field_of(values: Float64Array) -> npt.NDArray[np.float32]:
        """Interpolate values of the nodes, shape (number of nodes, axes), at all sites."""
        field = np.zeros((*mask.shape, mask.ndim), np.float32)
        for plane in range(mask.shape[0]):
            inside = np.argwhere(mask[plane : plane + 1])
            inside[:, 0] = plane
            copies = grid.copies[tuple(inside.T)] - 1
            nodes, weights = grid.interpolation(copies, inside * pixel)
            field[tuple(inside.T)] = np.einsum("ij,ijk->ik", weights, values[nodes])
        return field

    return Spline(field_of(fit.displacement()), fit.noise, field_of, fit)


def _checked_mask(tissue: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    image = as_numbers("tissue", tissue)
    if image.ndim not in (2, 3):
        raise ProblemError(
            "tissue", f"has shape {image.shape}. Pass an image (H, W) or a volume (D, H, W)."
        )
    mask = np.asarray(image > 0)
    if not mask.any():
        raise ProblemError("tissue", "has no pixels above 0. Pass a mask of the tissue.")
    return mask


def _checked_sites(landmarks: Landmarks, mask: npt.NDArray[np.bool_]) -> Indices:
    """Return the nearest tissue site of each landmark; raise an error if landmarks are unsuitable.

    Only the corners of the element of a landmark are considered.
    """
    if not isinstance(landmarks, Landmarks):
        raise ProblemError(
            "landmarks", f"are of type {type(landmarks).__name__}. Pass Landmarks(points, targets)."
        )
    points, axes = landmarks.points, mask.ndim
    landmarks.check_inside(mask.shape)
    if len(points) < axes + 2:
        raise ProblemError(
            "landmarks", f"are only {len(points)}. A spline needs at least {axes + 2}; add some."
        )
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[-1] <= _THINNEST * extents[0]:
        raise ProblemError(
            "landmarks",
            f"all lie {'in a plane' if axes == 3 else 'on a line'}, which leaves the motion of "
            "other tissue open. Add a landmark away from it.",
        )
    first, within = corners_of(points, mask.shape)
    steps = np.array(list(itertools.product((0, 1), repeat=axes)))
    corners = first[:, None] + steps
    distance = ((within[:, None] - steps) ** 2).sum(axis=2)
    distance[~mask[tuple(np.moveaxis(corners, -1, 0))]] = np.inf
    beside = np.isinf(distance.min(axis=1))
    if beside.any():
        raise ProblemError(
            "landmarks",
            f"have {int(beside.sum())} points outside the tissue, the first with number "
            f"{first_index(beside)[0]}. Move or remove these landmarks.",
        )
    return np.asarray(corners[np.arange(len(points)), distance.argmin(axis=1)])


@dataclass(frozen=True)
class _CoarseGrid:
    """Grid of cubes within tissue. A cube that a slit divides has one copy for each part.

    Copies of neighbouring cubes share the nodes of their common face if tissue connects them.

    Parameters
    ----------
    copies : ndarray of int, shape (H, W) or (D, H, W)
        Number of the copy that contains a site, from 1; 0 in void.
    corners : ndarray of int, shape (number of copies, 2, 2) or (number of copies, 2, 2, 2)
        Nodes of each copy.
    low : ndarray, shape (number of copies, axes)
        Position of the first corner of each copy.
    side : float
        Side of a cube.
    extent : float
        Longest side of the tissue.
    """

    copies: npt.NDArray[np.integer]
    corners: Indices
    low: Float64Array
    side: float
    extent: float

    @classmethod
    def of_tissue(cls, mask: npt.NDArray[np.bool_], pixel: tuple[float, ...]) -> _CoarseGrid:
        """Return the grid of a mask."""
        axes, size = mask.ndim, np.array(pixel)
        volume = np.count_nonzero(mask) * math.prod(pixel)
        side = max((volume / _ELEMENTS) ** (1 / axes), *pixel)
        occupied = [np.flatnonzero(mask.any(axis=tuple({*range(axes)} - {a}))) for a in range(axes)]
        start = (np.array([places[0] for places in occupied]) - 0.5) * size
        extent = max((p[-1] - p[0] + 1) * s for p, s in zip(occupied, pixel, strict=True))
        cubes = [
            np.floor((np.arange(n) * size[a] - start[a]) / side).astype(int)
            for a, n in enumerate(mask.shape)
        ]
        # A plane of void between cubes confines the connected parts to single cubes.
        apart, kept = mask, []
        for axis, cube in enumerate(cubes):
            borders = np.flatnonzero(np.diff(cube)) + 1
            apart = np.insert(apart, borders, False, axis=axis)
            kept.append(
                np.arange(len(cube)) + np.searchsorted(borders, np.arange(len(cube)), "right")
            )
        labels, count = scipy.ndimage.label(apart)
        copies = labels[np.ix_(*kept)]
        position = np.zeros((count + 1, axes))
        inside = np.nonzero(mask)
        for axis, cube in enumerate(cubes):
            position[copies[inside], axis] = cube[inside[axis]]
        virtual = np.arange(count * 2**axes).reshape(count, *(2,) * axes)
        pairs: list[Any] = []
        for axis in range(axes):
            before = copies[(slice(None),) * axis + (slice(None, -1),)].ravel()
            after = copies[(slice(None),) * axis + (slice(1, None),)].ravel()
            joined = (before > 0) & (after > 0) & (before != after)
            links = np.unique(np.stack([before[joined], after[joined]], axis=1), axis=0) - 1
            one = virtual[links[:, 0]].take(1, axis=axis + 1).ravel()
            pairs.append((one, virtual[links[:, 1]].take(0, axis=axis + 1).ravel()))
        ends = np.concatenate([np.stack(pair) for pair in pairs], axis=1)
        graph = scipy.sparse.coo_matrix(
            (np.ones(ends.shape[1]), tuple(ends)), shape=(virtual.size,) * 2
        )
        _, nodes = scipy.sparse.csgraph.connected_components(graph, directed=False)
        corners = nodes.reshape(virtual.shape).astype(np.intp)
        return cls(copies, corners, start + side * position[1:], side, float(extent))

    @property
    def count(self) -> int:
        """Number of nodes."""
        return int(self.corners.max()) + 1

    def pieces(self) -> int:
        """Return the number of pieces of tissue that share no node."""
        flat = self.corners.reshape(len(self.corners), -1)
        links = np.repeat(flat[:, 0], flat.shape[1]), flat.ravel()
        graph = scipy.sparse.coo_matrix((np.ones(flat.size), links), shape=(self.count,) * 2)
        return int(scipy.sparse.csgraph.connected_components(graph, directed=False)[0])

    def positions(self) -> Float64Array:
        """Return the positions of the nodes, shape (number of nodes, axes)."""
        axes = self.low.shape[1]
        steps = np.array(list(itertools.product((0, 1), repeat=axes)))
        places = np.zeros((self.count, axes))
        places[self.corners.reshape(len(self.low), -1)] = self.low[:, None] + self.side * steps
        return places

    def volumes(self) -> Float64Array:
        """Return the volume of each node: its share of the cubes around it."""
        axes = self.low.shape[1]
        share = (self.side / 2) ** axes
        return np.asarray(np.bincount(self.corners.ravel(), minlength=self.count) * share)

    def interpolation(self, copies: Any, points: npt.NDArray[Any]) -> tuple[Indices, Float64Array]:
        """Return the nodes around each point and their weights, shape (n, 4) or (n, 8)."""
        within = (points - self.low[copies]) / self.side
        weights = np.ones((len(points), 1))
        for part in within.T:
            ends = np.stack([1 - part, part], axis=1)
            weights = (weights[:, :, None] * ends[:, None]).reshape(
                len(points), 2 * weights.shape[1]
            )
        return self.corners[copies].reshape(weights.shape), weights

    def roughness(self, order: int) -> Any:
        """Return the sparse matrix of the integral of all squared derivatives of an order."""
        axes = self.low.shape[1]
        total = 0
        for orders in itertools.product(range(order + 1), repeat=axes):
            if sum(orders) == order:
                equal = math.factorial(order) / math.prod(map(math.factorial, orders))
                differences = self._differences(orders)
                total = total + equal * (differences.T @ differences)
        return total * self.side ** (axes - 2 * order)

    def _differences(self, orders: tuple[int, ...]) -> Any:
        """Return the sparse matrix of differences, of the given order along each axis."""
        ends = [(slice(None),) if order else (slice(0, 1), slice(1, 2)) for order in orders]
        shape = tuple(2 if order else 1 for order in orders)
        faces = [
            self.corners[(slice(None), *parts)].reshape(len(self.corners), -1)
            for parts in itertools.product(*ends)
        ]
        single = np.unique(np.concatenate(faces), axis=0).reshape(-1, *shape)
        block = single
        signs = np.ones(())
        for axis, order in enumerate(orders):
            for _ in range(order - 1):
                block = _joined(block, single, axis + 1)
            row = [(-1.0) ** (order - step) * math.comb(order, step) for step in range(order + 1)]
            signs = np.multiply.outer(signs, row)
            single = block
        nodes = block.reshape(len(block), signs.size)
        return _matrix(nodes, np.broadcast_to(signs.ravel(), nodes.shape), self.count)


def _joined(block: Indices, single: Indices, axis: int) -> Indices:
    """Return blocks of nodes that are one step longer along an axis.

    Each block is joined with all single steps that begin with its last nodes.
    """
    last = block.take(-1, axis=axis).reshape(len(block), -1)
    begin = single.take(0, axis=axis).reshape(len(single), -1)
    _, keys = np.unique(np.concatenate([last, begin]), axis=0, return_inverse=True)
    keys, count = keys.ravel(), int(keys.max(initial=0)) + 1

    def incidence(of: Indices) -> Any:
        return scipy.sparse.csr_matrix(
            (np.ones(len(of)), (np.arange(len(of)), of)), (len(of), count)
        )

    matches = (incidence(keys[: len(block)]) @ incidence(keys[len(block) :]).T).tocoo()
    end = single[matches.col].take([1], axis=axis)
    return np.concatenate([block[matches.row], end], axis=axis)


def _matrix(nodes: Indices, weights: Float64Array, count: int) -> Any:
    """Return a sparse matrix whose rows have the given weights at the given nodes."""
    rows = np.repeat(np.arange(len(nodes)), nodes.shape[1])
    return scipy.sparse.csr_matrix(
        (weights.ravel(), (rows, nodes.ravel())), shape=(len(nodes), count)
    )


def _best_fit(
    grid: _CoarseGrid,
    interpolate: Any,
    points: Float64Array,
    landmarks: Landmarks,
    pixel: tuple[float, ...],
) -> _Fit:
    """Return the fit with the largest restricted likelihood."""
    y, extent, mass = landmarks.displacement(pixel), grid.extent, grid.volumes()
    sd = landmarks.sd / np.exp(np.log(landmarks.sd).mean())
    affine = np.column_stack([np.ones(grid.count), grid.positions() - points.mean(axis=0)])
    affine[:, 1:] /= extent
    second, third = grid.roughness(2), grid.roughness(3)
    springs = _SPRINGS if grid.pieces() > 1 else _SPRINGS[:1]
    best = None
    for length, spring in itertools.product(_LENGTHS, springs):
        energy = second + (length * extent) ** 2 * third
        energy = energy + scipy.sparse.diags(spring / extent**4 * mass)
        factors = scipy.sparse.linalg.splu(
            energy.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        fit = _Fit.of(factors, interpolate, affine, mass, y, sd)
        if best is None or fit.likelihood > best.likelihood:
            best = fit
    assert best is not None
    return best


@dataclass(frozen=True, eq=False)
class _Fit:
    """Gaussian process with one covariance of the nodes, given the landmarks.

    Parameters
    ----------
    factors : SuperLU
        Factors of the matrix of the energy of the nodes, whose inverse is the covariance.
    responses : ndarray, shape (number of nodes, N)
        Covariance of the nodes and the landmarks, without affine motions.
    affine : ndarray, shape (number of nodes, axes + 1)
        Affine motions of the nodes.
    interpolate : sparse matrix, shape (N, number of nodes)
    groups : list of _Group
        Components of equal standard deviations.
    damping : float
        Variance of the noise of a landmark of relative standard deviation 1, relative to the scale
        of the covariance.
    scale : float
        Scale of the covariance.
    likelihood : float
        Logarithm of the restricted likelihood, apart from a constant.
    """

    factors: Any
    responses: Float64Array
    affine: Float64Array
    interpolate: Any
    groups: list[_Group]
    damping: float
    scale: float
    likelihood: float

    @classmethod
    def of(
        cls,
        factors: Any,
        interpolate: Any,
        affine: Float64Array,
        mass: Float64Array,
        y: Float64Array,
        sd: Float64Array,
    ) -> _Fit:
        """Return the fit with the best damping and scale for a covariance."""
        loads = interpolate.T.toarray()
        weighted = mass[:, None] * affine
        loads -= weighted @ np.linalg.solve(affine.T @ weighted, affine.T @ loads)
        responses = factors.solve(loads)
        kernel, drift = interpolate @ responses, interpolate @ affine
        sds, kinds = np.unique(sd, axis=1, return_inverse=True)
        groups = [
            _Group.of(kernel, drift, y, own, np.flatnonzero(kinds.ravel() == kind))
            for kind, own in enumerate(sds.T)
        ]
        dampings = _SMOOTHING * np.median(np.concatenate([group.values for group in groups]))
        found = [_likelihood(groups, damping) for damping in dampings]
        number = max(range(len(found)), key=lambda each: found[each][0])
        likelihood, scale = found[number]
        return cls(
            factors, responses, affine, interpolate, groups, dampings[number], scale, likelihood
        )

    @property
    def noise(self) -> Float64Array:
        """Standard deviation of each landmark, shape (N, axes)."""
        made = np.zeros((self.interpolate.shape[0], sum(len(each.axes) for each in self.groups)))
        for group in self.groups:
            made[:, group.axes] = math.sqrt(self.scale * self.damping) * group.sd[:, None]
        return made

    def displacement(self) -> Float64Array:
        """Return the displacement of the nodes, shape (number of nodes, axes)."""
        field = np.zeros((len(self.affine), sum(len(each.axes) for each in self.groups)))
        for group in self.groups:
            forces, motion = group.solution(self.damping)
            field[:, group.axes] = self.responses @ forces + self.affine @ motion
        return field

    def sd(self) -> Float64Array:
        """Return the standard deviation of the nodes, shape (number of nodes, axes).

        The variance is that of universal kriging: of the process given the landmarks, and of the
        affine motion.
        """
        count = len(self.affine)
        prior, between = np.empty(count), np.empty((self.interpolate.shape[0], count))
        for begin in range(0, count, _AT_ONCE):
            part = slice(begin, min(begin + _AT_ONCE, count))
            unit = np.zeros((count, part.stop - begin))
            unit[np.arange(begin, part.stop), np.arange(part.stop - begin)] = 1
            columns = self.factors.solve(unit)
            prior[part] = columns[part].diagonal()
            between[:, part] = self.interpolate @ columns
        kernel, drift = between @ self.interpolate.T, self.interpolate @ self.affine
        made = np.zeros((count, sum(len(each.axes) for each in self.groups)))
        for group in self.groups:
            noisy = kernel + np.diag(self.damping * group.sd**2)
            factor = scipy.linalg.cho_factor((noisy + noisy.T) / 2)
            known = scipy.linalg.cho_solve(factor, np.column_stack([between, drift]))
            left, of_drift = known[:, :count], known[:, count:]
            rest = self.affine.T - drift.T @ left
            variance = prior - np.einsum("ij,ij->j", between, left)
            variance += np.einsum("ij,ij->j", rest, np.linalg.solve(drift.T @ of_drift, rest))
            made[:, group.axes] = np.sqrt(self.scale * np.maximum(variance, 0))[:, None]
        return made


def _likelihood(groups: Sequence[_Group], damping: float) -> tuple[float, float]:
    """Return the logarithm of the restricted likelihood at its best scale, and this scale."""
    squares = determinant = 0.0
    count = 0
    for group in groups:
        variance = group.values + damping
        squares += float((group.parts**2 / variance[:, None]).sum())
        determinant += len(group.axes) * float(np.log(variance).sum())
        count += group.parts.size
    scale = max(squares / count, np.finfo(float).tiny)
    return -0.5 * (count * math.log(scale) + determinant), scale


@dataclass(frozen=True, eq=False)
class _Group:
    """Components with equal standard deviations, at the landmarks.

    Rows of the kernel, the drift and the data are divided by the standard deviations.

    Parameters
    ----------
    kernel : ndarray, shape (N, N)
    drift : ndarray, shape (N, axes + 1)
        Values of the affine motions at the landmarks.
    y : ndarray, shape (N, components)
    sd : ndarray, shape (N,)
        Relative standard deviations.
    axes : ndarray of int
        Numbers of the components.
    modes : ndarray, shape (N, N - axes - 1)
        Eigenvectors of the kernel, orthogonal to the drift.
    values : ndarray, shape (N - axes - 1,)
        Eigenvalues of the kernel.
    """

    kernel: Float64Array
    drift: Float64Array
    y: Float64Array
    sd: Float64Array
    axes: Indices
    modes: Float64Array
    values: Float64Array

    @classmethod
    def of(
        cls,
        kernel: Float64Array,
        drift: Float64Array,
        y: Float64Array,
        sd: Float64Array,
        axes: Indices,
    ) -> _Group:
        """Return the group of the given components."""
        white = (kernel + kernel.T) / 2 / np.outer(sd, sd)
        shifts = drift / sd[:, None]
        free = np.linalg.qr(shifts, mode="complete")[0][:, shifts.shape[1] :]
        values, vectors = np.linalg.eigh(free.T @ white @ free)
        values = np.maximum(values, 1e-12 * values.max())
        return cls(white, shifts, y[:, axes] / sd[:, None], sd, axes, free @ vectors, values)

    @cached_property
    def parts(self) -> Float64Array:
        """Data along each eigenvector, shape (N - axes - 1, components)."""
        return self.modes.T @ self.y

    def solution(self, damping: float) -> tuple[Float64Array, Float64Array]:
        """Return the forces at the landmarks, and the affine motion."""
        forces = self.modes / (self.values + damping) @ self.parts
        rest = self.y - self.kernel @ forces - damping * forces
        motion = np.linalg.lstsq(self.drift, rest, rcond=None)[0]
        return forces / self.sd[:, None], np.asarray(motion, np.float64)
