"""Covariance of observations under the prior.

Observations y = H d + e of a displacement d, with errors of the covariance R, are normally
distributed about the motion H d0 that the tissue has without them:

    y - H d0  ~  N(0, T C + R),    C = H K^-1 H^T

where K is the matrix of the elastic energy and T the unit of energy. The number of observations is
small, so C is a dense matrix. Each column is the response of the tissue to a unit force at one
observation.

If nothing else holds the tissue, its rigid motions are unknown and K is singular. The observations
are then projected onto the combinations that no rigid motion changes (restricted likelihood). To
compute the responses, each observation holds the tissue with a spring of a weight w, whose effect
is removed exactly: with G = H (K + w H^T H)^-1 H^T and the projected matrices,

    C = (G^-1 - w)^-1
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from napari_hmrf.errors import ProblemError
from napari_hmrf.field.neighbours import sites_of_elements
from napari_hmrf.solver.connected import connected
from napari_hmrf.solver.operator import Operator
from napari_hmrf.solver.optimizers import Monitor, Multigrid
from napari_hmrf.solver.priors import ElasticPrior
from napari_hmrf.solver.problem import Problem, variant_of
from napari_hmrf.solver.rigid_modes import free_motions
from napari_hmrf.solver.solve import CancelFlag, Progress, solve
from napari_hmrf.solver.uncertain_landmarks import Landmarks, corner_shares, typical_stiffness

Float64Array = npt.NDArray[np.float64]

#: Largest number of observed components.
_MOST = 3000
#: Largest error of a response, relative to the root mean square length of its displacements.
_ACCURACY = 3e-4
#: Error of the motion without observations, relative to the least standard deviation.
_MEAN_ACCURACY = 0.01
#: Smallest and largest tolerance of this motion, in pixels.
_TOLERANCES = (1e-4, 0.01)
#: Size of a singular value, relative to the largest, that counts as 0.
_NULL = 1e-8
#: Smallest share of an observation that a spring leaves to the tissue.
_SOFT = 1e-6


class Observations(NamedTuple):
    """Uncertain observations of a problem, one for each component.

    Components of landmarks are first, in the order of the landmarks and the axes; those of the
    precision follow, in the order of the sites.

    Attributes
    ----------
    rows : sparse array, shape (m, number of components of all sites)
        H in the equations.
    values : ndarray, shape (m,)
        Observed displacements, in the unit of `spacing`.
    sd : ndarray, shape (m,)
        Standard deviations of their errors.
    """

    rows: Any
    values: Float64Array
    sd: Float64Array

    @classmethod
    def of(cls, problem: Problem, energy: float) -> Observations:
        """Return the observations of a problem.

        Parameters
        ----------
        problem : Problem
        energy : float
            Unit of energy, stiffness times length^n, from which the precision was computed.

        Raises
        ------
        ProblemError
            If there are no observations, or too many.
        """
        parts = [*_of_landmarks(problem), *_of_sites(problem, energy)]
        count = sum(len(part.values) for part in parts)
        if not count:
            raise ProblemError(
                "landmarks",
                "are missing, and so is a precision in elastic tissue: there is no uncertain "
                "observation. Add landmarks with a standard deviation.",
            )
        if count > _MOST:
            raise ProblemError(
                "landmarks" if problem.precision is None else "precision",
                f"observes {count:,} components; the covariance of up to {_MOST:,} is computed. "
                "Use a part of the observations.",
            )
        return cls(
            scipy.sparse.vstack([part.rows for part in parts], format="csr"),
            np.concatenate([part.values for part in parts]),
            np.concatenate([part.sd for part in parts]),
        )


def _of_landmarks(problem: Problem) -> Iterator[Observations]:
    marks, grid = problem.landmarks, problem.shape
    if marks is None:
        return
    axes, count = len(grid), len(marks)
    number = np.arange(count)[:, np.newaxis] * axes + np.arange(axes)
    shape = (count * axes, math.prod(grid) * axes)
    rows = scipy.sparse.csr_array(shape)
    for sites, shares in corner_shares(marks.points, grid):
        at = np.ravel_multi_index(sites, grid)[:, np.newaxis] * axes + np.arange(axes)
        values = np.broadcast_to(shares[:, np.newaxis], at.shape)
        rows = rows + scipy.sparse.coo_array(
            (values.ravel(), (number.ravel(), at.ravel())), shape=shape
        )
    displacement = marks.displacement(problem.spacing)
    yield Observations(rows.tocsr(), displacement.ravel(), marks.sd.ravel())


def _of_sites(problem: Problem, energy: float) -> Iterator[Observations]:
    if problem.precision is None:
        return
    # The prior says nothing about lone pixels, which follow no other tissue.
    inside = sites_of_elements(problem.tissue)
    at = np.flatnonzero(problem.precision.any(axis=(-2, -1)) & inside)
    axes = len(problem.shape)
    values, vectors = np.linalg.eigh(problem.precision.reshape(-1, axes, axes)[at])
    site, way = np.nonzero(values > _NULL * values.max(initial=0.0))
    directions = vectors[site, :, way]
    columns = at[site][:, np.newaxis] * axes + np.arange(axes)
    numbers = np.repeat(np.arange(len(site)), axes)
    rows = scipy.sparse.csr_array(
        (directions.ravel(), (numbers, columns.ravel())),
        shape=(len(site), problem.observed.size),
    )
    observed = problem.observed.reshape(-1, axes)[at[site]].astype(np.float64)
    yield Observations(
        rows, (directions * observed).sum(axis=1), np.sqrt(energy / values[site, way])
    )


@dataclass(frozen=True, eq=False)
class DataSpace:
    """Observations relative to the motion without them, and their covariance under the prior.

    All quantities refer to k combinations of the m observed components that are unaffected by free
    rigid motions, and independent of each other under the prior.

    Attributes
    ----------
    basis : ndarray, shape (m, k)
        Orthonormal combinations, one for each column.
    residual : ndarray, shape (k,)
        Combinations of the observations minus the motion of the tissue without them.
    variance : ndarray, shape (k,)
        Variance under the prior per unit of energy: the diagonal of C.
    sd : ndarray, shape (m,)
        Standard deviations of the errors of the observations.
    """

    basis: Float64Array
    residual: Float64Array
    variance: Float64Array
    sd: Float64Array

    @property
    def noise(self) -> Float64Array:
        """Covariance of the errors of the combinations, shape (k, k)."""
        return np.asarray((self.basis.T * self.sd**2) @ self.basis)


def data_space(
    problem: Problem,
    prior: ElasticPrior,
    energy: float,
    backend: str,
    progress: Progress | None,
    cancel: CancelFlag | None,
) -> DataSpace:
    """Compute the covariance of the observations of a problem, with one solve for each.

    Parameters
    ----------
    problem : Problem
    prior : ElasticPrior
        Result of `checked_prior`.
    energy : float
        Unit of energy from which the precision was computed.
    backend, progress, cancel
        As for `solve`.

    Raises
    ------
    ProblemError
        If there are no observations or too many, or if they only determine rigid motions.
    """
    problem = connected(problem, prior).without_orphans
    data = Observations.of(problem, energy)
    bare = variant_of(problem, precision=None, landmarks=None)
    motions = [motion for each in free_motions(bare, bare.known) for motion in each]
    basis = np.eye(len(data.values))
    weight = 0.0
    if motions:
        seen = np.stack([data.rows @ motion.ravel() for motion in motions], axis=1)
        ways, sizes, _ = np.linalg.svd(seen, full_matrices=True)
        basis = ways[:, int((sizes > _NULL * sizes[0]).sum()) :]
        if not basis.size:
            raise ProblemError(
                "landmarks",
                "are too few: they only determine the rigid motion of the tissue. Add landmarks, "
                "or hold part of the tissue.",
            )
        weight = typical_stiffness(problem.stiffness) * problem.unit ** (len(problem.shape) - 2)
    held = _held_by_springs(problem, data, weight, energy) if weight else bare
    mean = solve(
        held, prior, optimizer=Multigrid(tolerance=_tolerance(data, problem)), backend=backend,
        cancel=cancel,
    ).displacement  # fmt: skip
    missing = data.values - data.rows @ mean.ravel().astype(np.float64)
    responses = basis.T @ _responses(held, prior, data, backend, progress, cancel) @ basis
    sizes, turned = np.linalg.eigh((responses + responses.T) / 2)
    sizes = np.maximum(sizes, 0.0)
    left = np.maximum(1 - weight * sizes, _SOFT)
    basis = basis @ turned
    return DataSpace(basis, (basis.T @ missing) / left, sizes / left, data.sd)


def _held_by_springs(problem: Problem, data: Observations, weight: float, energy: float) -> Problem:
    """Return the problem with the same precision for all observed components."""
    changes: dict[str, Any] = {}
    marks, axes = problem.landmarks, len(problem.shape)
    first = 0
    if marks is not None:
        first = marks.points.size
        unit = marks.scale.energy(problem.stiffness, problem.spacing)
        changes["landmarks"] = Landmarks(
            marks.points, marks.targets, sd=math.sqrt(unit / weight), scale=marks.scale
        )
    if problem.precision is not None:
        rows = data.rows[first:]
        # Components of the same site are orthogonal, so their products have no other sites.
        at = rows.indices.reshape(-1, axes)
        of_site = rows.data.reshape(-1, axes)
        tensors = np.zeros((math.prod(problem.shape), axes, axes))
        np.add.at(tensors, at[:, 0] // axes, weight * of_site[:, :, None] * of_site[:, None, :])
        changes["precision"] = tensors.reshape(problem.precision.shape)
    return variant_of(problem, **changes)


def _tolerance(data: Observations, problem: Problem) -> float:
    """Return a tolerance of the motion without observations at which its error is negligible."""
    low, high = _TOLERANCES
    return min(max(_MEAN_ACCURACY * float(data.sd.min()) / problem.unit, low), high)


def _responses(
    problem: Problem,
    prior: ElasticPrior,
    data: Observations,
    backend: str,
    progress: Progress | None,
    cancel: CancelFlag | None,
) -> Float64Array:
    """Return the observed motion due to a unit force at each observation, shape (m, m)."""
    operator = Operator(problem, prior, backend)
    count = len(data.values)
    found = np.zeros((count, count))
    moves = (problem.tissue[..., np.newaxis] & ~problem.known).ravel()
    for number in range(count):
        if progress is not None:
            progress(Monitor(f"observation {number + 1} of {count}", number / count))
        force = data.rows[[number]].toarray().reshape(problem.observed.shape)
        if not force.ravel()[moves].any():
            continue  # held tissue
        found[number] = data.rows @ operator.solve(force, _ACCURACY, cancel=cancel).ravel()
    if progress is not None:
        progress(Monitor(f"{count} observations", 1.0))
    return found
