"""Large motion of images and volumes by Newton's method, with elements of its own.

The energy of a neo-Hookean element is a mean over points, with F the deformation gradient without
growth, J = det F, and V the mean of J over the element:

    image:   at the middle:  mu/2 |F|^2 + g(J)
             twist:          mu_x/2 |F|^2, integrated, minus its value at the middle
             at the corners: mu kappa b(J), a barrier that acts below J = 1/2
    volume:  mu/2 |F|^2 - mu ln J + G(V), with G(V) = lambda/4 V^2 - lambda/2 ln V

`napari_hmrf.solver.priors` derives g, mu_x and b. There is no barrier in volumes, so that the
reference agrees with the solver where no element is close to folding. Textbook elements evaluate g
or G at each Gauss point, and have no barrier.

Derivatives are with respect to ln J, whose first derivative with respect to the displacement of a
corner is F^-T times the slope of its shape function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from napari_hmrf import ElasticPrior, NeoHookeanPrior, Problem
from napari_hmrf.landmarks import Landmarks
from validation.oracles.elasticity import (
    at_corners,
    corners_of,
    growth_of,
    is_plane_stress,
    lame_parameters,
)
from validation.oracles.posterior import data_matrix

Array = npt.NDArray[np.float64]
Points = tuple[tuple[float, ...], ...]
# Strength of the barrier, in units of mu, and the Jacobian below which it acts.
_BARRIER, _BEGIN = 10.0, 0.5
_GAUSS = 0.5 - 0.5 / 3**0.5, 0.5 + 0.5 / 3**0.5
# Largest step of the last increment and of the others at which the iteration ends.
_LAST, _OTHERS = 1e-9, 1e-2
_MOST_STEPS = 60


@lru_cache(maxsize=1024)
def slopes_at(points: Points, spacing: tuple[float, ...]) -> Array:
    """Return the slopes of the shape functions of an element, (points, corners, axes).

    Points are given in sides of the element.
    """
    axes = len(spacing)
    ends = np.array(corners_of(axes))
    values = np.where(ends, np.array(points)[:, None], 1 - np.array(points)[:, None])
    slopes = np.empty_like(values)
    for axis in range(axes):
        others = np.delete(values, axis, axis=-1).prod(axis=-1)
        slopes[..., axis] = (2 * ends[:, axis] - 1) / spacing[axis] * others
    return slopes


def displaced_corners(d: npt.NDArray[Any]) -> Array:
    """Return a displacement at the corners of each element, (H - 1, W - 1, 4, 2) or (..., 8, 3)."""
    return np.moveaxis(at_corners(d.astype(np.float64), d.shape[-1]), 0, -2)


def smallest_jacobians(corners: Array, points: int = 10) -> Array:
    """Return the smallest Jacobian at a dense grid of points in elements.

    Parameters
    ----------
    corners : ndarray, shape (..., 4, 2) or (..., 8, 3)
        Displacements of the corners, in sides of the element.
    points : int
        Points along each axis, those at both ends included.
    """
    axes = corners.shape[-1]
    least = np.full(corners.shape[:-2], np.inf)
    for place in product(np.linspace(0, 1, points).tolist(), repeat=axes):
        (slopes,) = slopes_at((place,), (1.0,) * axes)
        gradient = np.eye(axes) + np.einsum("...ck,ca->...ka", corners, slopes)
        np.minimum(least, np.linalg.det(gradient), out=least)
    return least


def smallest_jacobian(
    problem: Problem, displacement: npt.NDArray[np.floating], points: int = 10
) -> float:
    """Return the smallest Jacobian in the elements of tissue; NaN if any of them is NaN."""
    axes = displacement.shape[-1]
    values = displaced_corners(displacement / np.array(problem.spacing))
    values = values[at_corners(problem.tissue, axes).all(axis=0)]
    return float(smallest_jacobians(values, points).min(initial=np.inf))


def large_field(
    problem: Problem,
    prior: NeoHookeanPrior,
    parts: int = 8,
    *,
    textbook: bool = False,
    start: Array | None = None,
) -> Array:
    """Return the field of least energy, loaded in `parts` increments.

    Parameters
    ----------
    problem : Problem
        Tissue without rigid parts. All components that are observed are prescribed exactly, and
        terms of data are added.
    prior : NeoHookeanPrior
    parts : int
        Number of increments of the displacement, the observations, the growth and the forces.
    textbook : bool
        True for elements that evaluate everything at the Gauss points.
    start : ndarray, optional
        Field from which the first increment begins, for one increment; by default zero.

    Returns
    -------
    ndarray, shape (H, W, 2) or (D, H, W, 3)
        Displacement, in the unit of ``problem.spacing``.
    """
    d = np.zeros(problem.observed.shape) if start is None else start.astype(np.float64)
    exist = at_corners(problem.tissue, len(problem.shape)).all(axis=0)
    number = np.arange(d.size).reshape(d.shape)
    nodes = displaced_corners(number)[exist].astype(np.intp)
    places = nodes.reshape(len(nodes), -1)
    rows, cols = np.broadcast_arrays(places[:, :, None], places[:, None, :])
    known = problem.known.ravel()
    free = np.setdiff1d(nodes, np.flatnonzero(known))
    goal, force = problem.observed.astype(np.float64).ravel(), np.zeros(d.size)
    if problem.loads is not None and problem.loads.force is not None:
        force = problem.loads.force.astype(np.float64).ravel()
    data, pull = data_matrix(problem)
    for part in range(1, parts + 1):
        share = part / parts
        tissue = _Tissue.of(problem, prior, share, exist)
        for _ in range(_MOST_STEPS):
            pulls, tangents = _derivatives(tissue, d.ravel()[nodes], textbook)
            load = share * (force + pull) - np.bincount(nodes.ravel(), pulls.ravel(), d.size)
            load -= data @ d.ravel()
            at = rows.ravel(), cols.ravel()
            matrix = sp.csc_array((tangents.ravel(), at), shape=(d.size, d.size)) + data
            step = np.where(known, share * goal - d.ravel(), 0.0)
            step[free] = spsolve(matrix[free][:, free], (load - matrix @ step)[free])
            step, length = step.reshape(d.shape), 1.0
            while smallest_jacobian(problem, d + length * step, 2) <= 0:
                length /= 2
            d += length * step
            if length == 1 and np.abs(step).max() < (_LAST if part == parts else _OTHERS):
                break
        else:
            raise RuntimeError(f"part {part} of {parts} has not converged")
    return d


def with_stiff_bodies(problem: Problem, ratio: float) -> Problem:
    """Return a problem whose rigid tissue is `ratio` times as stiff as the stiffest other tissue.

    The weights of its landmarks stay the same.
    """
    m, marks = problem.stiffness, problem.landmarks
    if marks is not None:
        scale = marks.scale.resolved(m, problem.spacing)
        marks = Landmarks(marks.points, marks.targets, sd=marks.sd, scale=scale)
    return Problem(
        observed=problem.observed,
        confidence=problem.confidence,
        stiffness=np.where(np.isinf(m), ratio * m[np.isfinite(m)].max(), m),
        spacing=problem.spacing,
        loads=problem.loads,
        precision=problem.precision,
        landmarks=marks,
    )


class _Tissue(NamedTuple):
    """Moduli and growth of the elements, each of shape (N,), and their sides.

    `first` and `shear` are lambda and mu, and `twist` is mu_x. `undo` is the inverse of the growth,
    shape (N, n, n), and `amount` the grown volume of an element. `thin` is the thickness of a slice
    that cannot thicken, relative to its grown thickness.
    """

    first: Array
    shear: Array
    twist: Array
    undo: Array
    amount: Array
    thin: Array
    bulges: bool
    spacing: tuple[float, ...]

    @classmethod
    def of(
        cls, problem: Problem, prior: NeoHookeanPrior, share: float, exist: npt.NDArray[np.bool_]
    ) -> _Tissue:
        """Return the tissue of a problem with a share of its growth."""
        axes, spacing = len(problem.shape), tuple(map(float, problem.spacing))
        small = ElasticPrior(prior.poisson, plane=prior.plane)
        bulges = is_plane_stress(problem, small)
        first, shear = (each[exist] for each in lame_parameters(problem, small))
        twist = shear + ((first if bulges else 0.0) + shear) / 2
        if bulges:
            first = 2 * shear * first / (2 * shear - first)
        strain, across = growth_of(problem)
        grown = np.eye(axes) + share * strain[exist]
        thick = 1 + share * across[exist]
        amount = np.linalg.det(grown) * thick * np.prod(spacing)
        thin = np.ones_like(thick) if bulges else 1 / thick
        return cls(first, shear, twist, np.linalg.inv(grown), amount, thin, bulges, spacing)


# First and second derivative of an energy at each point, (N, P), with respect to ln J, and the
# second derivative of an energy of the mean Jacobian, (N,).
_Slopes = tuple[Array, Array, Array | None]
_Term = tuple[Points, float, Array, Callable[[Array], _Slopes]]


def _terms(tissue: _Tissue, textbook: bool) -> Iterator[_Term]:
    """Yield the points of each part of the energy, their weight, the stretch modulus and a law."""
    axes = len(tissue.spacing)
    gauss = tuple(product(_GAUSS, repeat=axes))
    none = np.zeros_like(tissue.shear)
    shear, first = tissue.shear[:, None], tissue.first[:, None] * tissue.thin[:, None] ** 2
    whole = shear + tissue.first[:, None] / 2

    def of_area(jacobian: Array) -> _Slopes:
        if tissue.bulges:
            thick = shear + first * jacobian**2 / 2
            slope = -whole * shear / thick
            return slope, -slope * first * jacobian**2 / thick, None
        return first / 2 * jacobian**2 - whole, first * jacobian**2, None

    def of_volume(jacobian: Array) -> _Slopes:
        """Return derivatives of -mu ln J, and of G at the mean Jacobian."""
        mean = jacobian.mean(axis=1, keepdims=True)
        pull = first / 2 * (mean - 1 / mean) * jacobian
        return pull - shear, pull, (first / 2 * (1 + 1 / mean**2))[:, 0]

    def barrier(jacobian: Array) -> _Slopes:
        below = np.minimum(jacobian, _BEGIN)
        gap, log = below - _BEGIN, np.log(below / _BEGIN)
        slope = -gap * (2 * log + gap / below) * below
        bend = (-2 * log - 4 * gap / below + (gap / below) ** 2) * below**2
        return _BARRIER * shear * slope, _BARRIER * shear * (slope + bend), None

    def nothing(jacobian: Array) -> _Slopes:
        return 0 * jacobian, 0 * jacobian, None

    if textbook:
        yield gauss, 2.0**-axes, tissue.shear, of_area
    elif axes == 3:
        yield gauss, 2.0**-axes, tissue.shear, of_volume
    else:
        yield gauss, 2.0**-axes, tissue.twist, nothing
        yield ((0.5, 0.5),), 1.0, tissue.shear - tissue.twist, of_area
        yield tuple(product((0.0, 1.0), repeat=2)), 0.25, none, barrier


def _derivatives(tissue: _Tissue, corners: Array, textbook: bool) -> tuple[Array, Array]:
    """Return forces and second derivatives of elements whose corners are displaced.

    Parameters
    ----------
    tissue : _Tissue
    corners : ndarray, shape (N, 4, 2) or (N, 8, 3)
    textbook : bool

    Returns
    -------
    forces : ndarray, shape (N, m), with m = 8 or 24
    tangents : ndarray, shape (N, m, m)
    """
    count, nodes, axes = corners.shape
    forces = np.zeros((count, nodes, axes))
    tangents = np.zeros((count, nodes * axes, nodes * axes))
    for points, weight, stretch, law in _terms(tissue, textbook):
        slopes = slopes_at(points, tissue.spacing)
        gradient = np.eye(axes) + np.einsum("nck,pca->npka", corners, slopes)
        elastic = gradient @ tissue.undo[:, None]
        own = slopes @ tissue.undo[:, None]
        jacobian = np.linalg.det(elastic)
        slope, bend, of_mean = law(jacobian)
        # Derivative of ln J with respect to each component of each corner.
        rates = slopes @ np.linalg.inv(gradient)
        forces += weight * stretch[:, None, None] * np.einsum("npka,npca->nck", elastic, own)
        forces += weight * np.einsum("np,npck->nck", slope, rates)
        same = weight * stretch[:, None, None] * np.einsum("npca,npea->nce", own, own)
        tangents += np.einsum("nce,kl->nckel", same, np.eye(axes)).reshape(tangents.shape)
        flat = rates.reshape(count, len(points), -1)
        tangents += weight * (flat * bend[..., None]).swapaxes(1, 2) @ flat
        crossed = weight * (flat * slope[..., None]).swapaxes(1, 2) @ flat
        crossed = crossed.reshape(count, nodes, axes, nodes, axes).swapaxes(2, 4)
        tangents -= crossed.reshape(tangents.shape)
        if of_mean is not None:
            mean = weight * np.einsum("np,npi->ni", jacobian, flat)
            tangents += of_mean[:, None, None] * mean[:, :, None] * mean[:, None, :]
    amount = tissue.amount[:, None]
    return amount * forces.reshape(count, -1), amount[..., None] * tangents
