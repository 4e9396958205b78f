"""Random forces whose covariance is the matrix of a problem.

A field is sampled from the posterior by *perturb and solve*: if H is the matrix of all quadratic
terms (elastic energy, precision, landmarks) and T the unit of energy, the posterior is a normal
distribution with the solution as its mean and the covariance T H^-1. A random force g with the
covariance T H moves the tissue by H^-1 g, which therefore has the covariance of the posterior.

Each term supplies its own part of g. The matrix of an element is ``lambda K_1 + mu K_2`` with two
constant matrices. Both are diagonal in the same modes, the columns of W:

    K_2 = W W^T,    K_1 = W diag(q) W^T

so the part of an element is ``W diag(sqrt(T (mu + lambda q))) x`` with standard normal x: one
number for each mode, five in an image and eighteen in a volume. The matrices are those of the
solver, which integrates the change in volume with a single point (selective reduced integration).
Noise at each point of integration would have another covariance.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from napari_hmrf.field.neighbours import corner_slices
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
        modes, ratios = _common_modes(*element_stiffness(prior.shape(problem.spacing)))
        # In the solver, stiffness is relative to the stiffest tissue and lengths are in pixels.
        amount = np.sqrt(energy / (unit * problem.unit)) * unit
        self._modes = (amount * modes).T.astype(np.float32)
        self._ratios = ratios.astype(np.float32)
        self._slabs = [*_element_slabs(problem, prior)]
        self._sites = _site_factors(problem, energy)
        self._points = _PointNoise.of(problem, energy)

    def force(self, seed: int, number: int) -> Float32Array:
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
        force = np.moveaxis(planes, 0, -1)
        rng = np.random.default_rng((seed, number, len(self._slabs)))
        if self._sites is not None:
            at, roots = self._sites
            drawn = rng.standard_normal((len(roots), len(grid)))
            force[at] += np.einsum("sij,sj->si", roots, drawn).astype(np.float32)
        if self._points is not None:
            self._points.add(force, rng)
        return force

    def _of_elements(self, slab: _Slab, key: tuple[int, ...]) -> Float32Array:
        """Return the forces of the elements of a slab on its sites, (2, h, W) or (3, d, H, W)."""
        rng = np.random.default_rng(key)
        axes, count = len(slab.shape), len(slab.at)
        drawn = _standard_normal(rng, (len(self._modes), count))
        drawn *= slab.root * np.sqrt(1 + self._ratios[:, None] * slab.ratio)
        pushes = np.zeros((2**axes * axes, math.prod(slab.shape)), np.float32)
        # Unlike a product of matrices, this starts no threads that would compete with the pool's.
        strained = np.einsum("in,ik->kn", drawn, self._modes)
        for row, push in zip(pushes, strained, strict=True):
            row[slab.at] = push
        planes = np.zeros((axes, *(size + 1 for size in slab.shape)), np.float32)
        of_corners = pushes.reshape(-1, axes, *slab.shape)
        for sites, push in zip(corner_slices(slab.shape), of_corners, strict=True):
            planes[(slice(None), *sites)] += push
        return planes


class _Slab(NamedTuple):
    """Tissue elements between a range of sites along the first axis.

    Attributes
    ----------
    sites : slice
    shape : tuple of int
        Number of elements along each axis.
    at : ndarray of int, shape (n,)
        Flat indices of the elements that are strained.
    root : ndarray, shape (n,), float32
        Square root of mu of these elements.
    ratio : ndarray, shape (n,) or (1,), float32
        Ratio lambda / mu; one number if all tissue has the same Poisson's ratio.
    """

    sites: slice
    shape: tuple[int, ...]
    at: npt.NDArray[np.intp]
    root: Float32Array
    ratio: Float32Array


def _element_slabs(problem: Problem, prior: ElasticPrior) -> Iterator[_Slab]:
    for sites in slabs(problem.shape, _SLAB):
        lame = prior.lame(problem, sites)
        at = np.flatnonzero(lame.shear)
        first, shear = (each.ravel()[at] for each in lame)
        ratio = first / shear
        if isinstance(prior.poisson, float):
            ratio = ratio[:1]
        root = np.sqrt(shear).astype(np.float32)
        yield _Slab(sites, lame.shear.shape, at, root, ratio.astype(np.float32))


def _common_modes(first: Float64Array, shear: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return W and q with ``shear = W W^T`` and ``first = W diag(q) W^T``."""
    values, vectors = np.linalg.eigh(shear)
    strained = values > _NULL * values[-1]
    # Without strain, the volume does not change either, so `first` needs no other modes.
    vectors, roots = vectors[:, strained], np.sqrt(values[strained])
    ratios, turns = np.linalg.eigh(vectors.T @ first @ vectors / np.outer(roots, roots))
    return (vectors * roots) @ turns, np.maximum(ratios, 0)


def _standard_normal(rng: np.random.Generator, shape: tuple[int, int]) -> Float32Array:
    """Return standard normal numbers by the Box-Muller transform.

    Unlike the method of NumPy, it has no branches, so it runs in vector instructions.
    """
    size = math.prod(shape)
    numbers = rng.random((2, -(-size // 2)), dtype=np.float32)
    lengths, angles = numbers
    # In place, because the allocation of large arrays is slow.
    np.log(1 - lengths, out=lengths)
    lengths *= -2
    np.sqrt(lengths, out=lengths)
    angles *= np.float32(2 * np.pi)
    sines = np.sin(angles)
    np.cos(angles, out=angles)
    angles *= lengths
    lengths *= sines
    return numbers.ravel()[:size].reshape(shape)


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

    def add(self, force: Float32Array, rng: np.random.Generator) -> None:
        """Add the noise to the forces on sites."""
        drawn = self.roots * rng.standard_normal(self.roots.shape)
        for sites, shares in self.corners:
            np.add.at(force, sites, shares[:, None] * drawn)
