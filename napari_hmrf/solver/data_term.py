"""Quadratic data term of a problem: uncertain observations, in addition to constraints.

The energy of the data is

    U_data = 1/2 sum over sites of (d - y)^T W (d - y)

where y is the observed displacement and W the *precision*, a symmetric positive semidefinite tensor
at each site. W is the inverse covariance of the observation, times a unit of energy. A multiple of
the identity is an observation that is equally certain in all directions; ``k n n^T`` observes the
component along the normal n only, so that tissue slides freely along a surface.

The term is linear in the forces that the solver balances: it adds W to the matrix and W y to the
load.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.compute.workspace import Kept
from napari_hmrf.errors import ProblemError
from napari_hmrf.real_arrays import are_equal
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.uncertain_landmarks import corner_shares, corners_of

Float64Array = npt.NDArray[np.float64]
Planes = npt.NDArray[np.float64]
# Number of sites that are processed at once, so that temporary arrays stay in the cache.
_BLOCK_SIZE = 16384


def packed_axes(axes: int) -> tuple[tuple[int, int], ...]:
    """Return the indices of the components of a packed tensor: the diagonal, then the others."""
    diagonal = tuple((axis, axis) for axis in range(axes))
    return diagonal + tuple((i, j) for i in range(axes) for j in range(i + 1, axes))


class PointTerm(NamedTuple):
    """Landmarks in the units of the model: each observes an interpolated displacement.

    Attributes
    ----------
    elements : ndarray of int, shape (n, axes)
        First corner of the element around each point.
    corners : ndarray of int, shape (n, 2^axes)
        Indices of the corners in a flattened plane, whose border is two sites wide.
    shares : ndarray, shape (n, 2^axes)
        Share of each corner in the interpolated displacement, H in the equations.
    weights : ndarray, shape (axes, n)
        Precision of each component, relative to the stiffest tissue.
    observed : ndarray, shape (axes, n)
        Observed displacement, in pixels.
    """

    elements: npt.NDArray[np.intp]
    corners: npt.NDArray[np.intp]
    shares: Float64Array
    weights: Float64Array
    observed: Float64Array

    @classmethod
    def of(cls, problem: Problem, unit: float) -> PointTerm | None:
        """Return the term for the landmarks of a problem, or None if there are none."""
        landmarks = problem.landmarks
        if landmarks is None:
            return None
        grid = problem.shape
        elements, _ = corners_of(landmarks.points, grid)
        shares = [share for _, share in corner_shares(landmarks.points, grid)]
        return cls(
            elements,
            _corners_in_planes(elements, grid),
            np.stack(shares, axis=1),
            landmarks.precision(problem.stiffness, problem.spacing).T / unit,
            landmarks.displacement(problem.spacing).T / problem.unit,
        )

    def on_grid(
        self,
        some: npt.NDArray[Any],
        moves: npt.NDArray[np.intp],
        grid: tuple[int, ...],
        unit: float,
    ) -> PointTerm | None:
        """Return some of the landmarks on another grid; None if there are none.

        Parameters
        ----------
        some : ndarray of bool, shape (n,)
        moves : ndarray of int, shape (axes,) or (n, axes)
            Index of each element on the other grid, less its present index.
        grid : tuple of int
        unit : float
            Precision of 1 on the other grid, in the present units.
        """
        if not some.any():
            return None
        elements = (self.elements + moves)[some]
        corners = _corners_in_planes(elements, grid)
        weights = self.weights[:, some] / unit
        return PointTerm(elements, corners, self.shares[some], weights, self.observed[:, some])

    def at_points(self, d: npt.NDArray[np.floating]) -> Float64Array:
        """Return H d, the displacement at the points, shape (axes, n)."""
        values = d.reshape(len(d), -1)[:, self.corners]
        return np.asarray((self.shares * values).sum(axis=-1), np.float64)

    def add_forces(
        self, of_points: Float64Array, out: npt.NDArray[np.floating], scale: float = 1.0
    ) -> None:
        """Add H^T f to `out`, in place, for forces f at the points, shape (axes, n)."""
        flat = out.reshape(len(out), -1)
        for plane, forces in zip(flat, of_points, strict=True):
            np.add.at(
                plane, self.corners, (scale * forces[:, None] * self.shares).astype(out.dtype)
            )

    def lumped(self) -> tuple[npt.NDArray[np.intp], Float64Array]:
        """Return the corners of all points and their share of the precision, (axes, corners)."""
        at, place = np.unique(self.corners, return_inverse=True)
        place = place.reshape(self.corners.shape)
        sums = np.zeros((len(self.weights), len(at)))
        for total, weights in zip(sums, self.weights, strict=True):
            np.add.at(total, place, weights[:, None] * self.shares)
        return at, sums


def _corners_in_planes(
    elements: npt.NDArray[np.intp], grid: tuple[int, ...]
) -> npt.NDArray[np.intp]:
    """Return the indices of the corners of elements, shape (n, 2^axes), in a flattened plane."""
    corners = elements[:, None] + 2 + np.array(list(np.ndindex(*(2,) * len(grid))))
    padded = tuple(size + 4 for size in grid)
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), padded))


class DataTerm(NamedTuple):
    """Data term in the units of the model, in which a pixel has length 1.

    Attributes
    ----------
    weights : ndarray, shape (3, H + 4, W + 4) or (6, D + 4, H + 4, W + 4)
        Packed precision (`packed_axes`) relative to the stiffest tissue, as planes.
    points : PointTerm or None
        Landmarks.
    """

    weights: Planes
    points: PointTerm | None = None

    @classmethod
    def of(cls, problem: Problem, unit: float) -> DataTerm | None:
        """Return the data term of a problem, or None if there is none.

        Parameters
        ----------
        problem : Problem
        unit : float
            Precision of 1 in the units of the model.
        """
        precision = problem.precision
        points = PointTerm.of(problem, unit)
        if precision is None and points is None:
            return None
        if precision is not None:
            return cls(_weights_of(precision, unit), points)
        count = len(packed_axes(len(problem.shape)))
        return cls(np.zeros((count, *(size + 4 for size in problem.shape))), points)

    @property
    def axes(self) -> int:
        """Number of axes of the grid."""
        return self.weights.ndim - 1

    def load(self, observed: npt.NDArray[np.float32], unit: float) -> tuple[Planes, float]:
        """Return the forces and the energy of the observations at zero displacement.

        Parameters
        ----------
        observed : ndarray, shape (H, W, 2) or (D, H, W, 3)
            Observed displacement.
        unit : float
            Length of a pixel in the unit of the displacement.

        Returns
        -------
        ndarray, planes
            ``W y + H^T w y_p``, where w and y_p belong to the landmarks.
        float
            Half the work of these forces over the observations.
        """
        forces, energy = np.zeros((self.axes, *self.weights.shape[1:])), 0.0
        for sites, planes in _blocks(observed.shape[:-1]):
            y = np.moveaxis(observed[sites], -1, 0).astype(np.float64, order="C")
            y /= unit
            energy += self._multiply(y, planes, forces)
        if self.points is not None:
            of_points = self.points.weights * self.points.observed
            self.points.add_forces(of_points, forces)
            energy += float((of_points * self.points.observed).sum()) / 2
        return forces, energy

    def derivative(self, d: Planes, observed: Planes) -> tuple[Planes, float]:
        """Return the gradient of the energy at a displacement, and the energy.

        Unlike `load`, this has no rounding error where a precise observation is satisfied.

        Parameters
        ----------
        d, observed : ndarray, planes
            Displacement, and observed displacement of the sites, in pixels.

        Returns
        -------
        ndarray, planes
            ``W (d - y) + H^T w (H d - y_p)``
        float
        """
        forces, energy = np.zeros(d.shape), 0.0
        for _, planes in _blocks(tuple(size - 4 for size in d.shape[1:])):
            off = d[:, *planes] - observed[:, *planes]
            energy += self._multiply(off, planes, forces)
        if self.points is not None:
            off = self.points.at_points(d) - self.points.observed
            of_points = self.points.weights * off
            self.points.add_forces(of_points, forces)
            energy += float((of_points * off).sum()) / 2
        return forces, energy

    def _multiply(self, y: Float64Array, planes: tuple[slice, ...], forces: Planes) -> float:
        """Write W y to a block of `forces`; return y . W y / 2."""
        pairs = dict(zip(packed_axes(self.axes), self.weights, strict=True))
        product, energy = np.empty(y.shape[1:]), 0.0
        for i, force in enumerate(forces):
            out = force[planes]
            np.multiply(pairs[i, i][planes], y[i], out=out)
            for j in range(self.axes):
                if i != j:
                    weight = pairs[min(i, j), max(i, j)][planes]
                    out += np.multiply(weight, y[j], out=product)
            energy += float(np.multiply(out, y[i], out=product).sum()) / 2
        return energy

    def add_diagonal(self, out: Planes) -> None:
        """Add the diagonal of the term to the diagonal of the tissue, in place.

        Sites without elements have no diagonal, and stay fixed.
        """
        weights = self.weights[: len(out)].copy()
        if self.points is not None:
            flat = weights.reshape(len(weights), -1)
            for plane, own in zip(flat, self.points.weights, strict=True):
                np.add.at(plane, self.points.corners, own[:, None] * self.points.shares**2)
        out += np.where(out > 0, weights, 0.0)

    def add_to_elements(
        self,
        matrices: Float64Array,
        elements: tuple[slice, ...],
        elements_around: npt.NDArray[np.intp],
    ) -> None:
        """Add W to the matrices of elements, in place; the elements around a site share its W.

        Parameters
        ----------
        matrices : ndarray, shape (h, w, 8, 8) or (d, h, w, 24, 24)
            Matrices of the elements in the given ranges; zero for elements with void.
        elements : tuple of slice
            Range of elements along each axis.
        elements_around : ndarray of int, shape (H, W) or (D, H, W)
            Number of tissue elements around each site.
        """
        axes = self.axes
        real = np.diagonal(matrices, axis1=-2, axis2=-1).any(axis=-1)
        for number, corner in enumerate(np.ndindex(*(2,) * axes)):
            sites = tuple(
                slice(each.start + step, each.stop + step)
                for each, step in zip(elements, corner, strict=True)
            )
            planes = tuple(slice(each.start + 2, each.stop + 2) for each in sites)
            share = real / np.maximum(elements_around[sites], 1)
            for weight, (i, j) in zip(self.weights, packed_axes(axes), strict=True):
                row, col = axes * number + i, axes * number + j
                matrices[..., row, col] += share * weight[planes]
                if i != j:
                    matrices[..., col, row] += share * weight[planes]
        if self.points is not None:
            self._add_points(matrices, elements)

    def _add_points(self, matrices: Float64Array, elements: tuple[slice, ...]) -> None:
        """Add H^T w H of the landmarks to the matrices of elements in the given ranges."""
        points, axes = self.points, self.axes
        assert points is not None
        first, past = (
            np.array([getattr(each, end) for each in elements]) for end in ("start", "stop")
        )
        here = ((points.elements >= first) & (points.elements < past)).all(axis=1)
        at = tuple((points.elements[here] - first).T)
        share = points.shares[here]
        both = share[:, :, None] * share[:, None, :]
        corners = np.arange(share.shape[1])
        for axis in range(axes):
            rows = axes * corners + axis
            block = points.weights[axis, here][:, None, None] * both
            where = (*(index[:, None, None] for index in at), rows[:, None], rows)
            np.add.at(matrices, where, block)


# Weak references to the last precision and to its weights, with the unit.
_packed: Kept[tuple[weakref.ref[Any], weakref.ref[Any], float]] = Kept()


def _weights_of(precision: npt.NDArray[np.floating], unit: float) -> Planes:
    """Return a precision as packed planes; those of the same array are computed only once."""
    if _packed.value is not None:
        known, made, its_unit = _packed.value
        weights: Planes | None = made()
        if known() is precision and its_unit == unit and weights is not None:
            return weights
    grid, axes = precision.shape[:-2], precision.shape[-1]
    pairs = packed_axes(axes)
    weights = np.zeros((len(pairs), *(size + 4 for size in grid)))
    for sites, planes in _blocks(grid):
        for plane, (i, j) in zip(weights, pairs, strict=True):
            np.divide(precision[sites][..., i, j], unit, out=plane[planes])
    _packed.value = weakref.ref(precision), weakref.ref(weights), unit
    return weights


def _blocks(grid: tuple[int, ...]) -> Iterator[tuple[slice, tuple[slice, ...]]]:
    """Yield the index of each block of sites along the first axis, and its index in planes."""
    step = max(1, _BLOCK_SIZE // math.prod(grid[1:]))
    across = (slice(2, -2),) * (len(grid) - 1)
    for begin in range(0, grid[0], step):
        past = min(begin + step, grid[0])
        yield slice(begin, past), (slice(begin + 2, past + 2), *across)


def combined_data(
    one: tuple[npt.NDArray[Any], npt.NDArray[Any] | None],
    other: tuple[npt.NDArray[Any], npt.NDArray[Any]],
    known: npt.NDArray[np.bool_],
) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return the observed displacement and the precision of two data terms together.

    Parameters
    ----------
    one : tuple
        Observed displacement of a problem, shape ([D,] H, W, n), and its precision, shape
        ([D,] H, W, n, n), or None.
    other : tuple
        Displacement and precision of further observations.
    known : ndarray of bool, shape ([D,] H, W, n)
        Components with a confidence. Further observations of these sites are ignored.
    """
    (y, first), (z, second) = one, other
    if first is None and not known.any():
        return z, second
    adds = np.asarray(second.any(axis=(-2, -1)) & ~known.any(axis=-1))
    observed = np.where(adds[..., None], z, y)
    if first is None:
        return observed, np.where(adds[..., None, None], second, 0)
    whole = first + np.where(adds[..., None, None], second, 0)
    both = adds & first.any(axis=(-2, -1))
    forces = np.einsum("kij,kj->ki", first[both], y[both])
    forces += np.einsum("kij,kj->ki", second[both], z[both])
    # A sum of tensors may be singular; it then observes the other directions only.
    observed[both] = np.einsum("kij,kj->ki", np.linalg.pinv(whole[both], hermitian=True), forces)
    return observed, whole


def are_same(one: DataTerm | None, other: DataTerm | None) -> bool:
    """Return whether two data terms have the same matrix; their observations may differ."""
    if one is None or other is None:
        return one is other
    own, weights = one.weights, other.weights
    same = own is weights or all(map(are_equal, own, weights))
    if one.points is None or other.points is None:
        return same and one.points is other.points
    return (
        same
        and np.array_equal(one.points.corners, other.points.corners)
        and np.array_equal(one.points.shares, other.points.shares)
        and np.array_equal(one.points.weights, other.points.weights)
    )


def refuse_data(problem: Problem) -> None:
    """Raise an error if a problem has a data term, which the paper's prior does not support.

    Raises
    ------
    ProblemError
        If there is a precision or a landmark.
    """
    for field, data in (("precision", problem.precision), ("landmarks", problem.landmarks)):
        if data is not None:
            raise ProblemError(
                field,
                "cannot be used with the paper's prior. Use ElasticPrior, or confidence instead.",
            )
