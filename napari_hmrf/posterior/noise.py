"""Random forces whose covariance is the matrix of a problem.

A field is sampled from the posterior by *perturb and solve*: if H is the matrix of all quadratic
terms (elastic energy, precision, landmarks) and T the unit of energy, the posterior is a normal
distribution with the solution as its mean and the covariance T H^-1. A random force g with the
covariance T H moves the tissue by H^-1 g, which therefore has the covariance of the posterior.

Each term supplies its own part of g. The matrix of an element is ``lambda K_1 + mu K_2`` with two
constant matrices, so its part is

    sqrt(T lambda) L_1 x_1 + sqrt(T mu) L_2 x_2,    K_i = L_i L_i^T

with standard normal x_1 and x_2. The matrices are those of the solver, which integrates the change
in volume with a single point (selective reduced integration). Noise at each point of integration
would have another covariance.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.solver.neighbours import corner_slices
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.priors.elements import element_stiffness
from napari_hmrf.solver.priors.growth import slabs
from napari_hmrf.solver.problem import Problem
from napari_hmrf.solver.uncertain_landmarks import corner_shares

Float32Array = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
# Number of sites of a slab, whose arrays fit into the cache.
_SLAB = 1 << 14
# Largest eigenvalue, relative to the largest of all, that counts as 0.
_NULL = 1e-12


class PosteriorNoise:
    """Random forces on the sites of a problem, in the unit of `Loads`.

    Parameters
    ----------
    problem : Problem
    prior : ElasticPrior
    energy : float
        Unit of energy, T in the equations: stiffness times length^n.
    """

    def __init__(self, problem: Problem, prior: ElasticPrior, energy: float) -> None:
        self._problem = problem
        unit = prior.force_unit(problem)
        first, shear = (_factor(each) for each in element_stiffness(prior.shape(problem.spacing)))
        # In the solver, stiffness is relative to the stiffest tissue and lengths are in pixels.
        amount = np.sqrt(energy / (unit * problem.unit)) * unit
        self._count = first.shape[1]
        self._factor = (amount * np.hstack([first, shear])).T.astype(np.float32)
        self._slabs = [*_element_slabs(problem, prior)]
        self._sites = _site_factors(problem, energy)
        self._points = _PointNoise.of(problem, energy)

    def force(self, seed: int, number: int) -> Float64Array:
        """Return a random force on each site, shape (H, W, 2) or (D, H, W, 3).

        The force depends on the arguments only, and not on the number of threads.

        Parameters
        ----------
        seed, number : int
            Seed, and number of the sample.
        """
        grid = self._problem.shape
        planes = np.zeros((len(grid), *grid), np.float32)
        keys = [(seed, number, block) for block in range(len(self._slabs))]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            # Neighbouring slabs share sites, so their forces are added one after another.
            for slab, pushes in zip(
                self._slabs, pool.map(self._of_elements, self._slabs, keys), strict=True
            ):
                planes[:, slab.sites] += pushes
        force = np.moveaxis(planes, 0, -1).astype(np.float64)
        rng = np.random.default_rng((seed, number, len(self._slabs)))
        if self._sites is not None:
            at, roots = self._sites
            drawn = rng.standard_normal((len(roots), len(grid)))
            force[at] += np.einsum("sij,sj->si", roots, drawn)
        if self._points is not None:
            self._points.add(force, rng)
        return force

    def _of_elements(self, slab: _Slab, key: tuple[int, ...]) -> Float32Array:
        """Return the forces of the elements of a slab on its sites, (n, h, W) or (n, d, H, W)."""
        rng = np.random.default_rng(key)
        axes, count = slab.elements.ndim, len(slab.first)
        drawn = rng.standard_normal((len(self._factor), count), dtype=np.float32)
        drawn[: self._count] *= slab.first
        drawn[self._count :] *= slab.shear
        pushes = np.zeros((2**axes * axes, *slab.elements.shape), np.float32)
        # Unlike a product of matrices, this starts no threads that would compete with the pool's.
        pushes[:, slab.elements] = np.einsum("in,ik->kn", drawn, self._factor)
        planes = np.zeros((axes, *(size + 1 for size in slab.elements.shape)), np.float32)
        of_corners = pushes.reshape(-1, axes, *slab.elements.shape)
        for sites, push in zip(corner_slices(slab.elements.shape), of_corners, strict=True):
            planes[(slice(None), *sites)] += push
        return planes


class _Slab(NamedTuple):
    """Tissue elements between a range of sites along the first axis.

    Attributes
    ----------
    sites : slice
    elements : ndarray of bool
        Mask of the elements that are strained.
    first, shear : ndarray, shape (n,), float32
        Square roots of the Lame parameters of these elements.
    """

    sites: slice
    elements: npt.NDArray[np.bool_]
    first: Float32Array
    shear: Float32Array


def _element_slabs(problem: Problem, prior: ElasticPrior) -> Iterator[_Slab]:
    for sites in slabs(problem.shape, _SLAB):
        lame = prior.lame(problem, sites)
        elements = lame.shear > 0
        roots = (np.sqrt(each[elements]).astype(np.float32) for each in lame)
        yield _Slab(sites, elements, *roots)


def _factor(matrix: Float64Array) -> Float64Array:
    """Return L with ``L L^T`` equal to a positive semidefinite matrix, without null columns."""
    values, vectors = np.linalg.eigh(matrix)
    kept = values > _NULL * max(float(values[-1]), np.finfo(float).tiny)
    return np.asarray(vectors[:, kept] * np.sqrt(values[kept]))


def _site_factors(
    problem: Problem, energy: float
) -> tuple[tuple[npt.NDArray[np.intp], ...], Float64Array] | None:
    """Return the sites with a precision, and the square root of each tensor times the energy."""
    if problem.precision is None:
        return None
    at = np.nonzero(problem.precision.any(axis=(-2, -1)))
    values, vectors = np.linalg.eigh(problem.precision[at])
    roots = np.sqrt(energy * np.maximum(values, 0))
    return at, np.asarray(np.einsum("sij,sj->sij", vectors, roots))


class _PointNoise(NamedTuple):
    """Noise of landmarks, which is divided among the corners of their elements.

    Attributes
    ----------
    corners : tuple of (index, shares)
        Sites at each corner of the elements, and their shares of the landmarks.
    roots : ndarray, shape (n, axes)
        Standard deviation of the force on each landmark.
    """

    corners: tuple[tuple[tuple[Any, ...], Float64Array], ...]
    roots: Float64Array

    @classmethod
    def of(cls, problem: Problem, energy: float) -> _PointNoise | None:
        """Return the noise of the landmarks of a problem, or None if there are none."""
        marks = problem.landmarks
        if marks is None:
            return None
        precision = marks.precision(problem.stiffness, problem.spacing)
        corners = tuple(corner_shares(marks.points, problem.shape))
        return cls(corners, np.sqrt(energy * precision))

    def add(self, force: Float64Array, rng: np.random.Generator) -> None:
        """Add the noise to the forces on sites."""
        drawn = self.roots * rng.standard_normal(self.roots.shape)
        for sites, shares in self.corners:
            np.add.at(force, sites, shares[:, None] * drawn)
